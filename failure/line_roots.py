"""Where lines meet the threshold, and how the boundary bends across them."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from failure.performances import Counted

STEP = 1.5
"""Longest step along a line from one evaluation to the next [sigma]."""


def curvature(
    across: np.ndarray, gradients: np.ndarray, axis: np.ndarray, rate: float
) -> tuple[float, np.ndarray]:
    r"""Largest curvature of the boundary and its direction, from the gradients of the lines.

    The gradient at :math:`v_i + \beta a` turns by :math:`K v_i`. Symmetric K of low rank is found
    on the span Q of the turns from :math:`Q^\top K v_i = (Q^\top K Q) Q^\top v_i`.
    """
    good = np.all(np.isfinite(gradients), axis=1)
    turns = gradients[good] / rate
    turns = turns - (turns @ axis)[:, None] * axis
    # What all turns share is a gradient that was not quite along the axis, not a curvature.
    turns = turns - turns.mean(0) * (len(turns) > 4)
    v = across[good] - across[good].mean(0) * (len(turns) > 4)
    if len(turns) < 3 or not np.any(np.abs(turns) > 1e-9):
        return 0.0, np.zeros(len(axis))
    _, size, right = np.linalg.svd(turns, full_matrices=False)
    rank = min(max(len(turns) // 3, 1), int(np.sum(size > 0.05 * size[0])))
    q = right[:rank]
    inner = np.linalg.lstsq(v @ q.T, turns @ q.T, rcond=1e-3)[0]
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    return float(values[-1]), vectors[:, -1] @ q


def bend_of_lines(t: Float[np.ndarray, " m"], middle: float) -> float:
    r"""How far the boundary bends towards nominal, in units of the sphere's curvature.

    Where it bends by :math:`\kappa` in k directions, lines end at :math:`\beta - \tfrac12 \kappa
    \chi^2_k`, nearer than the middle one by :math:`\tfrac12 \kappa k` with variance
    :math:`\tfrac12 \kappa^2 k`, so that

    .. math:: \kappa \beta = \beta\, \frac{\mathrm{var}(t)}{\beta - \bar t}

    A slanted boundary spreads the lines but moves their mean nowhere: where it lies within two
    standard errors of the middle, nothing is known and 0 comes back.

    Args:
        t: where lines end.
        middle: where the line through the middle ends, :math:`\beta`.
    """
    nearer, spread = middle - float(t.mean()), float(t.std(ddof=1))
    if not nearer > 2.0 * spread / math.sqrt(len(t)):
        return 0.0
    return middle * spread**2 / nearer


def line_roots(
    counted: Counted,
    threshold: float,
    across: Float[np.ndarray, "m D"],
    axis: Float[np.ndarray, " D"],
    beta: float,
    rate: float,
) -> tuple[Float[np.ndarray, " m"], int, Float[np.ndarray, "m D"]]:
    """Where lines meet the threshold, NaN where outputs are invalid; lines that run backwards.

    Third: gradients at the first point of each line, NaN without.
    """
    first = np.full(across.shape, np.nan)

    def at(t: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = across[rows] + t[:, None] * axis
        if counted.has_slopes:
            y, g = counted.slopes(x)
            fresh = ~np.isfinite(first[rows]).any(1)
            first[rows[fresh]] = g[fresh]
            return y, g @ axis
        return counted(x), np.full(len(x), np.nan)

    every = np.arange(len(across))
    t = np.full(len(across), beta)
    y, slope = at(t, every)
    if not counted.has_slopes:
        # The second value gives the slope; never closer than rounding would allow.
        move = np.clip((threshold - y) / rate, -STEP, STEP)
        move = np.where(np.abs(move) > 0.05, move, np.where(move < 0, -0.05, 0.05))
        t_new = t + np.nan_to_num(move, nan=0.05)
        y_new, _ = at(t_new, every)
        slope = (y_new - y) / (t_new - t)
        t, y = t_new, y_new
    backwards = int(np.sum(slope < 0.0))
    step = _newton(threshold, y, slope, rate)
    for _ in range(4):
        # A long last step is a guess: evaluate where it leads and step again.
        rows = np.flatnonzero((np.abs(step) > 0.5) & np.isfinite(y) & (t + step < beta + 6.0))
        if rows.size == 0:
            break
        t_new = t[rows] + np.clip(step[rows], -STEP, STEP)
        y_new, slope_new = at(t_new, rows)
        if not counted.has_slopes:
            slope_new = (y_new - y[rows]) / (t_new - t[rows])
        t[rows], y[rows], slope[rows] = t_new, y_new, slope_new
        step[rows] = _newton(threshold, y_new, slope_new, rate)
    roots = np.where(np.isfinite(y), t + np.clip(step, -STEP, 2.0 * STEP), np.nan)
    return roots, backwards, first


def _newton(threshold: float, y: np.ndarray, slope: np.ndarray, rate: float) -> np.ndarray:
    """Step to the threshold; where the line is flat, with a fifth of the design point's slope."""
    slope = np.where(slope > 0.2 * rate, slope, 0.2 * rate)
    return np.asarray((threshold - y) / slope)
