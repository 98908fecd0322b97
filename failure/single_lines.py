"""Where lines meet the threshold, by one value each where that one lands close."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from failure.lines import BEND
from failure.performances import Counted

NEAR = 1.2
"""A step to the threshold of at most `NEAR / beta` is taken on trust: an error of a third of its
slope then changes the line's probability by a third."""

LONGEST = 1.5
"""Longest step along a line from one evaluation to the next [sigma]."""


def roots_by_values(
    counted: Counted,
    threshold: float,
    starts: Float[np.ndarray, "m D"],
    axis: Float[np.ndarray, " D"],
    beta: float,
    rate: float,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " k"]]:
    r"""Distances along `axis` at which lines meet the threshold; slopes that were measured.

    .. math:: t_i = \beta + \frac{T - y(v_i + \beta a)}{r}

    where that step is short, else secant steps on from there.

    Args:
        counted: evaluates.
        threshold: T.
        starts: :math:`v_i`, across the axis.
        axis: a, a unit vector.
        beta: where the threshold is expected.
        rate: expected slope along a.

    Returns:
        (distances `[m]`, NaN where outputs are invalid; slopes of lines with a second value).
    """
    t = np.full(len(starts), float(beta))
    y = counted(starts + t[:, None] * axis)
    step = (threshold - y) / rate
    near = NEAR / max(abs(beta), 1.0)
    slopes: list[float] = []
    for turn in range(5):
        rows = np.flatnonzero((np.abs(step) > near) & np.isfinite(y) & (t + step < beta + 6.0))
        if rows.size == 0:
            break
        move = np.clip(step[rows], -LONGEST, LONGEST)
        y_new = counted(starts[rows] + (t[rows] + move)[:, None] * axis)
        slope = (y_new - y[rows]) / move
        if turn == 0:
            slopes += slope[np.isfinite(slope)].tolist()
        t[rows], y[rows] = t[rows] + move, y_new
        step[rows] = (threshold - y_new) / np.where(slope > 0.2 * rate, slope, 0.2 * rate)
        # Two values bracket the slope: from here on only a long step is a guess.
        near = 0.5
    return np.where(np.isfinite(y), t + np.clip(step, -LONGEST, 2.0 * LONGEST), np.nan), np.array(
        slopes
    )


def room_for_bend(
    interval: tuple[float, float, float, float], bend: float
) -> tuple[float, float, float, float]:
    """The upper end with room for rare lines, missed at first, by the second-order formula.

    Source: Breitung (1984).
    """
    mean, lower, upper, effective = interval
    return mean, lower, min(1.0, upper / math.sqrt(1.0 - min(bend, BEND))), effective
