"""Line sampling by values alone, its direction from a plane and a Gaussian process of the rest."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from failure.descents import LONGEST, Descent, by_values
from failure.estimates import GOOD, Estimate, check_threshold
from failure.line_roots import line_roots
from failure.lines import interval_of_lines
from failure.models.emulator import Emulator
from failure.performances import Counted, Performance


class Plane(NamedTuple):
    """A tangent plane of a performance function: its value and gradient at a point."""

    point: Float[np.ndarray, " D"]
    value: float
    gradient: Float[np.ndarray, " D"]

    def predict(self, x: Float[np.ndarray, "n D"]) -> Float[np.ndarray, " n"]:
        """Values of the plane."""
        return self.value + (x - self.point) @ self.gradient


class BentPlane:
    """A plane and a Gaussian process of what it leaves.

    A process alone takes sixty differences along the axes for a curved function with sixty unknown
    lengthscales, and its gradient at the threshold lies 30 degrees off where the differences' own
    lies one and a half off.

    Args:
        plane: what the differences say.
        x, y: everything simulated.
    """

    def __init__(
        self, plane: Plane, x: Float[np.ndarray, "n D"], y: Float[np.ndarray, " n"]
    ) -> None:
        self._plane, self._rest = plane, Emulator(x, y - plane.predict(x))

    def predict(self, x: Float[np.ndarray, "m D"]) -> Float[np.ndarray, " m"]:
        """Expected values."""
        return self._plane.predict(x) + self._rest.predict(x)[0]

    def slope(self, x: Float[np.ndarray, "m D"]) -> Float[np.ndarray, "m D"]:
        """Gradients of the expected values."""
        return self._plane.gradient[None] + self._rest.slope(x)


def emulated_point(
    emulator: BentPlane, threshold: float, start: Float[np.ndarray, " D"], *, steps: int = 20
) -> tuple[Float[np.ndarray, " D"], Float[np.ndarray, " D"]]:
    """The emulator's own design point and its gradient there; costs no simulation."""
    u = np.array(start, np.float64)
    g = np.zeros_like(u)
    for _ in range(steps):
        mean = emulator.predict(u[None])
        g = emulator.slope(u[None])[0]
        target = ((g @ u - (float(mean[0]) - threshold)) / max(float(g @ g), 1e-300)) * g
        move = target - u
        length = float(np.linalg.norm(move))
        u = u + move * min(1.0, 1.0 / max(length, 1e-300))
        if length < 1e-2:
            break
    return u, g


