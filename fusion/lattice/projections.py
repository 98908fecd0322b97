"""Projections that every layer shares: isotonic regression, partial orders, Dykstra's algorithm.

Shape constraints of lattice models are linear inequalities between neighbouring parameters. Each
family of them (monotone along one axis, one trust pair, the bounds) has a closed-form Euclidean
projection; `dykstra` combines several families into the projection onto their intersection.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from fusion.lattice.checks import refusal

# Longest axis for which `isotonic` is written out; chosen by timing 5 to 20 on one CPU thread.
_UNROLLED = 16


def isotonic(values: Float[Array, "*shape"], axis: int = -1) -> Float[Array, "*shape"]:
    r"""Euclidean projection onto the sequences that do not decrease along `axis`.

    .. math:: y_i = \max_{j \le i} \; \min_{k \ge i} \; \frac{1}{k - j + 1} \sum_{l=j}^{k} x_l

    Symbols: :math:`x` is `values`; :math:`y` is the result.

    The result is non-decreasing to the last bit: minima over shrinking and maxima over growing
    sets of the same numbers. Work and memory are quadratic in the length of the axis, without
    the data-dependent loop of the pool-adjacent-violators algorithm.

    Args:
        values: any shape.
        axis: the axis along which the result must not decrease.

    Returns:
        An array of the same shape.

    Source: Robertson, Wright and Dykstra (1988), Order Restricted Statistical Inference, the
    min-max formula of section 1.4.

    Example:
        >>> isotonic(jnp.array([0.0, 2.0, 1.0, 3.0])).tolist()
        [0.0, 1.5, 1.5, 3.0]
    """
    n = values.shape[axis]
    if n == 1:
        return values
    x = jnp.moveaxis(values, axis, 0)
    sums = jnp.cumsum(x, axis=0)
    before = sums - x
    lead = (1,) * (x.ndim - 1)
    if n <= _UNROLLED:
        # From the last position to the first, keep the smallest mean of every start j. On a CPU
        # this is about ten times as fast as the scan below, which compiles faster for long axes.
        smallest: Array | None = None
        y: list[Array] = []
        for i in reversed(range(n)):
            count = np.arange(i + 1, 0, -1).reshape(i + 1, *lead)
            means = (sums[i : i + 1] - before[: i + 1]) * jnp.asarray(1 / count, x.dtype)
            smallest = means if smallest is None else jnp.minimum(smallest[: i + 1], means)
            y.append(jnp.max(smallest, axis=0))
        return jnp.moveaxis(jnp.stack(y[::-1]), 0, axis)
    start, stop = np.indices((n, n))
    valid = jnp.broadcast_to(
        jnp.asarray((stop >= start).reshape(n, n, *lead)), (n, n, *x.shape[1:])
    )
    count = np.maximum(stop - start + 1, 1).reshape(n, n, *lead)
    means = (sums[None] - before[:, None]) * jnp.asarray(1 / count, x.dtype)
    after = lax.cummin(jnp.where(valid, means, jnp.inf), axis=1, reverse=True)
    return jnp.moveaxis(jnp.max(jnp.where(valid, after, -jnp.inf), axis=0), 0, axis)


def dykstra(
    values: Float[Array, "*shape"],
    projections: Sequence[Callable[[Float[Array, "*shape"]], Float[Array, "*shape"]]],
    n_iterations: int,
) -> Float[Array, "*shape"]:
    r"""Projection onto the intersection of convex sets by Dykstra's algorithm.

    .. math:: y^{(s)} = P_s(x + e^{(s)}), \qquad e^{(s)} \leftarrow x + e^{(s)} - y^{(s)},
        \qquad x \leftarrow y^{(s)}

    for the sets :math:`s` in turn, `n_iterations` times over all of them, in a `lax.scan`.

    Args:
        values: the point to project.
        projections: :math:`P_s`, the Euclidean projection onto each set.
        n_iterations: passes over all sets; one set needs none of this and is projected once.

    Returns:
        A point that tends to the projection as `n_iterations` grows. It may still violate the
        sets by the size of the last change.

    Source: Boyle and Dykstra (1986), A method for finding projections onto the intersection of
    convex sets in Hilbert spaces.
    """
    if not projections:
        return values
    if len(projections) == 1:
        return projections[0](values)

    def sweep(carry: tuple[Array, tuple[Array, ...]], _: None) -> tuple[tuple, None]:
        x, corrections = carry
        new = []
        for projection, correction in zip(projections, corrections, strict=True):
            moved = x + correction
            x = projection(moved)
            new.append(moved - x)
        return (x, tuple(new)), None

    start = (values, tuple(jnp.zeros_like(values) for _ in projections))
    (x, _), _ = lax.scan(sweep, start, None, length=n_iterations)
    return x


def order_closure(pairs: Sequence[tuple[int, int]], n: int) -> np.ndarray:
    """Transitive and reflexive closure of a partial order: `[i, j]` is true where i <= j.

    Raises:
        ValueError: a pair names an element outside `0..n-1`, or the pairs run in a circle.
    """
    closure = np.eye(n, dtype=bool)
    for low, high in pairs:
        if not (0 <= low < n and 0 <= high < n) or low == high:
            raise refusal(
                "order",
                (low, high),
                f"two different elements of 0..{n - 1}, the smaller one first",
                "name elements by their position",
            )
        closure[low, high] = True
    for middle in range(n):
        closure |= closure[:, middle, None] & closure[None, middle, :]
    circle = np.argwhere(np.triu(closure & closure.T, k=1))
    if len(circle):
        i, j = (int(v) for v in circle[0])
        raise refusal(
            "order",
            tuple(pairs),
            f"pairs without a circle, such as the one through {i} and {j}",
            "drop a pair",
        )
    return closure


def order_depth(closure: np.ndarray) -> np.ndarray:
    """Longest chain below each element: `closure [n, n]` to `[n]`, at least one more per pair."""
    n = len(closure)
    strict = closure & ~np.eye(n, dtype=bool)
    depth = np.zeros(n)
    for _ in range(n):
        depth = np.max(np.where(strict, depth[:, None] + 1, 0), axis=0, initial=0)
    return depth


def pair_projections(
    closure: np.ndarray, width: np.ndarray | None = None
) -> list[Callable[[Array], Array]]:
    """Projections onto the half-spaces `v[i] * width[i] <= v[j] * width[j]` of a partial order.

    Only direct neighbours in the order count, the rest follows. Pairs that share no element are
    projected at once, so that Dykstra's algorithm has few sets to go through.

    Args:
        closure: from `order_closure`.
        width: positive factor of each element; 1 without it.

    Returns:
        Functions from `[..., n]` to `[..., n]`.
    """
    n = len(closure)
    width = np.ones(n) if width is None else width
    strict = (closure & ~np.eye(n, dtype=bool)).astype(int)
    direct = (strict > 0) & (strict @ strict == 0)
    groups: list[list[tuple[int, int]]] = []
    for low, high in np.argwhere(direct).tolist():
        for group in groups:
            if not any({low, high} & set(pair) for pair in group):
                group.append((low, high))
                break
        else:
            groups.append([(low, high)])
    return [_pairs(group, width) for group in groups]


def _pairs(group: list[tuple[int, int]], width: np.ndarray) -> Callable[[Array], Array]:
    n = len(width)
    partner, role = np.arange(n), np.zeros(n)
    for low, high in group:
        partner[low], partner[high] = high, low
        role[low], role[high] = 1.0, -1.0
    gain = width / (width**2 + width[partner] ** 2)

    def project(v: Array) -> Array:
        lead = (1,) * (v.ndim - 1)
        own, sign, step = (
            jnp.asarray(a.reshape(*lead, n), v.dtype) for a in (width, role, role * gain)
        )
        scaled = v * own
        excess = jnp.maximum(sign * (scaled - scaled[..., partner]), 0.0)
        return v - step * excess

    return project


def repair_order(values: Float[Array, "*batch n"], closure: np.ndarray) -> Float[Array, "*batch n"]:
    """The mean of the smallest feasible point above `values` and the largest one below it.

    Exact to the last bit and equal to `values` where those are feasible already; not the
    Euclidean projection. Used to remove what Dykstra's algorithm has left.
    """
    n = len(closure)
    below = jnp.asarray(closure.T.reshape((1,) * (values.ndim - 1) + (n, n)))
    above = jnp.asarray(closure.reshape((1,) * (values.ndim - 1) + (n, n)))
    spread = jnp.broadcast_to(values[..., None, :], (*values.shape, n))
    shape = spread.shape
    highest = jnp.max(jnp.where(jnp.broadcast_to(below, shape), spread, -jnp.inf), axis=-1)
    lowest = jnp.min(jnp.where(jnp.broadcast_to(above, shape), spread, jnp.inf), axis=-1)
    return 0.5 * (highest + lowest)
