"""Line sampling by values alone: differences at nominal, again where they matter, then lines."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from failure.descents import Descent, by_values, cosine_of
from failure.estimates import GOOD, Estimate, check_threshold
from failure.line_roots import bend_of_lines
from failure.lines import BEND, interval_of_lines
from failure.opposite import (
    OPPOSITE,
    check_scan,
    opposite_sides_fail,
    strangers_found,
    wide_strangers,
)
from failure.performances import Counted, Performance
from failure.single_lines import room_for_bend, roots_by_values
from failure.tilted_plane import TiltedPlane
from failure.turned_slopes import SHARE, Slope, again_where_it_matters

GROWN = 2.0
"""A slope that grew or fell by more on the way to the threshold has most likely turned as well."""

LOOSE = 0.1
"""Steps end this near to the threshold, in units of its way from nominal: lines see the rest."""

NEAR = 1.0
"""...and this near to the plane's own nearest point [sigma]."""

TURNED = 0.7
"""Cosine of the slopes at nominal and at the threshold below which another mechanism took over."""


def guided_lines(
    performance: Performance,
    threshold: float,
    dim: int,
    *,
    key: Key[Array, ""],
    step: float = 0.5,
    share: float = SHARE,
    batch: int = 2,
    factor: float = 2.0,
    min_lines: int = 10,
    scan: int = 100,
    most: int = 400,
) -> tuple[Estimate, Float[np.ndarray, " D"], float]:
    r"""Probability of the region that slopes lead to, by values alone.

    Forward differences at nominal and steps to the threshold with Broyden's update. Where the slope
    has doubled or halved on the way it has most likely turned: differences are taken again there
    along the parameters that hold `share` of it. Then lines, each from where a plane expects the
    threshold; one value is a line where it lands close. After each batch the plane is corrected by
    all lines (ridge regression), so that the lines themselves turn their direction. Where the first
    lines (1.6 `min_lines`) disagree so much that D more would not do, all differences are taken
    again and lines begin anew. Each line stands for itself,

    .. math:: \hat p = \frac1m \sum_i \Phi(-t_i), \qquad y(v_i + t_i a_i) = T, \quad
        v_i \perp a_i

    so a direction that is a little off costs lines, not truth.

    The verdict is not "good", and the upper end 1, when the opposite side fails too (one more
    simulation), when the slope at the threshold belongs to another mechanism than at nominal, and
    when one of `scan` wide samples fails beside the region. Without `scan` a further region that
    shows neither way is not seen: the estimate is that of one mechanism.

    Args:
        performance: `x [n, D] -> y [n]`, larger is worse.
        threshold: failure is `y > threshold`.
        dim: D.
        key: random key.
        step: of the differences [sigma].
        share: of the squared slope along whose parameters differences are taken again.
        batch: lines between two corrections.
        factor: wanted half width of the interval, as a ratio.
        min_lines: lines at least.
        scan: wide samples that look for other regions; 100 see one of the same distance with 99 %,
            0 trusts that there is one mechanism.
        most: simulations at most, those of `scan` not included.

    Returns:
        (Estimate, whose `n_simulations` is everything spent; the last design point; simulations up
        to the first failing one, NaN).

    Raises:
        ValueError: a threshold that is not finite, a factor not above 1, a share that is not in
            (0, 1], a budget below D + 30, a scan below 0.

    Source: Koutsourelakis, Pradlwarter and Schueller (2004); de Angelis, Patelli and Beer (2015)
    for lines whose direction is updated.
    """
    check_threshold(threshold)
    check_scan(scan)
    if not factor > 1.0:
        raise ValueError(f"factor={factor}: expected a ratio above 1")
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share={share}: expected a number in (0, 1]")
    if most < dim + 30:
        raise ValueError(f"most={most}: expected at least {dim + 30}, D + 30 simulations")
    counted = Counted(performance)
    descent = Descent(counted, float(threshold), step, math.inf)
    origin = np.zeros(dim)
    y, nominal = descent.both(origin)
    descent.nominal = y
    if not y < threshold or not np.any(nominal):
        why = "the output does not vary at nominal" if y < threshold else "the nominal point fails"
        return _unknown(counted, why), np.full(dim, np.nan), descent.first
    u, y, g = by_values(descent, origin, y, nominal, 12, gap=LOOSE, near=NEAR)
    if abs(y - threshold) > 0.5 * descent.scale():
        why = f"the threshold is not reached within {np.linalg.norm(u):.1f} sigma"
        return _unknown(counted, why), u, descent.first
    end = Slope(u, y, g, np.zeros(dim, bool), 1.0)
    grown = float(g @ nominal) / float(nominal @ nominal)
    if not 1.0 / GROWN < grown < GROWN:
        end = again_where_it_matters(descent, nominal, u, y, g, share=share)
        u, y, g = by_values(descent, u, y, end.gradient, 6, gap=LOOSE, near=NEAR)
        end = end._replace(point=u, value=y, gradient=g)
    found, end = _lines(descent, end, nominal, key, batch, factor, min_lines, most)
    return _judge(descent, end, found, factor, scan, jax.random.fold_in(key, 1))


class _Found(NamedTuple):
    """What the lines say, and along which axis the last ones ran."""

    distances: list[float]
    backwards: int
    narrow: bool
    interval: tuple[float, float, float, float]
    axis: np.ndarray
    beta: float
    bend: float


