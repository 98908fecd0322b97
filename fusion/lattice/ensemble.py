"""Ensembles of tiny lattices, each over a few of many inputs.

Constraints between inputs are asked of the ensemble and imposed on each lattice that holds these
inputs. They hold for the mean where no lattice speaks against them alone: a lattice of the weak
input without the dominant one has a slope in it that nothing bounds. Such subsets are refused.
"""

from __future__ import annotations

import dataclasses
import functools
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fusion.lattice import lattice_layer
from fusion.lattice.checks import (
    refusal,
    require_count,
    require_key,
    require_signs,
    require_static,
    require_width,
)
from fusion.lattice.constraints import project_vertices, violation
from fusion.lattice.lattice_config import LatticeConfig, LatticeParams
from fusion.lattice.relations import BUILDERS


@dataclasses.dataclass(frozen=True)
class EnsembleConfig:
    """Lattices of equal size over subsets of the inputs; their outputs are averaged.

    Attributes:
        n_inputs: inputs, in lattice coordinates `[0, lattice_size - 1]`.
        features: the inputs of each lattice; `random_features` makes random ones.
        lattice_size: vertices along each axis.
        monotonicity: -1, 0 or +1 for each input of the ensemble; `None` is all free.
        output_range: `(low, high)`, either of which may be `None`.
        interpolation: "hypercube" or "simplex".
        n_iterations: passes of Dykstra's algorithm.
        edgeworth_trust, trapezoid_trust, dominance, range_dominance, joint_monotonicity,
            joint_unimodality: constraints between inputs of the ensemble, as `LatticeConfig` has
            them between its own.

    Raises:
        ValueError, TypeError: subsets, directions or constraints that mean nothing, or constraints
            that would not hold for the mean of lattices of these subsets, by name and value.

    Example:
        >>> EnsembleConfig(4, features=((0, 1), (2, 3)), monotonicity=(1, 0, 0, 0)).lattice_size
        2
    """

    n_inputs: int
    features: tuple[tuple[int, ...], ...]
    lattice_size: int = 2
    monotonicity: tuple[int, ...] | None = None
    output_range: tuple[float | None, float | None] = (None, None)
    interpolation: Literal["hypercube", "simplex"] = "hypercube"
    n_iterations: int = 10
    edgeworth_trust: tuple[tuple[int, int, int], ...] = ()
    trapezoid_trust: tuple[tuple[int, int, int], ...] = ()
    dominance: tuple[tuple[int, int], ...] = ()
    range_dominance: tuple[tuple[int, int], ...] = ()
    joint_monotonicity: tuple[tuple[int, int, int], ...] = ()
    joint_unimodality: tuple[tuple[tuple[int, ...], int], ...] = ()

    def __post_init__(self) -> None:
        """Refuse subsets and constraints that mean nothing; `LatticeConfig` checks the rest."""
        require_static(self)
        require_count("n_inputs", self.n_inputs)
        require_count("lattice_size", self.lattice_size, 2)
        if len({len(subset) for subset in self.features}) != 1:
            raise refusal(
                "features",
                self.features,
                "one or more subsets with the same number of inputs in each",
                "make them with random_features",
            )
        for subset in self.features:
            if len(set(subset)) != len(subset) or not all(0 <= i < self.n_inputs for i in subset):
                raise refusal(
                    "features",
                    subset,
                    f"different inputs of 0..{self.n_inputs - 1}",
                    "make them with random_features",
                )
        require_signs("monotonicity", self.monotonicity, self.n_inputs)
        self._check_relations()
        _ = self.lattices

    @property
    def lattice(self) -> LatticeConfig:
        """Size, bounds and interpolation of each lattice."""
        return LatticeConfig(
            (self.lattice_size,) * len(self.features[0]),
            output_range=self.output_range,
            interpolation=self.interpolation,
            n_iterations=self.n_iterations,
        )

    @property
    def signs(self) -> np.ndarray:
        """`[n_lattices, rank]` of -1, 0, 1."""
        signs = np.asarray(self.monotonicity or (0,) * self.n_inputs, np.int32)
        return signs[np.asarray(self.features)]

    @property
    def lattices(self) -> tuple[LatticeConfig, ...]:
        """Each lattice with the directions of its inputs and the constraints between them."""
        return _lattices(self)

    def _check_relations(self) -> None:
        sizes = (self.lattice_size,) * self.n_inputs
        signs = np.asarray(self.monotonicity or (0,) * self.n_inputs)
        for name, build in BUILDERS.items():
            for entry in getattr(self, name):
                axes = build(name, entry, sizes, signs).axes
                alone = set(axes[_MAY_STAND_ALONE[name] :])
                for subset in self.features:
                    if alone & set(subset) and not set(axes) <= set(subset):
                        raise refusal(
                            name, entry, f"all of inputs {axes} in each subset that holds one of "
                            f"{sorted(alone)}, unlike {subset}",
                            "make the subsets with random_features(together=...)",
                        )  # fmt: skip


