"""Ensembles of tiny lattices, each over a few of many inputs."""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fusion.lattice import grid
from fusion.lattice.inputs import require_width
from fusion.lattice.projections import MARGIN, tilt
from fusion.lattice.shapes import project_vertices, violation

__all__ = ["EnsembleConfig", "apply", "check", "init", "project", "random_features"]


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
        raise ValueError(f"rank is {rank}; expected 1..{n_inputs} (the number of inputs)")
    if n_lattices * rank < n_inputs:
        raise ValueError(
            f"{n_lattices} lattices of rank {rank} have {n_lattices * rank} places for {n_inputs} "
            "inputs; use more lattices or a higher rank"
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
        ranks = {len(subset) for subset in self.features}
        if len(ranks) != 1:
            raise ValueError(
                f"features hold subsets of {sorted(ranks)} inputs; expected at least one subset "
                "and the same number of inputs in each"
            )
        for subset in self.features:
            if len(set(subset)) != len(subset) or not all(0 <= i < self.n_inputs for i in subset):
                raise ValueError(
                    f"features hold {subset}; expected different inputs of 0..{self.n_inputs - 1}"
                )
        given = self.monotonicity
        if given is not None and (
            len(given) != self.n_inputs or any(s not in (-1, 0, 1) for s in given)
        ):
            raise ValueError(
                f"monotonicity is {given}; expected -1, 0 or 1 for each of {self.n_inputs} inputs"
            )
        _ = self.lattice

    @property
    def lattice(self) -> grid.LatticeConfig:
        """Size, bounds and interpolation of each lattice."""
        return grid.LatticeConfig(
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


def init(key: Key[Array, ""], config: EnsembleConfig) -> grid.LatticeParams:
    """Planes, as in `grid.init`, with the directions of each lattice's inputs.

    Args:
        key: PRNG key.
        config: the ensemble.

    Returns:
        LatticeParams with `vertices` `[n_lattices, *sizes]`; feasible.
    """
    signs = config.signs
    lattices = []
    for row, lattice_key in zip(signs, jax.random.split(key, len(signs)), strict=True):
        lattice = dataclasses.replace(config.lattice, monotonicity=tuple(int(s) for s in row))
        lattices.append(grid.init(lattice_key, lattice).vertices)
    return grid.LatticeParams(jnp.stack(lattices))


def apply(
    params: grid.LatticeParams, config: EnsembleConfig, x: Float[Array, "*batch n_inputs"]
) -> Float[Array, "*batch"]:
    r"""Mean of the lattices' outputs.

    .. math:: f(x) = \frac{1}{L} \sum_{l=1}^{L} f_l(x_{S_l})

    Symbols: :math:`S_l` is `config.features[l]`; :math:`L` is the number of lattices.

    Args:
        params: of the ensemble.
        config: of the ensemble.
        x: inputs.

    Returns:
        One number for each example.
    """
    require_width(x, config.n_inputs, "ensemble.apply")
    chosen = x[..., np.asarray(config.features)]
    lattice = config.lattice
    each = jax.vmap(lambda p, z: grid.apply(p, lattice, z), (0, -2), -1)
    return jnp.mean(each(params, chosen), axis=-1)


def project(
    params: grid.LatticeParams, config: EnsembleConfig, *, margin: float = MARGIN
) -> grid.LatticeParams:
    """Each lattice projected onto its constraints, all of them in one vmapped program.

    Args:
        params: of the ensemble.
        config: of the ensemble.
        margin: slack to leave, in float32 epsilons of each lattice's largest vertex.

    Returns:
        LatticeParams with `check(...) == 0`.
    """
    lattice = config.lattice
    signs = config.signs
    if np.all(signs == signs[0]):
        row = signs[0]
        each = jax.vmap(lambda v: project_vertices(v, row, lattice, tilt(v, margin)))
        return grid.LatticeParams(each(params.vertices))
    mixed = jax.vmap(lambda v, row: project_vertices(v, row, lattice, tilt(v, margin)))
    return grid.LatticeParams(mixed(params.vertices, jnp.asarray(signs)))


def check(params: grid.LatticeParams, config: EnsembleConfig) -> Float[Array, ""]:
    """Largest violation in any lattice; 0 where all constraints hold."""
    each = jax.vmap(lambda v, row: violation(v, row, config.lattice))
    return jnp.max(each(params.vertices, jnp.asarray(config.signs)))