def _lines(
    descent: Descent,
    end: Slope,
    nominal: np.ndarray,
    key: Array,
    batch: int,
    factor: float,
    min_lines: int,
    most: int,
) -> tuple[_Found, Slope]:
    """Lines until the interval is narrow; all differences once more where the first disagree."""
    counted, threshold, dim = descent.counted, descent.threshold, len(nominal)
    with jax.enable_x64(True):
        draws = np.asarray(jax.random.normal(key, (most, dim)))
    distances: list[float] = []
    backwards, again, narrow = 0, False, False
    interval, bend = (math.nan, 0.0, 1.0, 0.0), 0.0
    plane, begun = TiltedPlane(end.point, end.value, end.gradient, end.fresh), counted.n_values
    axis = end.gradient / np.linalg.norm(end.gradient)
    beta = float(np.linalg.norm(end.point))
    middle, _ = roots_by_values(
        counted, threshold, np.zeros((1, dim)), axis, beta, float(np.linalg.norm(end.gradient))
    )
    while counted.n_values + 3 * batch <= most and not narrow:
        x, values = counted.samples()
        value, g = plane.corrected(x[begun:], values[begun:])
        rate = max(float(np.linalg.norm(g)), 1e-300)
        axis = g / rate
        beta = float(end.point @ axis) + (threshold - value) / rate
        rows = draws[len(distances) : len(distances) + batch]
        rows = rows - (rows @ axis)[:, None] * axis
        t, slopes = roots_by_values(counted, threshold, rows, axis, beta, rate)
        distances += t.tolist()
        backwards += int(np.sum(slopes < 0.0))
        good = np.array(distances)[np.isfinite(distances)]
        if len(good) >= min_lines:
            bend = bend_of_lines(good, float(middle[0]))
            interval = room_for_bend(interval_of_lines(good), bend)
            mean, lower, upper, _ = interval
            narrow = mean > 0.0 and upper <= factor * mean and lower >= mean / factor
            room = counted.n_values + dim + 4 * batch <= most
            dear = _lines_to_come(interval, len(good), factor) > dim
            if not narrow and not again and len(good) >= 1.6 * min_lines and dear and room:
                again, distances, backwards = True, [], 0
                fresh = counted.differences(end.point, end.value, descent.step)
                turn = min(end.turn, cosine_of(fresh, nominal))
                u, y, g = by_values(descent, end.point, end.value, fresh, 6)
                end = Slope(u, y, g, np.ones(dim, bool), turn)
                plane, begun = TiltedPlane(u, y, g, end.fresh), counted.n_values
    return _Found(distances, backwards, narrow, interval, axis, beta, bend), end


def _lines_to_come(interval: tuple[float, float, float, float], lines: int, factor: float) -> float:
    """How many more lines it takes to narrow an interval whose width falls with their root."""
    mean, lower, upper, _ = interval
    if not lower > 0.0:
        return math.inf
    width = max(math.log(upper / mean), math.log(mean / lower)) / math.log(factor)
    return lines * (width**2 - 1.0)


def _judge(
    descent: Descent, end: Slope, found: _Found, factor: float, scan: int, key: Array
) -> tuple[Estimate, np.ndarray, float]:
    """Interval, verdict, design point, simulations to the first failure."""
    counted, threshold = descent.counted, descent.threshold
    lines, valid = len(found.distances), int(np.isfinite(found.distances).sum())
    mean, lower, upper, effective = found.interval
    reasons, further = [], []
    if not found.narrow:
        reasons.append(
            f"after {lines} lines the interval is still wider than a factor {factor:g}: the "
            "boundary bends or has several regions; use subset_simulation beside it"
        )
    if effective < 4.0:
        reasons.append(f"only {effective:.1f} effective lines; raise min_lines")
        lower, upper = 0.0, 1.0
    if valid < 0.9 * lines:
        reasons.append(f"{lines - valid} of {lines} lines have invalid outputs")
    if found.backwards > 0.1 * lines:
        reasons.append(f"{found.backwards} of {lines} lines run backwards")
    if found.bend > BEND:
        further.append(
            f"lines meet the threshold nearer than their middle does, by amounts that differ: the "
            f"boundary bends towards nominal ({found.bend:.2f} of the sphere's curvature); use "
            "subset_simulation beside it"
        )
    region = found.axis[None], np.array([found.beta])
    if opposite_sides_fail(counted, threshold, *region)[0]:
        further.append(OPPOSITE)
    if end.turn < TURNED:
        further.append(
            f"the slope at nominal belongs to another mechanism (cosine {end.turn:.2f}) that may "
            "fail as well; use regions.probability_by_lines"
        )
    if beside := wide_strangers(counted, threshold, *region, scan, key=key).strange:
        further.append(strangers_found(beside, scan))
    if further:
        # What else fails is not known, so neither is an upper end.
        upper = 1.0
    estimate = Estimate(
        mean, lower, upper, counted.n_values, counted.n_invalid, effective,
        "; ".join([*reasons, *further]) or GOOD,
    )  # fmt: skip
    return estimate, found.beta * found.axis, _first_failure(counted, threshold)


def _first_failure(counted: Counted, threshold: float) -> float:
    """Simulations up to the first failing one, NaN."""
    failed = np.flatnonzero(np.nan_to_num(counted.samples()[1], nan=-np.inf) > threshold)
    return float(failed[0] + 1) if failed.size else math.nan


def _unknown(counted: Counted, why: str) -> Estimate:
    return Estimate(math.nan, 0.0, 1.0, counted.n_values, counted.n_invalid, 0.0, why)
