"""Several searches at once, whose simulations come in common batches.

A batched circuit solver pays for a call, in its many small steps, more than for a sample. Searches
that wait for one another cost one call a round, not one each.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import numpy as np

from failure.identities import identity_of
from failure.search.evaluation import AnswerError, Simulate
from failure.simulators.processes import SimulatorError

T = TypeVar("T")


class _Exchange:
    """Requests of the searches that are still running; a round is full when all of them wait."""

    def __init__(self, running: int, identity: str) -> None:
        self.identity = identity
        self.changed = threading.Condition()
        self.running = running
        self.waiting: list[tuple[np.ndarray, Future[Any]]] = []

    def __call__(self, x: Any) -> tuple[Any, Any]:
        """Hand in points and wait for the common batch (called by a search)."""
        answer: Future[Any] = Future()
        with self.changed:
            self.waiting.append((np.asarray(x), answer))
            self.changed.notify_all()
        result: tuple[Any, Any] = answer.result()
        return result

    def leave(self) -> None:
        """One search has ended."""
        with self.changed:
            self.running -= 1
            self.changed.notify_all()

    def round(self) -> list[tuple[np.ndarray, Future[Any]]]:
        """The requests of one round; none when all searches have ended."""
        with self.changed:
            self.changed.wait_for(lambda: len(self.waiting) == self.running)
            requests, self.waiting = self.waiting, []
        return requests


def _answer(
    requests: list[tuple[np.ndarray, Future[Any]]], simulate: Simulate, multiple: int
) -> None:
    """Simulate all requests at once and give each search its rows.

    A simulator that raises is asked again for each search, so that one point does not discard the
    points of the others.
    """
    rows = [x.shape[0] for x, _ in requests]
    x = np.concatenate([x for x, _ in requests])
    # Few sizes, so that a compiled simulator is not compiled for every sum of requests.
    fill = -x.shape[0] % multiple
    batch = np.concatenate([x, np.repeat(x[-1:], fill, axis=0)])

    def fail(error: BaseException) -> None:
        for _, future in requests:
            future.set_exception(error)

    try:
        answer = jax.block_until_ready(simulate(batch))
    except Exception as error:
        if len(requests) == 1 or isinstance(error, SimulatorError | AnswerError):
            return fail(error)
        for request in requests:
            _answer([request], simulate, multiple)
        return None
    except BaseException as error:
        return fail(error)
    try:
        specs, status = (np.asarray(part) for part in answer)
        if len(specs) < len(x) or len(status) < len(x):
            raise AnswerError(
                f"simulate: {len(specs)} rows of specs and {len(status)} of status: expected at "
                f"least {len(x)}, one row per point"
            )
    except (TypeError, ValueError) as error:
        if isinstance(error, AnswerError):
            return fail(error)
        return fail(AnswerError(f"simulate: {error}: expected (specs [n, m], status [n])"))
    ends = np.cumsum(rows)
    for (_, future), end, n in zip(requests, ends, rows, strict=True):
        future.set_result((specs[end - n : end], status[end - n : end]))


def side_by_side(
    searches: Sequence[Callable[[Simulate], T]], simulate: Simulate, *, multiple: int = 64
) -> list[T]:
    """Run several searches at once; all their points of a round are simulated in one batch.

    Args:
        searches: each takes a simulator and returns its result, as
            `lambda simulate: runs.run(config, simulate, folder=folder)`.
        simulate: `x [n, D] -> (specs [n, m], status [n])`; called from one thread only.
        multiple: the last point is repeated until a batch is a multiple of this.

    Returns:
        The results, in the order of the searches.

    Raises:
        ValueError: `multiple` below 1.
        Exception: the first one that a search raised, after the others have ended.

    Example:
        >>> def simulate(x):
        ...     return x**2, np.zeros(len(x))
        >>> def search(simulate):
        ...     return float(simulate(np.ones((2, 1)))[0].sum())
        >>> side_by_side([search, search], simulate)
        [2.0, 2.0]
    """
    if multiple < 1:
        raise ValueError(f"multiple={multiple}: expected at least 1, the size of a batch")
    if not searches:
        return []
    exchange = _Exchange(len(searches), identity_of(simulate))

    def work(search: Callable[[Simulate], T]) -> T:
        try:
            return search(exchange)
        finally:
            exchange.leave()

    with ThreadPoolExecutor(len(searches)) as pool:
        futures = [pool.submit(work, search) for search in searches]
        while requests := exchange.round():
            _answer(requests, simulate, multiple)
        return [future.result() for future in futures]