# How many of a constraint's inputs, from the first on, may be in a lattice without the others: the
# two of Edgeworth trust, of which a lattice of one has no mixed difference; the main input, the
# dominant one; none of the joint constraints.
_MAY_STAND_ALONE = {
    "edgeworth_trust": 2, "trapezoid_trust": 1, "dominance": 1, "range_dominance": 1,
    "joint_monotonicity": 0, "joint_unimodality": 0,
}  # fmt: skip


@functools.lru_cache(maxsize=128)
def _lattices(config: EnsembleConfig) -> tuple[LatticeConfig, ...]:
    def local(name: str, subset: tuple[int, ...]) -> tuple[Any, ...]:
        joint = name == "joint_unimodality"
        found = []
        for entry in getattr(config, name):
            axes, rest = (entry[0], entry[1:]) if joint else (entry[:2], entry[2:])
            if set(axes) <= set(subset):
                places = tuple(subset.index(axis) for axis in axes)
                found.append((places, *rest) if joint else (*places, *rest))
        return tuple(found)

    made = []
    for subset, signs in zip(config.features, config.signs, strict=True):
        relations: dict[str, Any] = {name: local(name, subset) for name in BUILDERS}
        directions = tuple(int(s) for s in signs)
        made.append(dataclasses.replace(config.lattice, monotonicity=directions, **relations))
    return tuple(made)


def init(key: Key[Array, ""], config: EnsembleConfig) -> LatticeParams:
    """Planes, as in `lattice_layer.init`, with the directions of each lattice's inputs.

    Args:
        key: PRNG key.
        config: the ensemble.

    Returns:
        LatticeParams with `vertices` `[n_lattices, *sizes]`; feasible.

    Raises:
        ValueError: a legacy key.
    """
    require_key(key)
    keys = jax.random.split(key, len(config.lattices))
    made = [lattice_layer.init(k, c).vertices for k, c in zip(keys, config.lattices, strict=True)]
    return LatticeParams(jnp.stack(made))


def apply(
    config: EnsembleConfig, params: LatticeParams, x: Float[Array, "*batch n_inputs"]
) -> Float[Array, "*batch"]:
    r"""Mean of the lattices' outputs.

    .. math:: f(x) = \frac{1}{L} \sum_{l=1}^{L} f_l(x_{S_l})

    Symbols: :math:`S_l` is `config.features[l]`; :math:`L` is the number of lattices.

    Args:
        config: of the ensemble.
        params: of the ensemble.
        x: inputs.

    Returns:
        One number for each example.
    """
    require_width(x, config.n_inputs, "ensemble.apply")
    chosen = x[..., np.asarray(config.features)]
    lattice = config.lattice
    each = jax.vmap(lambda p, z: lattice_layer.apply(lattice, p, z), (0, -2), -1)
    return jnp.mean(each(params, chosen), axis=-1)


def project(config: EnsembleConfig, params: LatticeParams) -> LatticeParams:
    """Each lattice projected onto its constraints, equal ones in one vmapped program.

    Args:
        config: of the ensemble.
        params: of the ensemble.

    Returns:
        LatticeParams with `check(...) == 0`.
    """
    lattice, signs = config.lattice, config.signs
    alike: dict[LatticeConfig, list[int]] = {}
    for place, each in enumerate(config.lattices):
        alike.setdefault(each, []).append(place)
    if len(alike) > 1 and not any(each.relations for each in alike):
        # Directions alone may be traced: one program for all lattices.
        mixed = jax.vmap(lambda v, row: project_vertices(lattice, row, v))
        return LatticeParams(mixed(params.vertices, jnp.asarray(signs)))
    vertices = params.vertices
    for each, places in alike.items():
        chosen = np.asarray(places)
        same = jax.vmap(partial(project_vertices, each, each.signs))
        vertices = vertices.at[chosen].set(same(vertices[chosen]))
    return LatticeParams(vertices)


def check(config: EnsembleConfig, params: LatticeParams) -> Float[Array, ""]:
    """Largest violation in any lattice; 0 where all constraints hold."""
    if not any(each.relations for each in config.lattices):
        each = jax.vmap(lambda v, row: violation(config.lattice, row, v))
        return jnp.max(each(params.vertices, jnp.asarray(config.signs)))
    pairs = zip(config.lattices, params.vertices, strict=True)
    return jnp.max(jnp.stack([violation(lattice, lattice.signs, v) for lattice, v in pairs]))
