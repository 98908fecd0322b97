"""Linear layers with monotonicity, dominance and normalisation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fusion.lattice.checks import (
    refusal,
    require_count,
    require_key,
    require_static,
    require_width,
)
from fusion.lattice.projections import (
    dykstra,
    order_closure,
    order_depth,
    pair_projections,
    repair_order,
)
from fusion.lattice.rounding import working

# An equality (norm = 1) cannot be met to the last bit in floating point: `check` forgives this
# many epsilons per weight.
_NORM_TOLERANCE = 4.0


class LinearParams(NamedTuple):
    """`weights` `[n_outputs, n_inputs]`; `bias` `[n_outputs]`, or `None` without a bias."""

    weights: Array
    bias: Array | None = None


@dataclasses.dataclass(frozen=True)
class LinearConfig:
    """A linear layer whose weights obey constraints.

    Attributes:
        n_inputs: inputs.
        n_outputs: outputs, each with the same constraints unless `monotonicity` says otherwise.
        monotonicity: -1, 0 or +1 for each input (weights <= 0, free, >= 0), or one such tuple
            for each output.
        dominance: pairs `(strong, weak)` of inputs, both of the same non-zero monotonicity:
            the weight of the first is at least as large in magnitude.
        range_dominance: pairs `(strong, weak)`; weight times width of the input's range is at
            least as large for the first. Needs `input_range`.
        input_range: `(low, high)` for each input; only used by `range_dominance`.
        normalized: the magnitudes of the weights of each output sum to 1. With all inputs +1 the
            output is a weighted average of the inputs.
        connected: 0/1 for each output and input; weights at 0 are held at zero.
        bias: add a learned constant to each output.
        n_iterations: passes of Dykstra's algorithm, where the constraints need it.

    Raises:
        ValueError, TypeError: sizes, directions or pairs that mean nothing, by name and value.

    Example:
        >>> LinearConfig(3, monotonicity=(1, 1, 0), dominance=((0, 1),)).n_outputs
        1
    """

    n_inputs: int
    n_outputs: int = 1
    monotonicity: tuple[int, ...] | tuple[tuple[int, ...], ...] | None = None
    dominance: tuple[tuple[int, int], ...] = ()
    range_dominance: tuple[tuple[int, int], ...] = ()
    input_range: tuple[tuple[float, float], ...] | None = None
    normalized: bool = False
    connected: tuple[tuple[int, ...], ...] | None = None
    bias: bool = False
    n_iterations: int = 20

    def __post_init__(self) -> None:
        """Refuse sizes, directions and pairs that mean nothing."""
        require_static(self)
        for name in ("n_inputs", "n_outputs", "n_iterations"):
            require_count(name, getattr(self, name))
        shape = (self.n_outputs, self.n_inputs)
        if self.monotonicity is not None:
            signs = np.asarray(self.monotonicity)
            if signs.shape not in (shape, shape[1:]) or not np.isin(signs, (-1, 0, 1)).all():
                raise refusal(
                    "monotonicity",
                    self.monotonicity,
                    f"-1, 0 or 1 for each of {self.n_inputs} inputs, or such a tuple for each of "
                    f"{self.n_outputs} outputs",
                    "write 0 for free",
                )
        if self.connected is not None:
            links = np.asarray(self.connected)
            if links.shape != shape or not np.isin(links, (0, 1)).all() or not links.any(1).all():
                raise refusal(
                    "connected",
                    self.connected,
                    f"{shape[0]} tuples of {shape[1]} entries 0 or 1, at least one 1 in each",
                    "leave it out to connect all",
                )
        if self.range_dominance and (
            self.input_range is None or np.shape(self.input_range) != (self.n_inputs, 2)
        ):
            raise refusal(
                "input_range",
                self.input_range,
                f"a (low, high) pair for each of {self.n_inputs} inputs, which range_dominance "
                "needs",
                "give the ranges of the inputs",
            )
        signs = self.signs
        for strong, weak in (*self.dominance, *self.range_dominance):
            if not (0 <= strong < self.n_inputs and 0 <= weak < self.n_inputs):
                raise refusal(
                    "dominance",
                    (strong, weak),
                    f"two inputs of 0..{self.n_inputs - 1}",
                    "name inputs by their position",
                )
            if np.any(signs[:, strong] != signs[:, weak]) or np.any(signs[:, strong] == 0):
                raise refusal(
                    "dominance",
                    (strong, weak),
                    "two inputs of monotonicity +1, or both -1, not "
                    f"{signs[:, strong].tolist()} and {signs[:, weak].tolist()}",
                    "change monotonicity, or drop the pair",
                )
            if not np.array_equal(self.links[:, strong], self.links[:, weak]):
                raise refusal(
                    "dominance",
                    (strong, weak),
                    "two inputs that are connected to the same outputs",
                    "connect both or neither",
                )
        _dominance(self)

    @property
    def signs(self) -> np.ndarray:
        """`[n_outputs, n_inputs]` of -1, 0, 1."""
        signs = np.zeros(self.n_inputs) if self.monotonicity is None else self.monotonicity
        return np.broadcast_to(np.asarray(signs, np.int64), (self.n_outputs, self.n_inputs))

    @property
    def links(self) -> np.ndarray:
        """`[n_outputs, n_inputs]`: true where a weight may differ from zero."""
        shape = (self.n_outputs, self.n_inputs)
        return np.ones(shape, bool) if self.connected is None else np.asarray(self.connected) == 1


def init(key: Key[Array, ""], config: LinearConfig) -> LinearParams:
    """Weights of random size with the sign of their constraint, magnitudes summing to 1.

    Where an output has monotone and free inputs, each kind gets half of the sum, so that one
    constrained input is heard among many free ones.

    Args:
        key: PRNG key.
        config: the layer.

    Returns:
        LinearParams; feasible.
    """
    require_key(key)
    signs, links = config.signs, config.links
    sizes_key, signs_key = jax.random.split(key)
    sizes = jax.random.uniform(sizes_key, signs.shape, minval=0.5, maxval=1.5)
    coin = jax.random.rademacher(signs_key, signs.shape, dtype=sizes.dtype)
    monotone, free = (signs != 0) & links, (signs == 0) & links
    weights = jnp.zeros_like(sizes)
    for group, other in ((monotone, free), (free, monotone)):
        share = np.where(other.any(1, keepdims=True), 0.5, 1.0)
        part = jnp.where(group, sizes, 0.0)
        total = jnp.maximum(part.sum(axis=1, keepdims=True), 1e-9)
        weights = weights + part / total * jnp.asarray(share, sizes.dtype)
    weights = weights * jnp.where(signs == 0, coin, jnp.asarray(signs, sizes.dtype))
    bias = jnp.zeros(config.n_outputs, weights.dtype) if config.bias else None
    return project(config, LinearParams(weights, bias))


def apply(
    config: LinearConfig, params: LinearParams, x: Float[Array, "*batch n_inputs"]
) -> Float[Array, "*batch n_outputs"]:
    r"""Weighted sums of the inputs.

    .. math:: y_o = b_o + \sum_i w_{oi} x_i

    Args:
        config: of the layer.
        params: of the layer.
        x: inputs.

    Returns:
        The outputs.

    Raises:
        ValueError: the last axis of `x` is not `n_inputs`.
    """
    require_width(x, config.n_inputs, "linear.apply")
    weights = params.weights
    if config.connected is not None:
        weights = jnp.where(config.links, weights, 0.0)
    y = x @ weights.T
    if params.bias is not None:
        y = y + params.bias.reshape((1,) * (x.ndim - 1) + (-1,))
    return y


def _dominance(config: LinearConfig) -> tuple[np.ndarray, np.ndarray] | None:
    """Widths that turn all pairs into one partial order of scaled magnitudes, and its closure."""
    if not config.dominance and not config.range_dominance:
        return None
    width = np.ones(config.n_inputs)
    if config.range_dominance:
        if config.dominance:
            raise refusal(
                "range_dominance",
                config.range_dominance,
                "() beside dominance",
                "use one of the two (with equal ranges they mean the same)",
            )
        width = np.diff(np.asarray(config.input_range, np.float64), axis=-1)[:, 0]
        if not np.all(width > 0):
            raise refusal("input_range", config.input_range, "low < high", "exchange the two")
    pairs = [(weak, strong) for strong, weak in (*config.dominance, *config.range_dominance)]
    return width, order_closure(pairs, config.n_inputs)


def project(config: LinearConfig, params: LinearParams) -> LinearParams:
    r"""The nearest weights that satisfy the constraints.

    Signs are clipped; dominance pairs are half-spaces, solved together with the signs by
    Dykstra's algorithm and then repaired exactly. `normalized` is a projection (onto the
    simplex) where every input of an output is monotone, and a division by the norm otherwise,
    because the set :math:`\sum_i |w_i| = 1` is not convex then.

    Args:
        config: of the layer.
        params: of the layer.

    Returns:
        LinearParams with `check(...) == 0`.
    """
    signs, links = config.signs, config.links
    kind, w = params.weights.dtype, working(params.weights)
    sign = jnp.asarray(np.where(signs < 0, -1, 1), w.dtype)
    # In mirrored weights every constraint reads ">= 0" or "strong >= weak".
    v = jnp.where(links, w * sign, 0.0)

    def clip(v: Array) -> Array:
        return jnp.where(links & (signs == 0), v, jnp.maximum(v, 0.0))

    order = _dominance(config)
    simplex = config.normalized and bool(np.all((signs != 0) | ~links))
    if order is None:
        v = _simplex(v, links) if simplex else clip(v)
    else:
        width, closure = order
        strict = closure & ~np.eye(len(closure), dtype=bool)
        sets: list[Callable[[Array], Array]] = pair_projections(closure, width)
        sets.append((lambda v: _simplex(v, links)) if simplex else clip)
        v = clip(dykstra(v, sets, config.n_iterations))
        # Repair in u = w * width, where dominance is a partial order; then keep a slack that
        # survives the division by the width.
        scale = jnp.asarray(width[None, :], v.dtype)
        fixed = jnp.maximum(repair_order(v * scale, closure), 0.0)
        depth = jnp.asarray(order_depth(closure)[None, :], v.dtype)
        paired = np.logical_or(strict.any(0), strict.any(1))
        tied = jnp.asarray(paired[None, :] & links & (signs != 0))
        fixed = (fixed + _slack(kind, v * scale) * depth) / scale
        v = jnp.where(tied, fixed, v)
    if config.normalized:
        total = jnp.sum(jnp.abs(v), axis=-1, keepdims=True)
        # All weights at zero have no direction: start again from equal ones.
        equal = jnp.asarray(links / links.sum(1, keepdims=True), v.dtype)
        v = jnp.where(total > 1e-12, v / jnp.maximum(total, 1e-12), equal)
    return LinearParams((v * sign).astype(kind), params.bias)


def _slack(kind: np.dtype, values: Array) -> Array:
    """What dominance keeps above the rounding of weights, and of their products with widths."""
    units = 16.0 if kind in (jnp.float32, jnp.float64) else 4.0
    return units * float(jnp.finfo(kind).eps) * jnp.max(jnp.abs(values))


def _simplex(v: Array, links: np.ndarray) -> Array:
    """Projection of each row onto the probability simplex over its connected inputs."""
    n = v.shape[-1]
    low = jnp.where(links, v, -jnp.inf)
    ordered = -jnp.sort(-low, axis=-1)
    count = jnp.arange(1, n + 1, dtype=v.dtype)[None, :]
    finite = jnp.isfinite(ordered)
    sums = jnp.cumsum(jnp.where(finite, ordered, 0.0), axis=-1)
    threshold = jnp.where(finite & (ordered * count > sums - 1.0), (sums - 1.0) / count, -jnp.inf)
    return jnp.maximum(low - jnp.max(threshold, axis=-1, keepdims=True), 0.0)


def check(config: LinearConfig, params: LinearParams) -> Float[Array, ""]:
    """Largest violation of signs, dominance, connections and norm; 0 where all hold.

    The norm counts as 1 within rounding: a few epsilons for each weight.
    """
    kind, w = params.weights.dtype, working(params.weights)
    signs, links = config.signs, config.links
    v = w * jnp.asarray(np.where(signs < 0, -1, 1), w.dtype)
    worst = jnp.max(jnp.where(links, jnp.where(signs == 0, 0.0, -v), jnp.abs(v)))
    worst = jnp.maximum(worst, 0.0)
    order = _dominance(config)
    if order is not None:
        width, closure = order
        u = v * jnp.asarray(width[None, :], v.dtype)
        low, high = np.nonzero(closure & ~np.eye(len(closure), dtype=bool))
        worst = jnp.maximum(worst, jnp.max(u[:, low] - u[:, high]))
    if config.normalized:
        off = jnp.abs(jnp.sum(jnp.abs(v), axis=-1) - 1.0)
        allowed = _NORM_TOLERANCE * config.n_inputs * float(jnp.finfo(kind).eps)
        worst = jnp.maximum(worst, jnp.max(jnp.where(off > allowed, off, 0.0)))
    return worst
