"""The design point by Hasofer-Lind steps, with and without gradients, and whether it is one."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from failure.descents import COSINE, GAP, Descent, by_gradients, by_values, cosine_of
from failure.estimates import GOOD, check_threshold
from failure.performances import Counted, Performance, Slopes, check_rows


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


def find_design_point(
    performance: Performance,
    threshold: float,
    dim: int,
    *,
    slopes: Slopes | None = None,
    start: Float[np.ndarray, " D"] | None = None,
    gradient: Float[np.ndarray, " D"] | None = None,
    iterations: int = 25,
    restarts: int = 2,
    step: float = 0.3,
    reach: float = math.inf,
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
        gradient: slope at the first point where it is known, which saves its differences.
        iterations: steps at most, of each start.
        restarts: further starts, normal at half a sigma, while the checks fail.
        step: of the forward differences [sigma].
        reach: no farther out than this [sigma].
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
    s = Descent(counted, float(threshold), step, reach)
    rng = np.random.default_rng(seed)
    starts = [first, *(0.5 * rng.normal(size=(restarts, dim)))]
    best: tuple[float, np.ndarray, float, np.ndarray] | None = None
    for k, u in enumerate(starts):
        if k == 0 and gradient is not None and not counted.has_slopes:
            y, g = s.value(u), np.array(gradient, np.float64)
        else:
            y, g = s.both(u)
        if k == 0:
            s.nominal = y if start is None else s.value(np.zeros(dim))
        if not math.isfinite(y):
            continue
        if counted.has_slopes:
            u, y, g = by_gradients(s, u, y, np.nan_to_num(g), iterations)
        else:
            u, y, g = by_values(s, u, y, g, iterations)
            for _ in range(0 if s.hopeless(u, y) else 3):
                # The slope turns on the way; taken again here it is also the check.
                g = counted.differences(u, y, step)
                if s.done(u, y, g):
                    break
                u, y, g = by_values(s, u, y, g, 8)
        g = np.nan_to_num(g)
        on = abs(y - threshold) <= GAP * s.scale()
        score = cosine_of(u, g) if on else cosine_of(u, g) - 2.0
        if best is None or score > best[0]:
            best = (score, u, y, g)
        if s.done(u, y, g):
            break
    return _report(s, best, dim)


def onto_boundary(
    performance: Performance, threshold: float, x: Float[np.ndarray, " D"], *, steps: int = 5
) -> Float[np.ndarray, " D"]:
    """A failing point, moved towards nominal by bisection until just before it no longer fails."""
    low, high = 0.0, 1.0
    for _ in range(steps):
        middle = 0.5 * (low + high)
        trial = (middle * x)[None]
        y = np.asarray(performance(trial))
        check_rows(y, trial)
        value = float(np.nan_to_num(y[0], nan=-np.inf))
        low, high = (low, middle) if value > threshold else (middle, high)
    return high * x


def _report(
    s: Descent, best: tuple[float, np.ndarray, float, np.ndarray] | None, dim: int
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
    cosine, gap = cosine_of(u, g), (y - s.threshold) / s.scale()
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
