"""Cheap signs of further regions: the opposite side of a known one, wide samples beside it."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from failure.performances import Counted, Performance

REACH = 1.7
"""Wide samples have a standard deviation at which the nearest region is this many away."""


def fails(
    performance: Performance | Counted, threshold: float, x: Float[np.ndarray, "n D"]
) -> Bool[np.ndarray, " n"]:
    """Which rows fail; invalid ones do not."""
    with jax.enable_x64(True):
        y = np.asarray(performance(x), np.float64)
    return np.nan_to_num(y, nan=-np.inf, posinf=-np.inf) > threshold


def wide_scale(beta: float) -> float:
    """Standard deviation of wide samples, given the distance of the nearest region [sigma]."""
    return float(np.clip(beta / REACH, 1.5, 4.0))


def opposite_sides_fail(
    performance: Performance | Counted,
    threshold: float,
    axes: Float[np.ndarray, "k D"],
    betas: Float[np.ndarray, " k"],
) -> Bool[np.ndarray, " k"]:
    r"""Whether :math:`-(\beta + 1/2)\, a` fails as well, of k regions, a simulation each."""
    return fails(performance, threshold, -(betas + 0.5)[:, None] * axes)


def opposite_side_fails(
    performance: Performance | Counted,
    threshold: float,
    axis: Float[np.ndarray, " D"],
    beta: float,
) -> bool:
    """The same of one region: one simulation that shows a window."""
    return bool(opposite_sides_fail(performance, threshold, axis[None], np.array([beta]))[0])


OPPOSITE = (
    "the opposite side fails as well: this is the probability of one region of several; use "
    "regions.probability_by_lines"
)
"""Verdict where it does."""


def wide_strangers(
    performance: Performance | Counted,
    threshold: float,
    axis: Float[np.ndarray, " D"],
    beta: float,
    n: int,
    *,
    key: Key[Array, ""],
) -> int:
    r"""Failing wide samples short of half the region's distance along its axis.

    Samples are :math:`N(0, s^2 I)` with :math:`s = \beta / 1.7`, so that another region of the same
    distance holds one in 22 of them: of 100 samples one is missed in a hundred times.
    """
    scale = wide_scale(beta)
    with jax.enable_x64(True):
        x = scale * np.asarray(jax.random.normal(key, (n, len(axis))))
    return int(np.sum(fails(performance, threshold, x) & (x @ axis < 0.5 * beta)))
