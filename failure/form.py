"""First-order reliability: the most likely points of the failure regions."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from failure.estimates import check_threshold
from failure.performances import Performance, check_rows


def merge_points(
    points: np.ndarray, *, cosine: float = 0.9, excess: float = 2.5, most: int = 8
) -> np.ndarray:
    """One point per direction: nearest to the origin first, others dropped when alike or far.

    Args:
        points: `[k, D]`.
        cosine: two points are alike above this cosine.
        excess: points farther out than the nearest by this many sigma are dropped.
        most: points kept at most.
    """
    norms = np.linalg.norm(points, axis=1)
    kept: list[np.ndarray] = []
    for index in np.argsort(norms):
        point = points[index]
        if norms[index] > norms.min() + excess or len(kept) == most:
            break
        alike = (p @ point / max(np.linalg.norm(p) * norms[index], 1e-300) for p in kept)
        if all(value < cosine for value in alike):
            kept.append(point)
    return np.asarray(kept)


def design_points(
    performance: Performance,
    threshold: float,
    failures: Float[np.ndarray, "k d"],
    *,
    gradient: Performance | None = None,
    iterations: int = 15,
    step: float = 0.05,
    tolerance: float = 1e-2,
) -> tuple[np.ndarray, int]:
    r"""Move failures to the most likely point of their region, where importance sampling starts.

    First along the ray to the origin by bisection, then by the Hasofer-Lind step

    .. math:: u' = \frac{\nabla y \cdot u - (y - T)}{|\nabla y|^2} \nabla y

    damped so that :math:`\tfrac12 |u|^2 + c\,|y - T|` falls. Without `gradient` forward
    differences are used, D + 1 simulations per step.

    Args:
        performance: `x [m, D] -> y [m]`.
        threshold: failure is `y > threshold`.
        failures: failing points, for example those that a search found.
        gradient: `x [m, D] -> dy/dx [m, D]`, counted as one simulation per row.
        iterations: steps at most.
        step: of the forward differences [sigma].
        tolerance: stop when a step moves every point by less [sigma].

    Returns:
        `(points [k', D], merged, just inside the failure region; simulations used)`.

    Raises:
        ValueError: a point that does not fail, named by its row.

    Source: Rackwitz and Fiessler (1978); Zhang and Der Kiureghian (1995) for the merit function.

    Example:
        >>> failures = np.array([[3.0, 2.0], [1.0, 5.0]])
        >>> points, used = design_points(lambda x: x.sum(axis=1), 4.0, failures)
        >>> np.round(points, 1).tolist()
        [[2.0, 2.0]]
    """
    check_threshold(threshold)
    u = np.array(failures, np.float64)
    if u.ndim != 2 or len(u) == 0:
        raise ValueError(f"failures.shape={u.shape}: expected at least one point [k, D]")
    used = 0

    def simulate(x: np.ndarray) -> np.ndarray:
        nonlocal used
        used += len(x)
        with jax.enable_x64(True):
            y = np.asarray(performance(jnp.asarray(x)), np.float64)
        check_rows(y, x)
        return np.where(np.isfinite(y), y, -np.inf)

    y = simulate(u)
    if not np.all(y > threshold):
        row = int(np.argmin(y > threshold))
        raise ValueError(
            f"row {row} of failures does not fail: y = {y[row]:g}, threshold {threshold:g}"
        )
    k, dim = u.shape
    low, high = np.zeros(k), np.ones(k)
    for _ in range(8):
        middle = 0.5 * (low + high)
        fails = simulate(middle[:, None] * u) > threshold
        low, high = np.where(fails, low, middle), np.where(fails, middle, high)
    u = merge_points(high[:, None] * u, excess=math.inf)
    y = simulate(u)
    fractions = np.array([1.0, 0.5, 0.25, 0.1])
    for _ in range(iterations):
        slope = _slopes(simulate, gradient, u, y, step)
        used += len(u) if gradient is not None else 0
        norm2 = np.maximum(np.sum(slope**2, 1), 1e-300)
        target = ((np.sum(slope * u, 1) - (y - threshold)) / norm2)[:, None] * slope
        penalty = 2.0 * np.maximum(np.linalg.norm(u, axis=1), 1e-9) / np.sqrt(norm2)

        def merit(x: np.ndarray, gap: np.ndarray, weight: np.ndarray) -> np.ndarray:
            return 0.5 * np.sum(x**2, -1) + weight * np.abs(gap)

        trials = u[None] + fractions[:, None, None] * (target - u)[None]
        gaps = simulate(trials.reshape(-1, dim)).reshape(len(fractions), -1) - threshold
        values = merit(trials, gaps, penalty)
        choice = np.argmin(values, 0)
        rows = np.arange(len(u))
        better = values[choice, rows] < merit(u, y - threshold, penalty)
        moved = np.where(better[:, None], trials[choice, rows], u)
        y = np.where(better, gaps[choice, rows] + threshold, y)
        size = float(np.max(np.linalg.norm(moved - u, axis=1)))
        u = moved
        if size < tolerance:
            break
    return merge_points(u), used


def _slopes(
    simulate: Callable[[np.ndarray], np.ndarray],
    gradient: Performance | None,
    u: np.ndarray,
    y: np.ndarray,
    step: float,
) -> np.ndarray:
    """Gradients at the rows of `u`; the given one or forward differences."""
    if gradient is not None:
        with jax.enable_x64(True):
            return np.nan_to_num(np.asarray(gradient(jnp.asarray(u))))
    k, dim = u.shape
    moved = (u[:, None] + step * np.eye(dim)[None]).reshape(-1, dim)
    return np.nan_to_num((simulate(moved).reshape(k, dim) - y[:, None]) / step)
