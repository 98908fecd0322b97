"""Cheap signs of further regions: the opposite side of a known one, wide samples beside it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from failure.performances import Counted, Performance, check_rows

REACH = 1.7
"""Wide samples have a standard deviation at which the nearest region is this many away."""
SHORT = 0.8
"""A sample farther out along a region's axis than this share of its distance is the region's."""
HEART = 1.75
"""The heart of a region, in its distance along its axis."""
WAY = np.array([0.25, 0.5, 0.75])
"""Shares of the way to the heart that are looked at."""
MOST = 10
"""Samples that are looked at more closely."""


def check_scan(scan: int) -> None:
    """Refuse a number of wide samples below 0.

    Raises:
        ValueError: it is.
    """
    if scan < 0:
        raise ValueError(f"scan={scan}: expected a number of samples, 0 for none")


def fails(
    performance: Performance | Counted, threshold: float, x: Float[np.ndarray, "n D"]
) -> Bool[np.ndarray, " n"]:
    """Which rows fail; invalid ones do not.

    Raises:
        ValueError: outputs that are not one per row.
    """
    with jax.enable_x64(True):
        y = np.asarray(performance(x), np.float64)
    check_rows(y, x)
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
    r"""Whether :math:`-(\beta + 1/2)\, a` fails as well, of k regions, a simulation each.

    Where it does, the specification is a window.
    """
    return fails(performance, threshold, -(betas + 0.5)[:, None] * axes)


OPPOSITE = (
    "the opposite side fails as well: this is the probability of one region of several; use "
    "regions.probability_by_lines"
)
"""Verdict where it does."""


class Strangers(NamedTuple):
    """Failing wide samples that no known region explains, and the simulations that this took."""

    strange: int
    n_simulations: int


def explained(
    performance: Performance | Counted,
    threshold: float,
    x: Float[np.ndarray, " D"],
    axes: Float[np.ndarray, "k D"],
    betas: Float[np.ndarray, " k"],
) -> bool:
    r"""Whether a failing sample is of a known region: all fails between it and the region's heart.

    The region is the one along whose axis the sample lies farthest out, its heart
    :math:`1.75\,\beta a`; three points between are looked at. A boundary that bends has failures
    far beside its axis, and the way from them to its heart fails; to another region's it does not.
    """
    near = int(np.argmax((axes @ x) / betas))
    heart = HEART * betas[near] * axes[near]
    return bool(np.all(fails(performance, threshold, x + WAY[:, None] * (heart - x))))


def wide_strangers(
    performance: Performance | Counted,
    threshold: float,
    axes: Float[np.ndarray, "k D"],
    betas: Float[np.ndarray, " k"],
    n: int,
    *,
    key: Key[Array, ""],
) -> Strangers:
    r"""Failing wide samples that are `beside` the known regions and not `explained` by them.

    Samples are :math:`N(0, s^2 I)` with :math:`s = \beta / 1.7`, so that another region at the
    distance of the nearest holds one in 22 of them: of 100 samples one is missed in a hundred
    times. No more than `MOST` are looked at more closely.
    """
    if n == 0:
        return Strangers(0, 0)
    scale = wide_scale(float(np.min(betas)))
    with jax.enable_x64(True):
        x = scale * np.asarray(jax.random.normal(key, (n, axes.shape[1])))
    left = x[fails(performance, threshold, x) & beside(x, axes, betas)][:MOST]
    strange = sum(not explained(performance, threshold, one, axes, betas) for one in left)
    return Strangers(strange, n + len(WAY) * len(left))


def beside(
    x: Float[np.ndarray, "n D"], axes: Float[np.ndarray, "k D"], betas: Float[np.ndarray, " k"]
) -> Bool[np.ndarray, " n"]:
    """Samples short of most of the distance of every known region along its axis."""
    return np.all(x @ axes.T < SHORT * betas, axis=1)


def strangers_found(beside: int, scan: int) -> str:
    """The verdict where `beside` of `scan` wide samples fail."""
    return (
        f"{beside} of {scan} wide samples fail beside the region; use regions.probability_by_lines"
    )
