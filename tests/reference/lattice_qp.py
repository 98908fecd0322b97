"""Slow oracle: the constraints as explicit rows of a matrix, the projection by scipy's SLSQP."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize


def project(
    x: np.ndarray,
    rows: np.ndarray,
    low: float | None = None,
    high: float | None = None,
    equal: np.ndarray | None = None,
) -> np.ndarray:
    """Closest point to `x` with `rows @ y >= 0`, `low <= y <= high` and `equal @ y == 1`."""
    shape, x = x.shape, np.asarray(x, np.float64).ravel()
    constraints = []
    if len(rows):
        constraints.append({"type": "ineq", "fun": lambda y: rows @ y, "jac": lambda y: rows})
    if equal is not None:
        constraints.append({"type": "eq", "fun": lambda y: equal @ y - 1.0, "jac": lambda y: equal})
    result = minimize(
        lambda y: 0.5 * np.sum((y - x) ** 2),
        np.clip(np.full_like(x, x.mean()), low, high),
        jac=lambda y: y - x,
        bounds=None if low is None and high is None else [(low, high)] * x.size,
        constraints=constraints,
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert result.success, result.message
    return result.x.reshape(shape)


def _row(size: int, entries: dict[int, float]) -> np.ndarray:
    row = np.zeros(size)
    for place, value in entries.items():
        row[place] += value
    return row


def order_rows(n: int, pairs: list[tuple[int, int]], width: np.ndarray | None = None) -> np.ndarray:
    """Rows of `y[high] * width[high] - y[low] * width[low]`."""
    width = np.ones(n) if width is None else width
    return np.array(
        [_row(n, {low: -width[low], high: width[high]}) for low, high in pairs]
    ).reshape(-1, n)


def lattice_rows(
    sizes: tuple[int, ...],
    monotonicity: tuple[int, ...],
    unimodality: tuple[int, ...],
    trust: tuple[tuple[int, int, int], ...],
) -> np.ndarray:
    """One row for each inequality between vertices, built vertex by vertex."""
    index = np.arange(int(np.prod(sizes))).reshape(sizes)
    total = index.size
    rows = []
    for vertex in itertools.product(*(range(s) for s in sizes)):
        for axis, size in enumerate(sizes):
            if vertex[axis] + 1 == size:
                continue
            after = list(vertex)
            after[axis] += 1
            here, there = index[vertex], index[tuple(after)]
            sign = monotonicity[axis]
            if unimodality[axis]:
                sign = unimodality[axis] * (1 if vertex[axis] >= size // 2 else -1)
            if sign:
                rows.append(_row(total, {here: -sign, there: sign}))
        for main, conditional, direction in trust:
            if vertex[main] + 1 == sizes[main] or vertex[conditional] + 1 == sizes[conditional]:
                continue
            corner = {}
            for i, j in itertools.product((0, 1), (0, 1)):
                at = list(vertex)
                at[main] += i
                at[conditional] += j
                corner[index[tuple(at)]] = direction * (1.0 if i == j else -1.0)
            rows.append(_row(total, corner))
    return np.array(rows).reshape(-1, total)


def _corner_weights(sizes: tuple[int, ...], cell: tuple, at: np.ndarray) -> np.ndarray:
    """Weights of all vertices in the multilinear function of one cell, also beyond its corners."""
    weights = np.zeros(sizes)
    for corner in itertools.product((0, 1), repeat=len(sizes)):
        share = np.prod([t if bit else 1 - t for bit, t in zip(corner, at, strict=True)])
        weights[tuple(np.add(cell, corner))] += share
    return weights.ravel()


def slope_rows(sizes: tuple[int, ...], direction: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """One row for each corner of each cell: the slope there along `direction(corner)`.

    Within a cell a slope along a direction that is linear in the place is linear in each input, so
    that what holds at the corners holds in between.
    """
    rows = []
    for cell in itertools.product(*(range(size - 1) for size in sizes)):
        for corner in itertools.product((0.0, 1.0), repeat=len(sizes)):
            at, here = np.array(corner), _corner_weights(sizes, cell, np.array(corner))
            along = direction(at + cell)
            rows.append(
                sum(
                    along[d] * (_corner_weights(sizes, cell, at + step) - here)
                    for d, step in enumerate(np.eye(len(sizes)))
                )
            )
    return np.array(rows)


def range_rows(
    sizes: tuple[int, ...], ends: Callable[[np.ndarray], list[tuple[int, int, float]]]
) -> np.ndarray:
    """One row for each vertex: the sum of `weight * theta` where input `axis` is set to `value`."""
    index = np.arange(int(np.prod(sizes))).reshape(sizes)
    rows = []
    for vertex in itertools.product(*(range(size) for size in sizes)):
        row = np.zeros(index.size)
        for axis, value, weight in ends(np.array(vertex)):
            at = list(vertex)
            at[axis] = value
            row[index[tuple(at)]] += weight
        rows.append(row)
    return np.array(rows)


__all__ = ["lattice_rows", "order_rows", "project", "range_rows", "slope_rows"]
