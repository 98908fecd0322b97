"""One batch of simulations: shapes checked, failed points tried again, exceptions noted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from failure.search.task import sign_of
from failure.simulators.processes import SimulatorError, never_worked
from failure.status import Status

# x [n, D] -> (specs [n, m], status [n]); 0 is a valid sample
Simulate = Callable[[np.ndarray], tuple[Any, Any]]


class AnswerError(ValueError):
    """A simulator's answer does not belong to the points: an error of the program, not of one."""


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


def _checked(answer: Any, column: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a simulator gave for `x [n, D]`, its shapes checked: `(values [n], status [n])`."""
    specs, flags = answer
    specs, flags = np.asarray(specs, np.float64), np.asarray(flags, np.int64)
    if specs.ndim != 2 or len(specs) != len(x) or flags.shape != (len(x),):
        raise AnswerError(
            f"simulate: specs.shape={specs.shape}, status.shape={flags.shape}: expected "
            f"({len(x)}, m) and ({len(x)},), one row per point; return them in the order of x"
        )
    if not 0 <= column < specs.shape[1]:
        raise AnswerError(
            f"column={column}: expected 0 ... {specs.shape[1] - 1}, a specification of the "
            "simulator"
        )
    return specs[:, column], flags


def _told(simulate: Simulate) -> dict[int, str]:
    """The simulator's own messages of its last call, by row; one per corner where it has those."""
    found: dict[int, str] = {}
    for key, text in (getattr(simulate, "messages", None) or {}).items():
        row, where = (key[0], f"corner {key[1]}: ") if isinstance(key, tuple) else (key, "")
        found[row] = "; ".join(filter(None, (found.get(row, ""), f"{where}{text}")))
    return found


def evaluate(
    simulate: Simulate, column: int, x: np.ndarray, *, sense: str = "max", retries: int = 1
) -> Evaluated:
    """Simulate the points of all seeds in one batch; try failed ones again; never raise for them.

    A simulator that raises on a batch, whatever it raises, is asked point by point, so that the
    other points keep their results.

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
        SimulatorError: the simulator says that it cannot work.
    """
    sign = sign_of(sense)
    flat = np.asarray(x).reshape(-1, x.shape[-1])
    y, status = np.full(len(flat), np.nan), np.full(len(flat), int(Status.FAILED))
    messages: dict[int, str] = {}

    def ask(rows: np.ndarray) -> None:
        try:
            # Waited for here: a compiled simulator raises when its answer is read.
            answer = jax.block_until_ready(simulate(flat[rows]))
        except (SimulatorError, AnswerError):
            raise
        except Exception as error:
            if len(rows) > 1:
                for row in rows:
                    ask(np.asarray([row]))
            else:
                messages[int(rows[0])] = f"{type(error).__name__}: {error}"
            return
        values, flags = _checked(answer, column, flat[rows])
        y[rows] = sign * values
        bad = (flags == 0) & ~np.isfinite(values)
        status[rows] = np.where(bad, int(Status.NOT_FINITE_OUTPUT), flags)
        told = _told(simulate)
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


def check_worked(y: np.ndarray, status: np.ndarray, enough: int, messages: Sequence[str]) -> None:
    """Stop a search whose simulator has never worked.

    Args:
        y: `[S, n]`, simulated so far, NaN where invalid.
        status: `[S, n]`.
        enough: simulations per seed after which one should have been valid.
        messages: what the simulator has said so far.

    Raises:
        SimulatorError: there are as many, and none is valid; it holds the last message, or the
            last status.
    """
    if y.shape[1] < max(enough, 1) or np.any(np.isfinite(y)):
        return
    if messages:
        raise never_worked(y.size, messages[-1])
    last = int(status.reshape(-1)[-1])
    label = Status(last).label if last in set(Status) else "no status of failure.Status"
    raise never_worked(y.size, f"none; the last point has status {last} ({label})")
