"""The design point by Hasofer-Lind steps, with and without gradients, and whether it is one."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from failure.estimates import GOOD, check_threshold
from failure.performances import Counted, Performance, Slopes

COSINE = 0.99
"""A point is a design point when its direction and the gradient there agree this well."""

GAP = 0.02
"""...and when its value is this near to the threshold, in units of its distance from nominal."""

LONGEST = 2.5
"""Longest step [sigma]: a linear prediction over more is a guess."""


class DesignPoint(NamedTuple):
    """The failure nearest to nominal, as far as the checks can say.

    Attributes:
        point: `[D]` [sigma].
        value: output there.
        gradient: `[D]`, slope of the output there.
        beta: signed distance of the linearised boundary from nominal [sigma]; the first-order
            probability is `norm.sf(beta)`.
        cosine: of the point and the gradient; 1 at a design point.
        gap: (output - threshold) over (threshold - output at nominal); 0 on the boundary.
        n_simulations: values paid for.
        n_gradients: values with a gradient paid for.
        first_failure: evaluations up to the first failing one (a gradient counts once), NaN.
        verdict: "good", or what stands against it.
    """

    point: Float[np.ndarray, " D"]
    value: float
    gradient: Float[np.ndarray, " D"]
    beta: float
    cosine: float
    gap: float
    n_simulations: int
    n_gradients: int
    first_failure: float
    verdict: str

    @property
    def converged(self) -> bool:
        """Whether value and direction pass the checks."""
        return self.verdict == GOOD

    @property
    def axis(self) -> Float[np.ndarray, " D"]:
        """Unit vector of the gradient, along which lines are searched."""
        return self.gradient / max(float(np.linalg.norm(self.gradient)), 1e-300)


class _Search:
    """One descent: evaluates, keeps the first failure and the best point."""

    def __init__(self, counted: Counted, threshold: float, step: float) -> None:
        self.counted, self.threshold, self.step = counted, threshold, step
        self.first = math.nan
        self.nominal = math.nan

    def spent(self) -> int:
        return self.counted.n_values + self.counted.n_gradients

    def note(self, value: float) -> None:
        if math.isnan(self.first) and value > self.threshold:
            self.first = float(self.spent())

    def value(self, u: np.ndarray) -> float:
        y = float(self.counted(u[None])[0])
        self.note(y)
        return y

    def both(self, u: np.ndarray) -> tuple[float, np.ndarray]:
        """Value and gradient; differences where there are no gradients."""
        if self.counted.has_slopes:
            y, g = self.counted.slopes(u[None])
            self.note(float(y[0]))
            return float(y[0]), g[0]
        y0 = self.value(u)
        return y0, self.counted.differences(u, y0, self.step)

    def scale(self) -> float:
        """What the gap to the threshold is measured in."""
        return max(abs(self.threshold - self.nominal), 1e-300)

    def target(self, u: np.ndarray, y: float, g: np.ndarray) -> np.ndarray:
        """Hasofer-Lind: the nearest point of the linearised boundary."""
        return ((g @ u - (y - self.threshold)) / max(float(g @ g), 1e-300)) * g

    def done(self, u: np.ndarray, y: float, g: np.ndarray) -> bool:
        return abs(y - self.threshold) <= GAP * self.scale() and _cosine(u, g) >= COSINE


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300))


def _with_gradients(
    s: _Search, u: np.ndarray, y: float, g: np.ndarray, iterations: int
) -> tuple[np.ndarray, float, np.ndarray]:
    """Improved HLRF: steps shortened until the merit of Zhang and Der Kiureghian falls."""
    for _ in range(iterations):
        if s.done(u, y, g) or not np.any(g):
            break
        move = s.target(u, y, g) - u
        move *= min(1.0, LONGEST / max(float(np.linalg.norm(move)), 1e-300))
        weight = 2.0 * max(float(np.linalg.norm(u)), 1.0) / float(np.linalg.norm(g))
        merit = 0.5 * u @ u + weight * abs(y - s.threshold)
        share, moved = 1.0, False
        for _ in range(5):
            trial = u + share * move
            y_new, g_new = s.both(trial)
            if math.isfinite(y_new):
                moved = 0.5 * trial @ trial + weight * abs(y_new - s.threshold) < merit
            if moved or s.done(trial, y_new, g_new):
                u, y, g, moved = trial, y_new, g_new, True
                break
            share *= 0.4
        if not moved:
            break
    return u, y, g


def _with_values(
    s: _Search, u: np.ndarray, y: float, g: np.ndarray, iterations: int
) -> tuple[np.ndarray, float, np.ndarray]:
    """Differences once, Broyden's update after every step; one simulation each."""
    longest = LONGEST
    for _ in range(iterations):
        move = s.target(u, y, g) - u
        length = float(np.linalg.norm(move))
        if abs(y - s.threshold) <= GAP * s.scale() and length < 0.3:
            break
        move *= min(1.0, longest / max(length, 1e-300))
        y_new = s.value(u + move)
        if not math.isfinite(y_new):
            longest *= 0.5
            continue
        g = g + ((y_new - y - g @ move) / max(float(move @ move), 1e-300)) * move
        u, y = u + move, y_new
    return u, y, g


