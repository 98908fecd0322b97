"""Line sampling: the probability by lines along the design direction, to a wanted precision."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from failure.estimates import GOOD, Estimate, check_threshold, mean_of_terms
from failure.hlrf import DesignPoint
from failure.line_roots import bend_of_lines, curvature, line_roots
from failure.opposite import (
    OPPOSITE,
    check_scan,
    opposite_sides_fail,
    strangers_found,
    wide_strangers,
)
from failure.performances import Counted, Performance, Slopes

BEND = 0.8
"""A boundary that bends towards nominal as the sphere does (1) or more has nearer failures beside
the point; below this its lines are safe."""


class Lines(NamedTuple):
    r"""Result of `sample_lines`.

    Attributes:
        estimate: of the region of the design point.
        bend: largest curvature of the boundary times beta, NaN without gradients; at 1 and above
            the point is no nearest one but a saddle.
        direction: `[D]`, in which it bends most.
    """

    estimate: Estimate
    bend: float
    direction: Float[np.ndarray, " D"]


def line_sampling(
    performance: Performance,
    threshold: float,
    design: DesignPoint,
    *,
    key: Key[Array, ""],
    slopes: Slopes | None = None,
    factor: float = 2.0,
    min_lines: int = 10,
    max_lines: int = 200,
    scan: int = 100,
) -> Estimate:
    r"""Probability of the region of a design point.

    .. math:: \hat p = \frac1m \sum_{i=1}^m \Phi(-t_i), \qquad y(v_i + t_i a) = T

    with :math:`a` the gradient's direction at the design point and :math:`v_i` normal in the
    plane across it. With gradients a line costs one evaluation: a Newton step along it from
    :math:`t = \beta`; a second one where that step is long. With values only it costs two or three
    (secant). Lines are added until the 95 % interval reaches no farther than `factor` to either
    side.

    The verdict is not "good", and the interval withheld or widened, when the design point failed
    its checks, when the interval did not get narrow, when few lines carry the sum, when outputs
    are invalid, when lines run backwards (their output falls along `a`), when the side opposite
    to the design point fails too, which costs one value, and when one of `scan` wide samples fails
    beside the region.

    Args:
        performance: `x [n, D] -> y [n]`, larger is worse.
        threshold: failure is `y > threshold`.
        design: from `find_design_point`.
        key: random key.
        slopes: `x [n, D] -> (y [n], dy/dx [n, D])`.
        factor: wanted half width of the interval, as a ratio.
        min_lines: lines at least.
        max_lines: lines at most.
        scan: wide samples that look for other regions; 100 see one of the same distance with 99 %,
            0 trusts that there is one mechanism.

    Returns:
        Estimate of the region of this design point alone, see `failure.regions` for all of them;
        `n_simulations` counts values and gradients of the lines and the scan alike, those of the
        design point not included.

    Raises:
        ValueError: a threshold that is not finite, a factor not above 1, impossible lines, a scan
            below 0.

    Source: Koutsourelakis, Pradlwarter and Schueller (2004).
    """
    check_scan(scan)
    found = sample_lines(
        performance, threshold, design, key=key, slopes=slopes, factor=factor,
        min_lines=min_lines, max_lines=max_lines,
    ).estimate  # fmt: skip
    if not math.isfinite(found.probability):
        return found
    region = design.axis[None], np.array([design.beta])
    further = []
    if opposite_sides_fail(performance, threshold, *region)[0]:
        further.append(OPPOSITE)
    seen = wide_strangers(performance, threshold, *region, scan, key=jax.random.fold_in(key, 1))
    if seen.strange:
        further.append(strangers_found(seen.strange, scan))
    if further:
        reasons = [] if found.known else [found.verdict]
        found = found._replace(upper=1.0, verdict="; ".join([*reasons, *further]))
    return found._replace(n_simulations=found.n_simulations + 1 + seen.n_simulations)


def sample_lines(
    performance: Performance,
    threshold: float,
    design: DesignPoint,
    *,
    key: Key[Array, ""],
    slopes: Slopes | None = None,
    factor: float = 2.0,
    min_lines: int = 10,
    max_lines: int = 200,
) -> Lines:
    """`line_sampling` with what its gradients say about the boundary's curvature."""
    check_threshold(threshold)
    if not factor > 1.0:
        raise ValueError(f"factor={factor}: expected a ratio above 1")
    if not 3 <= min_lines <= max_lines:
        raise ValueError(
            f"min_lines={min_lines}, max_lines={max_lines}: expected 3 <= min_lines <= max_lines"
        )
    counted = Counted(performance, slopes)
    if not np.all(np.isfinite(design.gradient)) or not np.any(design.gradient):
        nothing = Estimate(math.nan, 0.0, 1.0, 0, 0, 0.0, f"no design point: {design.verdict}")
        return Lines(nothing, math.nan, np.full(len(design.point), math.nan))
    axis, rate = design.axis, float(np.linalg.norm(design.gradient))
    with jax.enable_x64(True):
        across = np.asarray(jax.random.normal(key, (max_lines, len(axis))))
    across = across - (across @ axis)[:, None] * axis
    distances = np.full(max_lines, np.nan)
    backwards = lines = 0
    narrow, slopes_seen = False, []
    while lines < max_lines and not narrow:
        rows = slice(lines, min_lines if lines == 0 else lines + 1)
        t, back, turned = line_roots(
            counted, float(threshold), across[rows], axis, design.beta, rate
        )
        slopes_seen.append(turned)
        distances[rows] = t
        backwards += back
        lines += len(t)
        good = distances[:lines][np.isfinite(distances[:lines])]
        if len(good) >= min_lines:
            mean, low, high, _ = interval_of_lines(good)
            narrow = mean > 0.0 and high <= factor * mean and low >= mean / factor
    bend, direction = math.nan, np.full(len(axis), math.nan)
    if counted.has_slopes:
        bend, direction = curvature(across[:lines], np.concatenate(slopes_seen), axis, rate)
        bend *= design.beta
    seen = bend
    if not counted.has_slopes and np.isfinite(distances[:lines]).sum() >= 3:
        seen = bend_of_lines(distances[:lines][np.isfinite(distances[:lines])], design.beta)
    found = _judge(design, distances[:lines], counted, backwards, narrow, factor, seen)
    return Lines(found, bend, direction)


