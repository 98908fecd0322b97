"""Batches of simulations: cached on disk, shared among workers, timed, tried again."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from failure.simulators.processes import Group, never_worked
from failure.simulators.result_cache import Cache
from failure.status import Status

_log = logging.getLogger("failure.simulators")

Result = tuple[list[float], int, str]


@runtime_checkable
class Attempt(Protocol):
    """What one worker simulates with: opened once, called for every sample."""

    def __enter__(self) -> Attempt: ...

    def __exit__(self, *exc: object) -> None: ...

    def __call__(self, row: np.ndarray, timeout: float) -> tuple[Any, int, str]:
        """(specs, status, message) of one sample."""


def check_points(x: Any, dim: int | None = None) -> np.ndarray:
    """Samples as float64 `[n, d]`.

    Args:
        x: samples.
        dim: `d`, where it is known.
    Raises:
        ValueError: wrong shape, or a row that is not finite, named.
    """
    x = np.asarray(x, np.float64)
    if x.ndim != 2 or (dim is not None and x.shape[1] != dim):
        wanted = "d" if dim is None else dim
        raise ValueError(f"x of shape {x.shape}: expected [n, {wanted}], one row per sample")
    bad = np.flatnonzero(~np.all(np.isfinite(x), axis=1))
    if bad.size:
        raise ValueError(f"x[{bad[0]}]={x[bad[0]]}: expected finite numbers; drop the row")
    return x


@dataclass
class Batch:
    """Shared part of the simulators: cache, duplicates, workers, retries.

    Attributes:
        n_specs: numbers per sample.
        workers: simulations at a time.
        retries: further attempts at a sample that failed.
        timeout: limit of each simulation [s].
        cache: folder of finished samples, or None.
        retry_failed: simulate samples again whose failure is in the cache.
        identity: what the cache knows the simulator by.
        give_up: failed simulations, none good before, after which the simulator is taken to be
            broken and the batch stops with its message; 0 never.
        messages: row -> what went wrong, for the last batch.
        simulations: started so far, retries included, cache hits not.
    """

    n_specs: int
    workers: int
    retries: int
    timeout: float
    cache: Path | None
    retry_failed: bool
    identity: str
    give_up: int = 10
    messages: dict[int, str] = field(default_factory=dict, init=False)
    simulations: int = field(default=0, init=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)
    _worked: bool = field(default=False, init=False)
    _failed: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        least_of = (("n_specs", 1), ("workers", 1), ("retries", 0), ("give_up", 0))
        for name, least in least_of:
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)!r}: expected at least {least}")
        if not self.timeout > 0.0:
            raise ValueError(f"timeout={self.timeout!r}: expected seconds above 0")

    def run(
        self, x: np.ndarray, attempt: Callable[[Group], Attempt]
    ) -> tuple[np.ndarray, np.ndarray]:
        """`x [n, d] -> (specs [n, m], status [n])`; `attempt(group)` makes what a worker uses.

        Raises:
            ValueError: wrong shape, or a row that is not finite, named.
            SimulatorError: the simulator cannot be started, or has never worked.
        """
        x = check_points(x)
        store = Cache(Path(self.cache), self.identity) if self.cache is not None else None
        results: dict[bytes, Result] = {}
        waiting: queue.SimpleQueue[np.ndarray] = queue.SimpleQueue()
        for row in {r.tobytes(): r for r in x}.values():
            stored = store.load(row, self.n_specs) if store else None
            if stored is not None and (stored[1] == Status.GOOD or not self.retry_failed):
                self._worked |= stored[1] == Status.GOOD
                results[row.tobytes()] = stored
            else:
                waiting.put(row)

        group = Group()
        errors: list[BaseException] = []

        def work() -> None:
            try:
                with attempt(group) as one:
                    while not errors:
                        try:
                            row = waiting.get_nowait()
                        except queue.Empty:
                            return
                        result = self._try(one, row)
                        if store:
                            store.save(row, *result)
                        results[row.tobytes()] = result
                        self._count(result)
            except BaseException as error:
                errors.append(error)
                group.end()

        count = min(self.workers, waiting.qsize())
        threads = [threading.Thread(target=work, daemon=True) for _ in range(count)]
        for thread in threads:
            thread.start()
        try:
            for thread in threads:
                thread.join()
        except BaseException as error:
            # Ctrl-C: no simulation outlives it.
            errors.append(error)
            group.end()
            raise
        if errors:
            raise errors[0]
        ordered = [results[r.tobytes()] for r in x]
        self.messages = {k: m for k, (_, _, m) in enumerate(ordered) if m}
        for k, message in self.messages.items():
            _log.info("sample %d: %s", k, message)
        specs = np.array([s for s, _, _ in ordered]).reshape(len(x), self.n_specs)
        return specs, np.array([s for _, s, _ in ordered], np.int32)

    def _count(self, result: Result) -> None:
        """Stop a simulator that has failed time and again and never worked."""
        with self._lock:
            self._worked |= result[1] in (Status.GOOD, Status.NOT_FINITE)
            self._failed += result[1] not in (Status.GOOD, Status.NOT_FINITE)
            hopeless = not self._worked and self.give_up and self._failed >= self.give_up
        if hopeless:
            raise never_worked(self._failed, result[2])

    def _try(self, one: Attempt, row: np.ndarray) -> Result:
        result: Result = ([], Status.FAILED, "")
        for _ in range(1 + self.retries):
            with self._lock:
                self.simulations += 1
            result = self._check(*one(row, self.timeout))
            if result[1] == Status.GOOD:
                break
        return result

    def _check(self, specs: Any, status: int, message: str) -> Result:
        nothing = [float("nan")] * self.n_specs
        if status != Status.GOOD:
            return nothing, int(status), message
        try:
            values = np.asarray(specs, np.float64).reshape(-1)
        except (TypeError, ValueError) as error:
            return nothing, Status.FAILED, f"specifications are not numbers: {error}"
        if values.size != self.n_specs:
            problem = f"{values.size} specifications returned: expected {self.n_specs}"
            return nothing, Status.FAILED, problem
        if not np.all(np.isfinite(values)):
            problem = f"specifications are not finite: {values.tolist()}"
            return values.tolist(), Status.NOT_FINITE, message or problem
        return values.tolist(), Status.GOOD, message
