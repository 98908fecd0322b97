"""One batch of simulations: shapes checked, failed points tried again, never an exception."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from failure.search.task import sign_of
from failure.status import Status

# x [n, D] -> (specs [n, m], status [n]); 0 is a valid sample
Simulate = Callable[[np.ndarray], tuple[Any, Any]]


class Evaluated(NamedTuple):
    """Answers of a simulator.

    Attributes:
        y: `[S, q]`, larger is worse, NaN where invalid.
        status: `[S, q]`, see `failure.Status`.
        messages: what went wrong, by the number of the point (seed by seed).
    """

    y: np.ndarray
    status: np.ndarray
    messages: dict[int, str]


def _answer(simulate: Simulate, column: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One call of the simulator, its shapes checked: `(values [n], status [n])`."""
    specs, flags = simulate(x)
    specs, flags = np.asarray(specs, np.float64), np.asarray(flags, np.int64)
    if specs.ndim != 2 or len(specs) != len(x) or flags.shape != (len(x),):
        raise ValueError(
            f"simulate: specs.shape={specs.shape}, status.shape={flags.shape}: expected "
            f"({len(x)}, m) and ({len(x)},), one row per point; return them in the order of x"
        )
    if not 0 <= column < specs.shape[1]:
        raise ValueError(
            f"column={column}: expected 0 ... {specs.shape[1] - 1}, a specification of the "
            "simulator"
        )
    return specs[:, column], flags


def evaluate(
    simulate: Simulate, column: int, x: np.ndarray, *, sense: str = "max", retries: int = 1
) -> Evaluated:
    """Simulate the points of all seeds in one batch; try failed ones again; never raise for them.

    A simulator that raises on a batch is asked point by point, so that the other points keep
    their results.

    Args:
        simulate: `x [n, D] -> (specs [n, m], status [n])`.
        column: which specification.
        x: `[S, q, D]`.
        sense: "max" when larger is worse, "min" when smaller is.
        retries: further attempts at points whose simulation failed.

    Returns:
        Evaluated.

    Raises:
        ValueError: another sense; specifications or statuses of the wrong shape; no such column.
    """
    sign = sign_of(sense)
    flat = np.asarray(x).reshape(-1, x.shape[-1])
    y, status = np.full(len(flat), np.nan), np.full(len(flat), int(Status.FAILED))
    messages: dict[int, str] = {}

    def ask(rows: np.ndarray) -> None:
        try:
            values, flags = _answer(simulate, column, flat[rows])
        except (RuntimeError, OSError, ArithmeticError) as error:
            if len(rows) > 1:
                for row in rows:
                    ask(np.asarray([row]))
            else:
                messages[int(rows[0])] = f"{type(error).__name__}: {error}"
            return
        y[rows] = sign * values
        bad = (flags == 0) & ~np.isfinite(values)
        status[rows] = np.where(bad, int(Status.NOT_FINITE_OUTPUT), flags)
        told = getattr(simulate, "messages", None) or {}
        for k, row in enumerate(rows):
            messages.pop(int(row), None)
            if status[row] != 0 and k in told:
                messages[int(row)] = str(told[k])

    left = np.arange(len(flat))
    for _ in range(retries + 1):
        ask(left)
        left = left[status[left] != 0]
        if left.size == 0:
            break
    y[status != 0] = np.nan
    return Evaluated(y.reshape(x.shape[:2]), status.reshape(x.shape[:2]), messages)
