"""Convex and concave calibrators: curvature of keypoints, and projection onto its sign."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from fusion.lattice.projections import dykstra, isotonic
from fusion.lattice.rounding import Frame

# Rounding to steps bends by one step at most, and so little more comes from the arithmetic.
_SLACK = 4.0


def _chords(where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the left and right neighbour in the chord over each inner keypoint."""
    gaps = np.diff(where, axis=-1)
    total = gaps[:, :-1] + gaps[:, 1:]
    return gaps[:, 1:] / total, gaps[:, :-1] / total


def curvature(
    y: Float[Array, "n_inputs n_keypoints"], where: np.ndarray
) -> Float[Array, "n_inputs n_inner"]:
    r"""How far each inner keypoint lies below the chord of its neighbours.

    .. math:: h_i = \frac{d_i\, y_{i-1} + d_{i-1}\, y_{i+1}}{d_{i-1} + d_i} - y_i, \qquad
        d_i = k_{i+1} - k_i

    Args:
        y: outputs at the keypoints.
        where: positions :math:`k` of the keypoints.

    Returns:
        :math:`h`, nowhere negative for a convex calibrator.
    """
    left, right = (jnp.asarray(w, y.dtype) for w in _chords(where))
    return left * y[:, :-2] + right * y[:, 2:] - y[:, 1:-1]


def bent(where: np.ndarray, signs: np.ndarray, bends: np.ndarray) -> tuple[np.ndarray, float]:
    """Parabolas inside all constraints, from 0 upwards, and the steps that bounds must leave.

    Args:
        where: positions `[n_inputs, n_keypoints]` of the keypoints.
        signs: monotonicity `[n_inputs]`.
        bends: convexity `[n_inputs]`.

    Returns:
        `(ramp, least)`: outputs `[n_inputs, n_keypoints]` whose neighbours differ by 1 and whose
        curvature is 1 at least (0 in rows without convexity); smallest number of steps.
    """
    if not np.any(bends):
        return np.zeros(where.shape), 1.0
    t = (where - where[:, :1]) / (where[:, -1:] - where[:, :1])
    rising = signs * bends
    base = np.where(rising[:, None] > 0, t, np.where(rising[:, None] < 0, 1 - t, t - 0.5))
    scale = 1.0 / np.min(np.diff(t, axis=-1), axis=-1, keepdims=True) ** 2
    ramp = bends[:, None] * base**2 * scale
    ramp = ramp - ramp.min(axis=-1, keepdims=True)
    return ramp, _SLACK * (float(ramp.max()) + 2.0)


def _shift(where: np.ndarray, bends: np.ndarray, first: int) -> Callable[[Array], Array]:
    """Curvature at every third inner keypoint, from `first`: these share no keypoint."""
    left, right = _chords(where)
    norm = left**2 + right**2 + 1.0
    chosen = np.zeros(left.shape, bool)
    chosen[bends != 0, first::3] = True

    def project(y: Array) -> Array:
        sign = jnp.asarray(bends[:, None], y.dtype)
        fault = jnp.minimum(sign * curvature(y, where), 0.0)
        move = jnp.where(chosen, -sign * fault / jnp.asarray(norm, y.dtype), 0.0)
        zero = jnp.zeros((), y.dtype)

        def place(part: Array, before: int) -> Array:
            return lax.pad(part, zero, [(0, 0, 0), (before, 2 - before, 0)])

        sides = place(move * jnp.asarray(left, y.dtype), 0) + place(
            move * jnp.asarray(right, y.dtype), 2
        )
        return y + sides - place(move, 1)

    return project


def project_bent(
    y: Float[Array, "n_inputs n_keypoints"],
    place: Frame,
    where: np.ndarray,
    signs: np.ndarray,
    bends: np.ndarray,
    ramp: np.ndarray,
    *,
    n_iterations: int,
) -> Float[Array, "n_inputs n_keypoints"]:
    """Rows that are monotone, convex and within bounds, near `y`; not yet in whole steps.

    Args:
        y: outputs.
        place: steps and bounds of each row.
        where: positions of the keypoints.
        signs: monotonicity of each row.
        bends: convexity of each row.
        ramp: of `bent`.
        n_iterations: passes of Dykstra's algorithm.

    Returns:
        Outputs, feasible with a slack of some steps in rows with convexity.
    """
    y = y.astype(place.centre.dtype) - place.centre
    rise = jnp.asarray(ramp, y.dtype)
    slack = place.step * jnp.asarray(_SLACK * np.abs(bends)[:, None], y.dtype)
    sign = jnp.asarray(np.where(signs < 0, -1, 1)[:, None], y.dtype)
    ordered = np.broadcast_to(signs[:, None] != 0, y.shape)
    floor = None if place.low is None else place.low - place.centre + slack
    top = jnp.max(rise, axis=-1, keepdims=True) + 1.0
    ceiling = None if place.high is None else place.high - place.centre - slack * top

    def monotone(y: Array) -> Array:
        return jnp.where(ordered, isotonic(y * sign) * sign, y)

    def clip(y: Array) -> Array:
        y = y if floor is None else jnp.maximum(y, floor)
        return y if ceiling is None else jnp.minimum(y, ceiling)

    n_inner = y.shape[-1] - 2
    sets = [_shift(where, bends, first) for first in range(min(3, n_inner))]
    sets += [monotone] if np.any(signs) else []
    sets += [clip] if floor is not None or ceiling is not None else []
    y = clip(monotone(dykstra(y - slack * rise, sets, n_iterations)))
    if n_inner < 1:
        return y + slack * rise + place.centre
    # Step towards the parabola, just far enough to end every fault of the row.
    bottom = jnp.min(y, axis=-1, keepdims=True) if floor is None else floor
    top_of = jnp.max(y, axis=-1, keepdims=True) if ceiling is None else ceiling
    height = top_of - bottom
    peak = jnp.maximum(jnp.max(rise, axis=-1, keepdims=True), 1.0)
    fault = -jnp.asarray(bends[:, None], y.dtype) * curvature(y, where)
    worst = jnp.maximum(jnp.max(fault, axis=-1, keepdims=True), 0.0)
    rounding = 0.5 * place.step
    share = (worst + rounding) / (worst + rounding + height / peak)
    moved = y + jnp.where(worst > 0, share, 0.0) * (bottom + height * rise / peak - y)
    return moved + slack * rise + place.centre
