"""Batches of simulations: cached on disk, shared among workers, timed, tried again."""

from __future__ import annotations

import hashlib
import json
import os
import queue
import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

__all__ = ["FAILED", "GOOD", "NOT_FINITE", "STATUS", "TIMED_OUT", "Attempt", "Batch", "Cache"]

GOOD, FAILED, TIMED_OUT, NOT_FINITE = 0, 1, 2, 3
STATUS = {GOOD: "good", FAILED: "failed", TIMED_OUT: "out of time", NOT_FINITE: "not finite"}


@dataclass(frozen=True)
class Cache:
    """Results on disk, one file per sample, named by the hash of simulator and parameters.

    A file is written whole or not at all, so that a run killed at any point keeps what it has paid
    for, and several runs may share a folder.
    """

    folder: Path
    identity: str

    def path(self, x: np.ndarray) -> Path:
        """File of a sample; the same numbers give the same file on every machine."""
        digest = hashlib.sha256(self.identity.encode())
        digest.update(np.ascontiguousarray(x, "<f8").tobytes())
        name = digest.hexdigest()
        return self.folder / name[:2] / f"{name}.json"

    def load(self, x: np.ndarray) -> tuple[list[float], int, str] | None:
        """(specs, status, message) of a sample, or None when it has not been simulated."""
        try:
            held = json.loads(self.path(x).read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        specs = [float("nan") if v is None else float(v) for v in held["specs"]]
        return specs, int(held["status"]), str(held["message"])

    def save(self, x: np.ndarray, specs: Sequence[float], status: int, message: str) -> None:
        """Write a sample atomically."""
        path = self.path(x)
        path.parent.mkdir(parents=True, exist_ok=True)
        record = {
            "x": [float(v) for v in x],
            "specs": [float(v) if np.isfinite(v) else None for v in specs],
            "status": status,
            "message": message,
        }
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                json.dump(record, file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise


Result = tuple[list[float], int, str]


@dataclass
class Batch:
    """Shared part of the simulators: cache, duplicates, workers, retries."""

    n_specs: int
    workers: int
    retries: int
    timeout: float
    cache: Path | None
    retry_failed: bool
    identity: str
    messages: dict[int, str] = field(default_factory=dict, init=False)
    simulations: int = field(default=0, init=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)

    def __post_init__(self) -> None:
        for name, least in (("n_specs", 1), ("workers", 1), ("retries", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} = {getattr(self, name)!r} must be at least {least}")
        if not self.timeout > 0.0:
            raise ValueError(f"timeout = {self.timeout!r} s must be positive")

    def run(self, x: np.ndarray, attempt: Callable[[], Attempt]) -> tuple[np.ndarray, np.ndarray]:
        """`x [n, d] -> (specs [n, m], status [n])`; `attempt()` makes what a worker simulates with.

        Raises:
            ValueError: wrong shape, or a row that is not finite, named.
        """
        x = np.asarray(x, np.float64)
        if x.ndim != 2:
            raise ValueError(f"x must be [n, d], got shape {x.shape}")
        bad = np.flatnonzero(~np.all(np.isfinite(x), axis=1))
        if bad.size:
            raise ValueError(f"row {bad[0]} of x is not finite: {x[bad[0]]}")
        store = Cache(Path(self.cache), self.identity) if self.cache is not None else None
        results: dict[bytes, Result] = {}
        waiting: queue.SimpleQueue[np.ndarray] = queue.SimpleQueue()
        for row in {r.tobytes(): r for r in x}.values():
            held = store.load(row) if store else None
            if held is not None and (held[1] == GOOD or not self.retry_failed):
                results[row.tobytes()] = held
            else:
                waiting.put(row)

        errors: list[BaseException] = []

        def work() -> None:
            try:
                with attempt() as one:
                    while not errors:
                        try:
                            row = waiting.get_nowait()
                        except queue.Empty:
                            return
                        result = self._try(one, row)
                        if store:
                            store.save(row, *result)
                        results[row.tobytes()] = result
            except BaseException as error:
                errors.append(error)

        count = min(self.workers, waiting.qsize())
        threads = [threading.Thread(target=work, daemon=True) for _ in range(count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if errors:
            raise errors[0]
        ordered = [results[r.tobytes()] for r in x]
        self.messages = {k: m for k, (_, _, m) in enumerate(ordered) if m}
        specs = np.array([s for s, _, _ in ordered]).reshape(len(x), self.n_specs)
        return specs, np.array([s for _, s, _ in ordered], np.int32)

    def _try(self, one: Attempt, row: np.ndarray) -> Result:
        result: Result = ([], FAILED, "")
        for _ in range(1 + self.retries):
            with self._lock:
                self.simulations += 1
            result = self._check(*one(row, self.timeout))
            if result[1] == GOOD:
                break
        return result

    def _check(self, specs: Any, status: int, message: str) -> Result:
        nothing = [float("nan")] * self.n_specs
        if status != GOOD:
            return nothing, status, message
        try:
            values = np.asarray(specs, np.float64).reshape(-1)
        except (TypeError, ValueError) as error:
            return nothing, FAILED, f"specifications are not numbers: {error}"
        if values.size != self.n_specs:
            return nothing, FAILED, f"{values.size} specifications returned, {self.n_specs} wanted"
        if not np.all(np.isfinite(values)):
            return values.tolist(), NOT_FINITE, f"specifications are not finite: {values.tolist()}"
        return values.tolist(), GOOD, ""


class Attempt(Protocol):
    """What one worker simulates with: opened once, called for every sample."""

    def __enter__(self) -> Attempt: ...

    def __exit__(self, *exc: object) -> None: ...

    def __call__(self, row: np.ndarray, timeout: float) -> tuple[Any, int, str]:
        """(specs, status, message) of one sample."""