STOPPING = 1.25
"""Intervals are wider by this power than Student's t: lines end when they happen to look alike.

Measured on bent boundaries with 10 lines: 95 % covered, against 91 % without.
"""


def interval_of_lines(t: np.ndarray) -> tuple[float, float, float, float]:
    """Mean probability of lines that end at `t`, its interval, effective number of lines."""
    from scipy.special import ndtr

    mean, lower, upper, effective = mean_of_terms(ndtr(-t))
    if mean > 0.0:
        lower = mean * (lower / mean) ** STOPPING
        upper = min(1.0, mean * (upper / mean) ** STOPPING)
    # One step per line leaves a rest that the spread of the lines does not show.
    lower, upper = min(lower, mean / 1.01), max(upper, min(1.0, mean * 1.01))
    return mean, lower, upper, effective


def _judge(
    design: DesignPoint,
    distances: np.ndarray,
    counted: Counted,
    backwards: int,
    narrow: bool,
    factor: float,
    bend: float,
) -> Estimate:
    """Interval and verdict."""
    cost = counted.n_values + counted.n_gradients
    good = distances[np.isfinite(distances)]
    lines, reasons = len(distances), []
    if len(good) < 3:
        return Estimate(
            math.nan, 0.0, 1.0, cost, counted.n_invalid, 0.0,
            f"only {len(good)} of {lines} lines have finite outputs",
        )  # fmt: skip
    mean, lower, upper, effective = interval_of_lines(good)
    if not narrow:
        reasons.append(
            f"after {lines} lines the interval is still wider than a factor {factor:g}; the "
            "boundary bends or has several regions: use subset_simulation beside it"
        )
    if 0.0 < bend <= BEND:
        # Where the boundary bends, rare lines carry much and are missed at first: room for what
        # the second-order formula says (Breitung 1984).
        upper = min(1.0, upper / math.sqrt(1.0 - bend))
    if bend > BEND:
        reasons.append(
            f"the boundary bends towards nominal ({bend:.2f} of the sphere's curvature): there are "
            "nearer or further failures beside the point; use regions.probability_by_lines or "
            "subset_simulation"
        )
        lower, upper = min(lower, mean), 1.0
    if effective < 4.0:
        reasons.append(f"only {effective:.1f} effective lines; raise min_lines")
        lower = 0.0
    if len(good) < 0.9 * lines:
        reasons.append(f"{lines - len(good)} of {lines} lines have invalid outputs")
    if backwards > 0.1 * lines:
        reasons.append(
            f"{backwards} of {lines} lines run backwards: the design direction does not lead to "
            "failure everywhere"
        )
    if not design.converged:
        reasons.insert(0, f"the design point failed its checks: {design.verdict}")
        # What lies nearer is not known, so neither is an upper end.
        lower, upper = 0.0, 1.0
    verdict = "; ".join(reasons) or GOOD
    return Estimate(mean, lower, upper, cost, counted.n_invalid, effective, verdict)
