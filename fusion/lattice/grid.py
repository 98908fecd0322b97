"""The lattice: a learned table over a grid, interpolated between its vertices."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fusion.lattice.inputs import require_width
from fusion.lattice.projections import MARGIN, tilt
from fusion.lattice.shapes import project_vertices, violation

__all__ = ["LatticeConfig", "LatticeParams", "apply", "check", "init", "project", "vertices"]


class LatticeParams(NamedTuple):
    """`vertices` `[*sizes]`: the output at each vertex, axis d is input d."""

    vertices: Array


@dataclasses.dataclass(frozen=True)
class LatticeConfig:
    """One lattice. Input d runs over `[0, sizes[d] - 1]`; inputs outside are clipped.

    Attributes:
        sizes: vertices along each input, at least 2.
        monotonicity: -1, 0 or +1 for each input; `None` is all free.
        unimodality: for each input 0 (free), +1 (valley: falls to the middle vertex
            `sizes[d] // 2`, rises after it) or -1 (peak); not beside monotonicity of that input.
        edgeworth_trust: triples `(main, conditional, direction)`: the slope in the main input
            grows (+1) or shrinks (-1) with the conditional input.
        output_range: `(low, high)`, either of which may be `None`.
        interpolation: "hypercube" (multilinear, over all corners of a cell) or "simplex" (over
            `rank + 1` corners).
        n_iterations: passes of Dykstra's algorithm where there is more than one family of
            constraints; what is left after them is repaired exactly. 10 is enough in training,
            where each step starts next to the feasible set.
    """

    sizes: tuple[int, ...]
    monotonicity: tuple[int, ...] | None = None
    unimodality: tuple[int, ...] | None = None
    edgeworth_trust: tuple[tuple[int, int, int], ...] = ()
    output_range: tuple[float | None, float | None] = (None, None)
    interpolation: Literal["hypercube", "simplex"] = "hypercube"
    n_iterations: int = 10

    def __post_init__(self) -> None:
        """Refuse sizes and constraints that mean nothing or contradict each other."""
        rank = len(self.sizes)
        if rank == 0 or any(size < 2 for size in self.sizes):
            raise ValueError(f"sizes is {self.sizes}; expected at least one input, each size >= 2")
        for name in ("monotonicity", "unimodality"):
            given = getattr(self, name)
            if given is not None and (
                len(given) != rank or any(s not in (-1, 0, 1) for s in given)
            ):
                raise ValueError(
                    f"{name} is {given}; expected -1, 0 or 1 for each of {rank} inputs"
                )
        for axis in range(rank):
            if self.signs[axis] and self.unimodality and self.unimodality[axis]:
                raise ValueError(
                    f"input {axis} is both monotone and unimodal; set one of the two to 0"
                )
        for trust in self.edgeworth_trust:
            main, conditional, direction = trust
            if (
                not (0 <= main < rank and 0 <= conditional < rank)
                or main == conditional
                or direction not in (-1, 1)
            ):
                raise ValueError(
                    f"edgeworth_trust {trust} is not valid; expected (main, conditional, "
                    f"direction) with two different inputs of 0..{rank - 1} and direction -1 or 1"
                )
            opposite = [
                t for t in self.edgeworth_trust if {t[0], t[1]} == {main, conditional}
                and t[2] != direction
            ]  # fmt: skip
            if opposite:
                raise ValueError(
                    f"edgeworth_trust {trust} and {opposite[0]} ask for opposite directions; "
                    "keep one"
                )
        low, high = self.output_range
        if low is not None and high is not None and not low < high:
            raise ValueError(f"output_range is {self.output_range}; expected low < high")
        if self.interpolation not in ("hypercube", "simplex"):
            raise ValueError(
                f"interpolation is {self.interpolation!r}; expected 'hypercube' or 'simplex'"
            )
        if self.n_iterations < 1:
            raise ValueError(f"n_iterations is {self.n_iterations}; expected at least 1")

    @property
    def rank(self) -> int:
        """Number of inputs."""
        return len(self.sizes)

    @property
    def signs(self) -> np.ndarray:
        """`[rank]` of -1, 0, 1."""
        return np.asarray(self.monotonicity or (0,) * self.rank, np.int64)

    def centre(self, axis: int) -> int:
        """The vertex where a unimodal input has its extreme."""
        return self.sizes[axis] // 2


def init(key: Key[Array, ""], config: LatticeConfig) -> LatticeParams:
    """A plane across the output range, up or down with monotone inputs, at random with free ones.

    Args:
        key: PRNG key.
        config: the lattice.

    Returns:
        LatticeParams; feasible.
    """
    low, high = config.output_range
    if low is None:
        low = 0.0 if high is None else high - 1.0
    if high is None:
        high = low + 1.0
    index = np.indices(config.sizes)
    coin = jax.random.rademacher(key, (config.rank,), dtype=jnp.float32)
    plane = jnp.zeros(config.sizes)
    for axis, size in enumerate(config.sizes):
        fraction = jnp.asarray(index[axis] / (size - 1) - 0.5, jnp.float32)
        unimodal = config.unimodality[axis] if config.unimodality else 0
        if unimodal:
            centre = config.centre(axis)
            distance = np.abs(index[axis] - centre) / max(centre, size - 1 - centre) - 0.5
            plane = plane + jnp.asarray(unimodal * distance, jnp.float32)
        elif config.signs[axis]:
            plane = plane + float(config.signs[axis]) * fraction
        else:
            plane = plane + coin[axis] * fraction
    plane = low + (high - low) * (plane / config.rank + 0.5)
    return project(LatticeParams(plane), config)


def apply(
    params: LatticeParams, config: LatticeConfig, x: Float[Array, "*batch rank"]
) -> Float[Array, "*batch"]:
    r"""The interpolated output at `x`.

    Multilinear ("hypercube") interpolation weighs every vertex :math:`v` by

    .. math:: f(x) = \sum_v \theta_v \prod_d \max(0, 1 - |x_d - v_d|)

    simplex interpolation walks from the lower corner of the cell to the upper one along the
    inputs in falling order of their fractional parts :math:`r`,

    .. math:: f(x) = \theta_{p_0} + \sum_{k=1}^{D} r_{\pi(k)} (\theta_{p_k} - \theta_{p_{k-1}}),
        \qquad p_k = p_{k-1} + e_{\pi(k)}

    Symbols: :math:`\theta` is `params.vertices`; :math:`D` is the rank; :math:`\pi` sorts
    :math:`r`. Both agree on vertices and edges, and keep monotonicity and bounds.

    Args:
        params: of the lattice.
        config: of the lattice.
        x: inputs in lattice coordinates `[0, sizes - 1]`; clipped.

    Returns:
        The output, without the last axis of `x`.

    Raises:
        ValueError: the last axis of `x` is not the number of inputs.

    Source: Gupta et al. (2016), Monotonic calibrated interpolated look-up tables, sections 2-3.

    Example:
        >>> config = LatticeConfig((2, 2))
        >>> params = LatticeParams(jnp.array([[0.0, 1.0], [2.0, 3.0]]))
        >>> float(apply(params, config, jnp.array([0.5, 0.5])))
        1.5
    """
    require_width(x, config.rank, "grid.apply")
    if config.interpolation == "simplex":
        return _simplex(params.vertices, config, x)
    return _hypercube(params.vertices, config, x)


def _hypercube(v: Array, config: LatticeConfig, x: Array) -> Array:
    """Contract one axis after another, the largest product first as one matrix product."""
    batch = x.shape[:-1]
    lead = (1,) * len(batch)
    rest = math.prod(config.sizes)
    out = v
    for axis, size in enumerate(config.sizes):
        rest //= size
        at = jnp.clip(x[..., axis], 0.0, size - 1.0)[..., None]
        grid = jnp.arange(size, dtype=x.dtype).reshape(*lead, size)
        weights = jnp.maximum(1.0 - jnp.abs(at - grid), 0.0)
        if axis == 0:
            out = weights @ out.reshape(size, rest)
        else:
            out = jnp.sum(weights[..., None] * out.reshape(*batch, size, rest), axis=-2)
    return out.reshape(batch)


def _simplex(v: Array, config: LatticeConfig, x: Array) -> Array:
    sizes = np.asarray(config.sizes)
    strides = np.cumprod([1, *sizes[:0:-1]])[::-1]
    lead = (1,) * (x.ndim - 1)
    top = jnp.asarray((sizes - 1).reshape(*lead, -1), x.dtype)
    at = jnp.clip(x, 0.0, top)
    corner = jnp.minimum(jnp.floor(at), top - 1.0)
    fraction = at - corner
    order = jnp.argsort(-fraction, axis=-1)
    step = jnp.asarray(strides.reshape(*lead, -1), jnp.int32)
    start = jnp.sum(corner.astype(jnp.int32) * step, axis=-1, keepdims=True)
    steps = jnp.take_along_axis(jnp.broadcast_to(step, order.shape), order, axis=-1)
    walk = jnp.concatenate([start, start + jnp.cumsum(steps, axis=-1)], axis=-1)
    values = v.reshape(-1)[walk]
    ordered = jnp.take_along_axis(fraction, order, axis=-1)
    return values[..., 0] + jnp.sum(ordered * jnp.diff(values, axis=-1), axis=-1)


def project(
    params: LatticeParams, config: LatticeConfig, *, margin: float = MARGIN
) -> LatticeParams:
    """The nearest lattice that satisfies the constraints, by Dykstra and an exact last step.

    One family of constraints is projected in closed form. Several take `config.n_iterations`
    passes, which tend to the Euclidean projection; a last step then removes what violation is
    left, so that the result is feasible after any number of passes.

    Args:
        params: of the lattice.
        config: of the lattice.
        margin: slack to leave, in float32 epsilons of the largest vertex; 0 for none.

    Returns:
        LatticeParams with `check(...) == 0`.
    """
    v = params.vertices
    return LatticeParams(project_vertices(v, config.signs, config, tilt(v, margin)))


def check(params: LatticeParams, config: LatticeConfig) -> Float[Array, ""]:
    """Largest violation of any constraint; 0 where all hold."""
    return violation(params.vertices, config.signs, config)


def vertices(
    params: LatticeParams, config: LatticeConfig
) -> tuple[tuple[np.ndarray, ...], Float[Array, "*sizes"]]:
    """Coordinates along each input, and the table of outputs over them."""
    return tuple(np.arange(size, dtype=np.float32) for size in config.sizes), params.vertices
