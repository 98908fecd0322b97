"""Constraints of a lattice as sets of inequalities: projection, repair, violation.

Works on one array of vertices `[*sizes]`. The directions of monotonicity may be a traced array, so
that lattices with different directions can share one vmapped program.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from fusion.lattice.half_spaces import half_spaces, shortfall
from fusion.lattice.interior import ORDER_SLACK
from fusion.lattice.lattice_config import LatticeConfig
from fusion.lattice.projections import dykstra, isotonic
from fusion.lattice.rounding import frame, onto, working

# Rounding to steps moves a vertex by half a step, and so does the arithmetic before it: both
# together take twice `2 * Relation.slack` from a row, in steps.
_SLACK = 4.0


def _part(v: Array, axis: int, start: int, stop: int) -> Array:
    return lax.slice_in_dim(v, start, stop, axis=axis)


def _monotone(axis: int, sign: Array | int) -> Callable[[Array], Array]:
    """Isotonic along `axis` where `sign` is +1, antitonic where -1, nothing where 0."""

    def project(v: Array) -> Array:
        if isinstance(sign, int):
            return isotonic(v * sign, axis) * sign
        return jnp.where(sign == 0, v, isotonic(v * sign, axis) * sign)

    return project


def _flank(axis: int, start: int, stop: int, sign: int) -> Callable[[Array], Array]:
    """Isotonic (antitonic for -1) on the vertices `start..stop-1` of `axis`."""

    def project(v: Array) -> Array:
        flank = isotonic(_part(v, axis, start, stop) * sign, axis) * sign
        n = v.shape[axis]
        return jnp.concatenate([_part(v, axis, 0, start), flank, _part(v, axis, stop, n)], axis)

    return project


def project_vertices(
    config: LatticeConfig,
    signs: np.ndarray | Array,
    v: Float[Array, "*sizes"],
) -> Float[Array, "*sizes"]:
    """Dykstra over the families of constraints, an exact repair, the bounds, whole steps.

    Args:
        config: sizes and the other constraints.
        signs: monotonicity of each axis `[rank]`. A numpy array tells which axes are free while
            tracing, so that they cost nothing; a traced array decides at run time.
        v: vertices.

    Returns:
        Vertices without violation, in the type of `v`.

    Raises:
        ValueError: the output range holds too few numbers of the type of `v`.
    """
    static = isinstance(signs, np.ndarray)
    axes: dict[int, Array | int] = {
        axis: int(signs[axis]) if static else signs[axis].astype(working(v).dtype)
        for axis in range(v.ndim)
        if not (static and signs[axis] == 0)
    }
    centres = {axis: sign for axis, sign in enumerate(config.unimodality or ()) if sign}
    sets = [_monotone(axis, sign) for axis, sign in axes.items()]
    for axis, bend in centres.items():
        sets.append(_flank(axis, 0, config.centre(axis) + 1, -bend))
        sets.append(_flank(axis, config.centre(axis), config.sizes[axis], bend))
    for relation in config.relations:
        sets += half_spaces(relation)

    if not sets and config.output_range == (None, None):
        return v
    kind, related = v.dtype, bool(config.relations)
    inside = config.interior.vertices if related else np.zeros(config.sizes)
    ties = config.interior.ties if related else None
    height = float(inside.max())
    least = (_SLACK + 1.0) * (height + 2.0) if related else 1.0
    place = frame(v, config.output_range, least=least)
    v = working(v) - place.centre
    slack = place.step * (_SLACK if related else 0.0)
    ramp = jnp.asarray(inside, v.dtype)
    floor = None if place.low is None else place.low - place.centre + slack
    ceiling = None if place.high is None else place.high - place.centre - slack * (height + 1.0)

    def clip(v: Array) -> Array:
        v = v if floor is None else jnp.maximum(v, floor)
        return v if ceiling is None else jnp.minimum(v, ceiling)

    # The clipped projection onto order constraints is the projection onto order and bounds; with
    # constraints between inputs it is not, and the bounds are one more set to iterate over.
    if related and (floor is not None or ceiling is not None):
        sets.append(clip)
    if ties is not None:
        sets.append(lambda v: _tie(v, ties))
    v = v - slack * ramp
    v = dykstra(v, sets, config.n_iterations)
    if len(sets) > 1:
        for axis, sign in axes.items():
            v = _repair_monotone(v, axis, sign)
        for axis, bend in centres.items():
            v = _repair_unimodal(v, axis, config.centre(axis), bend)
    v = clip(v)
    if ties is not None:
        v = _tie(v, ties)
    if related:
        v = _repair_relations(config, v, ramp / height, floor, ceiling)
    return onto(place, v + slack * ramp + place.centre).astype(kind)


def _repair_monotone(v: Array, axis: int, sign: Array | int) -> Array:
    """Mean of the running maximum and, from the other end, the running minimum: exact order.

    Keeps every order that holds along other axes.
    """
    u = v * sign
    up = lax.cummax(u, axis=axis)
    down = lax.cummin(u, axis=axis, reverse=True)
    fixed = 0.5 * (up + down) * sign
    return fixed if isinstance(sign, int) else jnp.where(sign == 0, v, fixed)


def _repair_unimodal(v: Array, axis: int, centre: int, sign: int) -> Array:
    """Running maximum of each flank of a valley from the centre outwards (minimum for a peak)."""
    n = v.shape[axis]
    u = v * sign
    left = lax.cummax(_part(u, axis, 0, centre + 1), axis=axis, reverse=True)
    right = lax.cummax(_part(u, axis, centre, n), axis=axis)
    return jnp.concatenate([left, _part(right, axis, 1, n - centre)], axis) * sign


def _tie(v: Array, ties: np.ndarray) -> Array:
    """The mean of each class of vertices that must be equal."""
    _, classes, members = np.unique(ties.ravel(), return_inverse=True, return_counts=True)
    sums = jax.ops.segment_sum(v.ravel(), classes, num_segments=len(members))
    return (sums / jnp.asarray(members, v.dtype))[classes].reshape(v.shape)


def _repair_relations(
    config: LatticeConfig, v: Array, target: Array, floor: Array | None, ceiling: Array | None
) -> Array:
    """Step towards a lattice inside all constraints, just far enough to end every violation."""
    bottom = jnp.min(v) if floor is None else floor
    top = jnp.max(v) if ceiling is None else ceiling
    room = (top - bottom) / jnp.asarray(config.interior.vertices.max(), v.dtype)
    worst = _disorder(config, config.signs, v) / jnp.asarray(ORDER_SLACK, v.dtype)
    for relation in config.relations:
        lack = shortfall(relation, v) / jnp.asarray(relation.slack[:, None], v.dtype)
        worst = jnp.maximum(worst, jnp.max(lack))
    rounding = 8 * jnp.finfo(v.dtype).eps * (jnp.abs(bottom) + jnp.abs(top))
    share = (worst + rounding) / (worst + rounding + room)
    target = bottom + (top - bottom) * target
    return v + jnp.where(worst > 0, share, 0.0) * (target - v)


def _disorder(config: LatticeConfig, signs: np.ndarray | Array, v: Array) -> Array:
    """Largest violation of monotonicity or unimodality, at least 0."""
    worst = jnp.zeros((), v.dtype)
    for axis in range(v.ndim):
        sign = jnp.asarray(signs[axis], v.dtype)
        worst = jnp.maximum(worst, jnp.max(-sign * jnp.diff(v, axis=axis)))
    for axis, direction in enumerate(config.unimodality or ()):
        centre = config.centre(axis)
        slopes = jnp.diff(v, axis=axis) * direction
        left = _part(slopes, axis, 0, centre)
        right = _part(slopes, axis, centre, v.shape[axis] - 1)
        worst = jnp.maximum(worst, jnp.max(left, initial=0.0))
        worst = jnp.maximum(worst, jnp.max(-right, initial=0.0))
    return worst


def violation(
    config: LatticeConfig, signs: np.ndarray | Array, v: Float[Array, "*sizes"]
) -> Float[Array, ""]:
    """Largest violation of any inequality between vertices, or of the bounds; 0 for none."""
    v = working(v)
    worst = _disorder(config, signs, v)
    for relation in config.relations:
        worst = jnp.maximum(worst, jnp.max(shortfall(relation, v)))
    low, high = config.output_range
    if low is not None:
        worst = jnp.maximum(worst, low - jnp.min(v))
    if high is not None:
        worst = jnp.maximum(worst, jnp.max(v) - high)
    return worst
