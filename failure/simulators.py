"""A user's own simulator behind one protocol: parallel, timed, retried, and never paid twice.

`simulate(x [n, d]) -> (specs [n, m], status [n])`. Wrap a Python function with `FunctionSimulator`
or a program with `CommandSimulator`; both run samples in parallel worker processes, end a sample
that exceeds its time limit, try again, and write every finished sample to a cache on disk before
the next one starts. Status: 0 good, 1 failed, 2 out of time, 3 not finite.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import queue
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

__all__ = [
    "FAILED",
    "GOOD",
    "NOT_FINITE",
    "STATUS",
    "TIMED_OUT",
    "Cache",
    "CommandSimulator",
    "FunctionSimulator",
    "Simulator",
]

GOOD, FAILED, TIMED_OUT, NOT_FINITE = 0, 1, 2, 3
STATUS = {GOOD: "good", FAILED: "failed", TIMED_OUT: "out of time", NOT_FINITE: "not finite"}


class Simulator(Protocol):
    """Anything that maps samples to specifications; a circuit's `simulate` is one."""

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`x [n, d] -> (specs [n, m], status [n])`."""


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
class _Batch:
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

    def run(self, x: np.ndarray, attempt: Callable[[], _Attempt]) -> tuple[np.ndarray, np.ndarray]:
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

    def _try(self, one: _Attempt, row: np.ndarray) -> Result:
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


class _Attempt(Protocol):
    def __enter__(self) -> _Attempt: ...

    def __exit__(self, *exc: object) -> None: ...

    def __call__(self, row: np.ndarray, timeout: float) -> tuple[Any, int, str]: ...


def _serve(function: Callable[[np.ndarray], Any], pipe: Any) -> None:
    """Loop of a worker process: a row in, a result out; the first message says it is ready."""
    pipe.send("ready")
    while True:
        try:
            row = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send((np.asarray(function(row), np.float64), GOOD, ""))
        except Exception as error:
            pipe.send((None, FAILED, f"{type(error).__name__}: {error}"))


_START_LIMIT = 300.0
"""Longest start of a worker process [s]."""


class _Process:
    """One worker process, started again after it had to be ended."""

    def __init__(self, function: Callable[[np.ndarray], Any]) -> None:
        self._function = function
        self._process: Any = None

    def __enter__(self) -> _Process:
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop()

    def _start(self) -> None:
        # Not fork: the parent has threads of its own (XLA's among them).
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(self._function, theirs), daemon=True)
        self._process.start()
        theirs.close()
        # The time limit is the simulation's; starting a process and importing has one of its own.
        try:
            ready = self._pipe.poll(_START_LIMIT) and self._pipe.recv() == "ready"
        except EOFError:
            ready = False
        if not ready:
            self._stop()
            raise ValueError(
                f"no worker process for {self._function!r}: it must be a top-level function of a "
                "module that a new process can import"
            )

    def _stop(self) -> None:
        if self._process is not None:
            self._pipe.close()
            self._process.kill()
            self._process.join()
            self._process.close()
            self._process = None

    def __call__(self, row: np.ndarray, timeout: float) -> tuple[Any, int, str]:
        if self._process is None:
            self._start()
        self._pipe.send(row)
        try:
            if self._pipe.poll(timeout):
                result: tuple[Any, int, str] = self._pipe.recv()
                return result
        except EOFError:
            self._stop()
            return None, FAILED, "the worker process ended"
        self._stop()
        return None, TIMED_OUT, f"no result after {timeout} s"


@dataclass
class FunctionSimulator:
    """A Python function `f(x [d]) -> m numbers` as a simulator.

    Each of the `workers` is a process of its own, so the function must be importable (a top-level
    function of a module), and one that hangs is killed after `timeout` seconds. `version` belongs
    to the cache key: change it when the function changes.

    Raises:
        ValueError: settings out of range.
    """

    function: Callable[[np.ndarray], Any]
    n_specs: int
    workers: int = 1
    timeout: float = 60.0
    retries: int = 1
    cache: Path | None = None
    version: str = "1"
    retry_failed: bool = False

    def __post_init__(self) -> None:
        name = f"{self.function.__module__}.{self.function.__qualname__}"
        self._batch = _Batch(
            self.n_specs,
            self.workers,
            self.retries,
            self.timeout,
            self.cache,
            self.retry_failed,
            f"function {name} version {self.version}",
        )

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`x [n, d] -> (specs [n, m], status [n])`; `messages` then tells of each bad row."""
        return self._batch.run(x, lambda: _Process(self.function))

    @property
    def messages(self) -> Mapping[int, str]:
        """Row -> what went wrong, for the last call."""
        return self._batch.messages

    @property
    def simulations(self) -> int:
        """Simulations started so far, retries included, cache hits not."""
        return self._batch.simulations


class _Command:
    """One attempt is one process of the user's program."""

    def __init__(self, argv: tuple[str, ...]) -> None:
        self._argv = argv

    def __enter__(self) -> _Command:
        return self

    def __exit__(self, *exc: object) -> None:
        pass

    def __call__(self, row: np.ndarray, timeout: float) -> tuple[Any, int, str]:
        try:
            process = subprocess.Popen(
                self._argv,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
        except OSError as error:
            raise ValueError(
                f"cannot start {self._argv[0]!r}: {error}; give the full path of the simulator"
            ) from error
        try:
            out, err = process.communicate(json.dumps(row.tolist()) + "\n", timeout)
        except subprocess.TimeoutExpired:
            # Its own session: children that the program has started go with it.
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return None, TIMED_OUT, f"no result after {timeout} s"
        if process.returncode != 0:
            return None, FAILED, f"exit status {process.returncode}: {err.strip()[-300:]}"
        lines = out.strip().splitlines()
        try:
            return json.loads(lines[-1].replace("nan", "NaN")), GOOD, ""
        except (IndexError, ValueError):
            return None, FAILED, f"last line of the output is no JSON list: {lines[-1:]}"


@dataclass
class CommandSimulator:
    """A program as a simulator: `x` as a JSON list on stdin, specifications as one on stdout.

    The last line of stdout counts, so the program may print what it likes before. The cache key is
    the command, `version`, and the content of the files in `depends` (netlists, model cards).

    Raises:
        ValueError: settings out of range, or the program cannot be started.
    """

    argv: Sequence[str]
    n_specs: int
    workers: int = 1
    timeout: float = 60.0
    retries: int = 1
    cache: Path | None = None
    version: str = "1"
    depends: Sequence[Path] = ()
    retry_failed: bool = False

    def __post_init__(self) -> None:
        self.argv = tuple(str(a) for a in self.argv)
        parts = [f"command {json.dumps(self.argv)} version {self.version}"]
        for path in self.depends:
            parts.append(hashlib.sha256(Path(path).read_bytes()).hexdigest())
        self._batch = _Batch(
            self.n_specs,
            self.workers,
            self.retries,
            self.timeout,
            self.cache,
            self.retry_failed,
            "\n".join(parts),
        )

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`x [n, d] -> (specs [n, m], status [n])`; `messages` then tells of each bad row."""
        argv = tuple(self.argv)
        return self._batch.run(x, lambda: _Command(argv))

    @property
    def messages(self) -> Mapping[int, str]:
        """Row -> what went wrong, for the last call."""
        return self._batch.messages

    @property
    def simulations(self) -> int:
        """Simulations started so far, retries included, cache hits not."""
        return self._batch.simulations
