"""Steps to the nearest point of the linearised boundary, with gradients and by values."""

from __future__ import annotations

import math

import numpy as np

from failure.performances import Counted

COSINE = 0.99
"""A point is a design point when its direction and the gradient there agree this well."""

GAP = 0.02
"""...and when its value is this near to the threshold, in units of its distance from nominal."""

LONGEST = 2.5
"""Longest step [sigma]: a linear prediction over more is a guess."""


class Descent:
    """One descent: evaluates, keeps the first failure and the best point."""

    def __init__(self, counted: Counted, threshold: float, step: float, reach: float) -> None:
        self.counted, self.threshold, self.step, self.reach = counted, threshold, step, reach
        self.first = math.nan
        self.nominal = math.nan

    def spent(self) -> int:
        """Simulations so far, with and without gradients."""
        return self.counted.n_values + self.counted.n_gradients

    def note(self, value: float) -> None:
        """Remember when the first failure was seen."""
        if math.isnan(self.first) and value > self.threshold:
            self.first = float(self.spent())

    def value(self, u: np.ndarray) -> float:
        """One simulation."""
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
        """Hasofer-Lind: the nearest point of the linearised boundary, within reach."""
        point = ((g @ u - (y - self.threshold)) / max(float(g @ g), 1e-300)) * g
        return np.asarray(point * min(1.0, self.reach / max(float(np.linalg.norm(point)), 1e-300)))

    def hopeless(self, u: np.ndarray, y: float) -> bool:
        """At the end of the reach and far from the threshold."""
        near = y - self.threshold > -0.25 * self.scale()
        return float(np.linalg.norm(u)) >= 0.99 * self.reach and not near

    def done(self, u: np.ndarray, y: float, g: np.ndarray) -> bool:
        """Whether value and direction pass the checks."""
        return abs(y - self.threshold) <= GAP * self.scale() and cosine_of(u, g) >= COSINE


def cosine_of(a: np.ndarray, b: np.ndarray) -> float:
    """Cosine of two vectors, 0 where one is zero."""
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300))


def by_gradients(
    s: Descent, u: np.ndarray, y: float, g: np.ndarray, iterations: int
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


def by_values(
    s: Descent,
    u: np.ndarray,
    y: float,
    g: np.ndarray,
    iterations: int,
    *,
    gap: float = GAP,
    near: float = 0.3,
) -> tuple[np.ndarray, float, np.ndarray]:
    """Differences once, Broyden's update after every step; one simulation each."""
    longest = LONGEST
    for _ in range(iterations):
        move = s.target(u, y, g) - u
        length = float(np.linalg.norm(move))
        if (abs(y - s.threshold) <= gap * s.scale() and length < near) or length < 1e-3:
            break
        move *= min(1.0, longest / max(length, 1e-300))
        y_new = s.value(u + move)
        if not math.isfinite(y_new):
            longest *= 0.5
            continue
        g = g + ((y_new - y - g @ move) / max(float(move @ move), 1e-300)) * move
        u, y = u + move, y_new
    return u, y, g
