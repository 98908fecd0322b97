"""What any search must beat: Monte Carlo, a linear fit and its corner, a gradient and its corner.

Each is a function of the history alone, so a run resumes from its log without further state.
"""

from __future__ import annotations

import math

import numpy as np

from failure.search.task import Task


def uniform(rng: np.random.Generator, task: Task, n: int) -> np.ndarray:
    """`n` uniform points of the task's set, `[n, D]`."""
    if task.kind == "box":
        return rng.uniform(-task.size, task.size, (n, task.dim))
    normal = rng.normal(size=(n, task.dim))
    radius = task.size * rng.uniform(size=(n, 1)) ** (1.0 / task.dim)
    return radius * normal / np.linalg.norm(normal, axis=1, keepdims=True)


def worst_corner(task: Task, slope: np.ndarray) -> np.ndarray:
    """Where a function of slope `[D]` is largest: at a corner, or on the sphere along it."""
    if task.kind == "box":
        return task.size * np.where(slope >= 0, 1.0, -1.0)
    return task.size * slope / max(float(np.linalg.norm(slope)), 1e-300)


def ridge(
    x: np.ndarray, y: np.ndarray, penalty: float = 1.0
) -> tuple[np.ndarray, np.ndarray, float]:
    """Ridge regression with an intercept on standardised outputs.

    Args:
        x: inputs scaled to unit variance, `[n, D]`.
        y: outputs, `[n]`.
        penalty: ratio of noise to prior variance of a slope.

    Returns:
        `(slopes, their covariance, noise variance)` in units of the standardised output.
    """
    sd = float(y.std()) or 1.0
    centred, target = x - x.mean(0), (y - y.mean()) / sd
    precision = centred.T @ centred + penalty * np.eye(x.shape[1])
    inverse = np.linalg.inv(precision)
    slope = inverse @ (centred.T @ target)
    effective = float(np.trace(inverse @ (centred.T @ centred)))
    noise = float(np.sum((target - centred @ slope) ** 2)) / max(len(y) - effective, 1.0)
    return slope, noise * inverse, noise


def monte_carlo(rng: np.random.Generator, task: Task, n_left: int) -> np.ndarray:
    """The next block of uniform points, `[min(50, n_left), D]`."""
    return uniform(rng, task, min(50, n_left))


def ridge_corner(rng: np.random.Generator, task: Task, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Fit a line to all data, ask for its worst corner; where known, that of a drawn slope.

    Args:
        rng: random numbers of this iteration.
        task: the feasible set.
        x: inputs so far `[n, D]`.
        y: outputs so far, NaN where invalid.

    Returns:
        `[1, D]`.
    """
    scale = task.size / (math.sqrt(3.0) if task.kind == "box" else math.sqrt(task.dim + 2.0))
    good = np.isfinite(y)
    if not good.any():
        return uniform(rng, task, 1)
    slope, covariance, _ = ridge(x[good] / scale, y[good])
    corner = worst_corner(task, slope)
    for _ in range(20):
        if not np.any(np.all(np.abs(x - corner) < 1e-6 * task.size, axis=1)):
            break
        corner = worst_corner(task, rng.multivariate_normal(slope, covariance, method="svd"))
    return corner[None]


def _differences(centre: np.ndarray, step: float) -> np.ndarray:
    """A point and its neighbours along every axis, `[D + 1, D]`; inwards, to stay in the set."""
    sign = np.where(centre > 0, -1.0, 1.0)
    return np.concatenate([centre[None], centre[None] + np.diag(step * sign)])


def gradient_corner(
    rng: np.random.Generator, task: Task, x: np.ndarray, y: np.ndarray, n_left: int
) -> np.ndarray:
    """Forward differences at a point (D + 1 simulations), then the corner they point to.

    The first point is the nominal one, the next the best so far; where that has been a centre
    already, a random one. The step is 5 % of the box's half width, or as much per coordinate in
    the ball.

    Args:
        rng: random numbers of this iteration.
        task: the feasible set.
        x: inputs so far.
        y: outputs so far, NaN where invalid.
        n_left: simulations left.

    Returns:
        `[D + 1, D]` or `[1, D]`.
    """
    dim = task.dim
    step = 0.05 * task.size * (1.0 if task.kind == "box" else math.sqrt(3.0 / (dim + 2.0)))
    cycle = dim + 2
    done, position = divmod(len(y), cycle)
    if 0 < position <= dim:
        # A smaller budget cut the block; the rest of the same differences.
        return _differences(x[done * cycle], step)[position:][:n_left]
    if position == dim + 1:
        rows = slice(done * cycle, done * cycle + dim + 1)
        slope = (y[rows][1:] - y[rows][0]) / (x[rows][1:] - x[rows][0]).sum(1)
        return worst_corner(task, np.nan_to_num(slope))[None]
    centre = np.zeros(dim)
    if done > 0:
        centre = x[int(np.nanargmax(np.where(np.isfinite(y), y, -np.inf)))]
        known = x[: done * cycle : cycle]
        if np.any(np.all(np.abs(known - centre) < 1e-9, axis=1)):
            centre = uniform(rng, task, 1)[0]
    return _differences(centre, step)[:n_left]
