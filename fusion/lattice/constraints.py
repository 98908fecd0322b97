"""Constraints of a lattice as sets of inequalities: projection, repair, violation.

Works on one array of vertices `[*sizes]`. The directions of monotonicity may be a traced array, so
that lattices with different directions can share one vmapped program.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from fusion.lattice.lattice_config import LatticeConfig
from fusion.lattice.projections import dykstra, isotonic
from fusion.lattice.rounding import frame, onto, working


def interior(config: LatticeConfig, signs: np.ndarray | Array) -> np.ndarray | Array:
    """A lattice `[*sizes]` with slack >= 1 in every order and trust inequality, from 0 upwards."""
    index = np.indices(config.sizes).astype(np.float32)
    # A product of two centred indices is at most this steep; order terms must outweigh it.
    sizes = config.sizes
    steep = 1 + 0.5 * sum(max(sizes[m], sizes[c]) - 1 for m, c, _ in config.edgeworth_trust)
    shape = np.zeros(config.sizes, np.float32)
    for main, conditional, direction in config.edgeworth_trust:
        pair = [index[axis] - np.float32(0.5 * (sizes[axis] - 1)) for axis in (main, conditional)]
        shape = shape + np.float32(direction) * pair[0] * pair[1]
    for axis, sign in enumerate(config.unimodality or ()):
        shape = shape + np.float32(steep * sign) * np.abs(index[axis] - config.centre(axis))
    shape = shape - shape.min()
    for axis, size in enumerate(config.sizes):
        if isinstance(signs, np.ndarray):
            rising = index[axis] * np.maximum(signs[axis], 0)
            falling = (size - 1 - index[axis]) * np.maximum(-signs[axis], 0)
            shape = shape + np.float32(steep) * (rising + falling).astype(np.float32)
        else:
            traced = signs[axis].astype(jnp.float32)
            rising = index[axis] * jnp.maximum(traced, 0.0)
            falling = (size - 1 - index[axis]) * jnp.maximum(-traced, 0.0)
            shape = shape + np.float32(steep) * (rising + falling)
    return shape


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


def _mixed(v: Array, main: int, conditional: int) -> Array:
    """Second differences of all 2 x 2 cells of two axes."""
    return jnp.diff(jnp.diff(v, axis=main), axis=conditional)


def _trust(
    main: int, conditional: int, direction: int, first: tuple[int, int]
) -> Callable[[Array], Array]:
    """Trust in every second cell of two axes, from cell `first`: these cells share no vertex."""

    def project(v: Array) -> Array:
        mixed = _mixed(v, main, conditional) * direction
        chosen = np.zeros(mixed.shape, bool)
        where = [slice(None)] * v.ndim
        where[main], where[conditional] = slice(first[0], None, 2), slice(first[1], None, 2)
        chosen[tuple(where)] = True
        shift = jnp.where(chosen, 0.25 * direction * jnp.maximum(-mixed, 0.0), 0.0)
        for i in (0, 1):
            for j in (0, 1):
                padding = [(0, 0, 0)] * v.ndim
                padding[main], padding[conditional] = (i, 1 - i, 0), (j, 1 - j, 0)
                corner = lax.pad(shift, jnp.zeros((), v.dtype), padding)
                v = v + corner if i == j else v - corner
        return v

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
    for main, conditional, direction in config.edgeworth_trust:
        for i in range(min(2, config.sizes[main] - 1)):
            for j in range(min(2, config.sizes[conditional] - 1)):
                sets.append(_trust(main, conditional, direction, (i, j)))

    if not sets and config.output_range == (None, None):
        return v
    kind, trust = v.dtype, bool(config.edgeworth_trust)
    # Rounding four corners to steps bends a cell by two steps at most: trust keeps three.
    ramp = interior(config, signs) if trust else np.zeros(config.sizes, np.float32)
    least = 4.0 * (float(np.max(ramp)) + 2.0) if trust else 1.0
    place = frame(v, config.output_range, least=least)
    v = working(v) - place.centre
    slack = place.step * (3.0 if trust else 0.0)
    ramp = jnp.asarray(ramp, v.dtype)
    floor = None if place.low is None else place.low - place.centre + slack
    ceiling = (
        None if place.high is None else place.high - place.centre - slack * (jnp.max(ramp) + 1.0)
    )

    def clip(v: Array) -> Array:
        v = v if floor is None else jnp.maximum(v, floor)
        return v if ceiling is None else jnp.minimum(v, ceiling)

    # The clipped projection onto order constraints is the projection onto order and bounds; with
    # trust it is not, and the bounds are one more set to iterate over.
    if trust and (floor is not None or ceiling is not None):
        sets.append(clip)
    v = v - slack * ramp
    v = dykstra(v, sets, config.n_iterations)
    if len(sets) > 1:
        for axis, sign in axes.items():
            v = _repair_monotone(v, axis, sign)
        for axis, bend in centres.items():
            v = _repair_unimodal(v, axis, config.centre(axis), bend)
    v = clip(v)
    if trust:
        v = _repair_trust(config, v, ramp, floor, ceiling)
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


def _repair_trust(
    config: LatticeConfig, v: Array, ramp: Array, floor: Array | None, ceiling: Array | None
) -> Array:
    """Step towards a lattice inside all constraints, just far enough to end every violation."""
    bottom = jnp.min(v) if floor is None else floor
    top = jnp.max(v) if ceiling is None else ceiling
    target = bottom + (top - bottom) * ramp / jnp.max(ramp)
    slack = (top - bottom) / jnp.max(ramp)
    worst = _trust_violation(config, v)
    rounding = 8 * jnp.finfo(v.dtype).eps * (jnp.abs(bottom) + jnp.abs(top))
    share = (worst + rounding) / (worst + rounding + slack)
    return v + jnp.where(worst > 0, share, 0.0) * (target - v)


def _trust_violation(config: LatticeConfig, v: Array) -> Array:
    worst = jnp.zeros((), v.dtype)
    for main, conditional, direction in config.edgeworth_trust:
        worst = jnp.maximum(worst, jnp.max(-direction * _mixed(v, main, conditional)))
    return worst


def violation(
    config: LatticeConfig, signs: np.ndarray | Array, v: Float[Array, "*sizes"]
) -> Float[Array, ""]:
    """Largest violation of any inequality between vertices, or of the bounds; 0 for none."""
    v = working(v)
    worst = _trust_violation(config, v)
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
    low, high = config.output_range
    if low is not None:
        worst = jnp.maximum(worst, low - jnp.min(v))
    if high is not None:
        worst = jnp.maximum(worst, jnp.max(v) - high)
    return worst