def guided_lines(
    performance: Performance,
    threshold: float,
    dim: int,
    *,
    key: Key[Array, ""],
    step: float = 0.5,
    batch: int = 4,
    factor: float = 2.0,
    min_lines: int = 10,
    most: int = 400,
) -> tuple[Estimate, Float[np.ndarray, " D"], float]:
    r"""Probability of the region that slopes lead to; a second round of differences only at need.

    Forward differences at nominal, steps to the threshold with Broyden's update, then lines. Their
    direction comes from the plane that the steps end with and a Gaussian process of what it leaves
    of everything evaluated, fitted again after each batch, so that the lines themselves turn it.
    Where the first lines (1.6 `min_lines`) disagree, differences are taken once more, where the
    steps ended, and lines begin anew, along these. Each line stands for itself,

    .. math:: \hat p = \frac1m \sum_i \Phi(-t_i), \qquad y(v_i + t_i a_i) = T, \quad
        v_i \perp a_i

    so a direction that is a little off costs lines, not truth.

    Args:
        performance: `x [n, D] -> y [n]`, larger is worse.
        threshold: failure is `y > threshold`.
        dim: D.
        key: random key.
        step: of the differences [sigma].
        batch: lines between two fits.
        factor: wanted half width of the interval, as a ratio.
        min_lines: lines at least.
        most: simulations at most.

    Returns:
        (Estimate, whose `n_simulations` is everything spent; the last design point; simulations up
        to the first failing one, NaN).

    Raises:
        ValueError: a threshold that is not finite, a factor not above 1, a budget below D + 30.

    Source: Koutsourelakis, Pradlwarter and Schueller (2004); de Angelis, Patelli and Beer (2015)
    for lines whose direction is updated.
    """
    check_threshold(threshold)
    if not factor > 1.0:
        raise ValueError(f"factor={factor}: expected a ratio above 1")
    if most < dim + 30:
        raise ValueError(f"most={most}: expected at least {dim + 30}, D + 30 simulations")
    counted = Counted(performance)
    descent = Descent(counted, float(threshold), step, math.inf)
    origin = np.zeros(dim)
    y, g = descent.both(origin)
    descent.nominal = y
    if not y < threshold or not np.any(g):
        why = "the output does not vary at nominal" if y < threshold else "the nominal point fails"
        return _unknown(counted, why), np.full(dim, np.nan), descent.first
    u, y, g = by_values(descent, origin, y, g, 12)
    if abs(y - threshold) > 0.5 * descent.scale():
        why = f"the threshold is not reached within {np.linalg.norm(u):.1f} sigma"
        return _unknown(counted, why), u, descent.first
    plane = Plane(u, y, g)
    with jax.enable_x64(True):
        draws = np.asarray(jax.random.normal(key, (most, dim)))
    distances: list[float] = []
    backwards, again, mean = 0, False, math.nan
    lower, upper, effective, narrow = 0.0, 1.0, 0.0, False
    while counted.n_values + 3 * batch <= most and not narrow:
        if not again:
            emulator = BentPlane(plane, *counted.samples())
            point, slope = emulated_point(emulator, threshold, u)
            if np.linalg.norm(point) < 1.5 * np.linalg.norm(u) + LONGEST and np.any(slope):
                u, g = point, slope
        rate = float(np.linalg.norm(g))
        axis = g / rate
        rows = draws[len(distances) : len(distances) + batch]
        rows = rows - (rows @ axis)[:, None] * axis
        t, back, _ = line_roots(counted, float(threshold), rows, axis, float(u @ axis), rate)
        distances += t.tolist()
        backwards += back
        good = np.array(distances)[np.isfinite(distances)]
        if len(good) >= min_lines:
            mean, lower, upper, effective = interval_of_lines(good)
            narrow = mean > 0.0 and upper <= factor * mean and lower >= mean / factor
            room = counted.n_values + dim + 4 * batch <= most
            if not narrow and not again and len(good) >= 1.6 * min_lines and room:
                # The gradient has turned on the way: differences where the steps ended.
                again, distances, backwards = True, [], 0
                u, _, g = by_values(descent, plane.point, *descent.both(plane.point), 6)
    lines, valid = len(distances), int(np.isfinite(distances).sum())
    reasons = []
    if not narrow:
        reasons.append(
            f"after {lines} lines the interval is still wider than a factor {factor:g}: the "
            "boundary bends or has several regions; use subset_simulation beside it"
        )
    if effective < 4.0:
        reasons.append(f"only {effective:.1f} effective lines; raise min_lines")
        lower, upper = 0.0, 1.0
    if valid < 0.9 * lines:
        reasons.append(f"{lines - valid} of {lines} lines have invalid outputs")
    if backwards > 0.1 * lines:
        reasons.append(f"{backwards} of {lines} lines run backwards")
    first = _first_failure(counted, threshold)
    estimate = Estimate(
        mean, lower, upper, counted.n_values, counted.n_invalid, effective,
        "; ".join(reasons) or GOOD,
    )  # fmt: skip
    return estimate, u, first


def _first_failure(counted: Counted, threshold: float) -> float:
    """Simulations up to the first failing one, NaN."""
    failed = np.flatnonzero(np.nan_to_num(counted.samples()[1], nan=-np.inf) > threshold)
    return float(failed[0] + 1) if failed.size else math.nan


def _unknown(counted: Counted, why: str) -> Estimate:
    return Estimate(math.nan, 0.0, 1.0, counted.n_values, counted.n_invalid, 0.0, why)
