"""Ensembles of tiny lattices, each over a few of many inputs."""

from __future__ import annotations

import dataclasses
from typing import Literal

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


def random_features(
    seed: int, n_inputs: int, n_lattices: int, rank: int
) -> tuple[tuple[int, ...], ...]:
    """Random subsets of the inputs, every input in as equal a number of them as can be.

    Args:
        seed: of numpy's generator; the same seed gives the same subsets.
        n_inputs: inputs to choose from.
        n_lattices: subsets.
        rank: inputs in each, at most `n_inputs`.

    Returns:
        `n_lattices` tuples of `rank` different inputs.

    Raises:
        ValueError: `rank` is out of range, or the lattices have too few places for all inputs.

    Source: Canini et al. (2016), Fast and flexible monotonic functions with ensembles of
    lattices: random tiny lattices. Deviation: they draw subsets independently; here counts are
    balanced, so that no input is left out.
    """
    if not 1 <= rank <= n_inputs:
        raise refusal("rank", rank, f"1..{n_inputs}, the number of inputs", "lower the rank")
    if n_lattices * rank < n_inputs:
        raise refusal(
            "n_lattices",
            n_lattices,
            f"{-(-n_inputs // rank)} or more: {n_inputs} inputs need a place at rank {rank}",
            "use more lattices or a higher rank",
        )
    rng = np.random.default_rng(seed)
    used = np.zeros(n_inputs)
    subsets = []
    for _ in range(n_lattices):
        # The least used inputs first, ties at random.
        chosen = np.lexsort((rng.random(n_inputs), used))[:rank]
        used[chosen] += 1
        subsets.append(tuple(int(i) for i in np.sort(chosen)))
    return tuple(subsets)


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

    Raises:
        ValueError, TypeError: subsets or directions that mean nothing, by name and value.

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

    def __post_init__(self) -> None:
        """Refuse subsets and directions that mean nothing; `LatticeConfig` checks the rest."""
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
        _ = self.lattice

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
    signs = config.signs
    lattices = []
    for row, lattice_key in zip(signs, jax.random.split(key, len(signs)), strict=True):
        lattice = dataclasses.replace(config.lattice, monotonicity=tuple(int(s) for s in row))
        lattices.append(lattice_layer.init(lattice_key, lattice).vertices)
    return LatticeParams(jnp.stack(lattices))


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
    """Each lattice projected onto its constraints, all of them in one vmapped program.

    Args:
        config: of the ensemble.
        params: of the ensemble.

    Returns:
        LatticeParams with `check(...) == 0`.
    """
    lattice = config.lattice
    signs = config.signs
    if np.all(signs == signs[0]):
        row = signs[0]
        each = jax.vmap(lambda v: project_vertices(lattice, row, v))
        return LatticeParams(each(params.vertices))
    mixed = jax.vmap(lambda v, row: project_vertices(lattice, row, v))
    return LatticeParams(mixed(params.vertices, jnp.asarray(signs)))


def check(config: EnsembleConfig, params: LatticeParams) -> Float[Array, ""]:
    """Largest violation in any lattice; 0 where all constraints hold."""
    each = jax.vmap(lambda v, row: violation(config.lattice, row, v))
    return jnp.max(each(params.vertices, jnp.asarray(config.signs)))