def find_design_point(
    performance: Performance,
    threshold: float,
    dim: int,
    *,
    slopes: Slopes | None = None,
    start: Float[np.ndarray, " D"] | None = None,
    iterations: int = 25,
    restarts: int = 2,
    step: float = 0.3,
    seed: int = 0,
) -> DesignPoint:
    r"""The most likely failure, by steps to the nearest point of the linearised boundary.

    .. math:: u' = \frac{\nabla y \cdot u - (y - T)}{|\nabla y|^2} \nabla y, \qquad
        y(u^*) = T, \quad \frac{u^* \cdot \nabla y}{|u^*| |\nabla y|} = 1

    Whether both conditions hold at the end is checked, never assumed: a descent that stops
    elsewhere gives probabilities that are wrong by orders of magnitude with a narrow interval.
    Without gradients, forward differences are taken at the start, kept up to date by Broyden's
    formula, and taken again at the point reached, where they are the check.

    Args:
        performance: `x [n, D] -> y [n]`, larger is worse.
        threshold: failure is `y > threshold`.
        dim: D.
        slopes: `x [n, D] -> (y [n], dy/dx [n, D])`, see `performances.slopes_by_jax`.
        start: first point; nominal without.
        iterations: steps at most, of each start.
        restarts: further starts, normal at half a sigma, while the checks fail.
        step: of the forward differences [sigma].
        seed: of the further starts.

    Returns:
        DesignPoint; of several starts that fail the checks the one with the best cosine.

    Raises:
        ValueError: a threshold that is not finite, a start of the wrong size.

    Source: Rackwitz and Fiessler (1978); Zhang and Der Kiureghian (1995); Broyden (1965).

    Example:
        >>> found = find_design_point(lambda x: x[:, 0] + x[:, 1], 4.0, 3)
        >>> found.converged, round(found.beta, 3)
        (True, 2.828)
    """
    check_threshold(threshold)
    first = np.zeros(dim) if start is None else np.array(start, np.float64)
    if first.shape != (dim,):
        raise ValueError(f"start.shape={first.shape}: expected ({dim},)")
    counted = Counted(performance, slopes)
    s = _Search(counted, float(threshold), step)
    rng = np.random.default_rng(seed)
    starts = [first, *(0.5 * rng.normal(size=(restarts, dim)))]
    best: tuple[float, np.ndarray, float, np.ndarray] | None = None
    for k, u in enumerate(starts):
        y, g = s.both(u)
        if k == 0:
            s.nominal = y if start is None else s.value(np.zeros(dim))
        if not math.isfinite(y):
            continue
        if counted.has_slopes:
            u, y, g = _with_gradients(s, u, y, np.nan_to_num(g), iterations)
        else:
            u, y, g = _with_values(s, u, y, g, iterations)
            for _ in range(3):
                # The slope turns on the way; taken again here it is also the check.
                g = counted.differences(u, y, step)
                if s.done(u, y, g):
                    break
                u, y, g = _with_values(s, u, y, g, 8)
        g = np.nan_to_num(g)
        on = abs(y - threshold) <= GAP * s.scale()
        score = _cosine(u, g) if on else _cosine(u, g) - 2.0
        if best is None or score > best[0]:
            best = (score, u, y, g)
        if s.done(u, y, g):
            break
    return _report(s, best, dim)


def _report(
    s: _Search, best: tuple[float, np.ndarray, float, np.ndarray] | None, dim: int
) -> DesignPoint:
    """The best end point, checked."""
    spent = (s.counted.n_values, s.counted.n_gradients)
    if best is None:
        nothing = np.full(dim, np.nan)
        why = "the output is not finite at any start"
        return DesignPoint(
            nothing, math.nan, nothing, math.nan, math.nan, math.nan, *spent, s.first, why
        )
    _, u, y, g = best
    length = float(np.linalg.norm(g))
    cosine, gap = _cosine(u, g), (y - s.threshold) / s.scale()
    beta = float(u @ g) / max(length, 1e-300) + (s.threshold - y) / max(length, 1e-300)
    reasons = []
    if length == 0.0:
        reasons.append("the output does not vary here; search for a failure and start from it")
    elif not abs(gap) <= GAP:
        reasons.append(f"the threshold is not reached (gap {gap:.2g} of the way from nominal)")
    if length > 0.0 and cosine < COSINE and s.nominal < s.threshold:
        reasons.append(f"the point is not the nearest one (cosine {cosine:.3f} with the gradient)")
    if not s.nominal < s.threshold:
        reasons.append("the nominal point fails or is invalid: the probability is not small")
    verdict = "; ".join(reasons) or GOOD
    return DesignPoint(u, y, g, beta, cosine, gap, *spent, s.first, verdict)
