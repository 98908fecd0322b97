"""A user's own simulator behind one protocol: parallel, timed, retried, and never paid twice.

`simulate(x [n, d]) -> (specs [n, m], status [n])`. Wrap a Python function with `FunctionSimulator`
or a program with `CommandSimulator`; both run samples in parallel worker processes, end a sample
that exceeds its time limit, try again, and write every finished sample to a cache on disk before
the next one starts. The status of a sample is a `failure.Status`.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from failure.identities import identity_of
from failure.simulators.batches import Batch
from failure.simulators.processes import Group, SimulatorError, end_group
from failure.status import Status


class Simulator(Protocol):
    """Anything that maps samples to specifications; a circuit's `simulate` is one."""

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`x [n, d] -> (specs [n, m], status [n])`."""


def _serve(function: Callable[[np.ndarray], Any], pipe: Any) -> None:
    """Loop of a worker process: a row in, a result out; the first message says it is ready."""
    # A group of its own: Ctrl-C is the parent's, and what the function starts ends with it.
    if hasattr(os, "setsid"):
        os.setsid()
    pipe.send("ready")
    while True:
        try:
            row = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send((np.asarray(function(row), np.float64), int(Status.GOOD), ""))
        except Exception as error:
            pipe.send((None, int(Status.FAILED), f"{type(error).__name__}: {error}"))


_START_LIMIT = 300.0
"""Longest start of a worker process [s]."""


class _Process:
    """One worker process, started again after it had to be ended."""

    def __init__(self, function: Callable[[np.ndarray], Any], group: Group) -> None:
        self._function = function
        self._group = group
        self._process: Any = None

    def __enter__(self) -> _Process:
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop()

    def _start(self) -> None:
        # Not fork: the parent has threads of its own (XLA's among them).
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(self._function, theirs), daemon=True)
        try:
            process.start()
            self._process = process
            theirs.close()
            # The time limit is the simulation's; starting and importing has one of its own.
            ready = self._pipe.poll(_START_LIMIT) and self._pipe.recv() == "ready"
        except (EOFError, AttributeError, TypeError, pickle.PicklingError):
            ready = False
        if not ready:
            self._stop()
            raise SimulatorError(
                f"function={self._function!r}: expected a top-level function of a module that a "
                "new process can import"
            )
        self._group.adopt(self._process.pid)

    def _stop(self) -> None:
        if self._process is not None:
            self._pipe.close()
            end_group(self._process.pid)
            self._process.kill()
            self._process.join()
            self._group.forget(self._process.pid)
            self._process.close()
            self._process = None

    def __call__(self, row: np.ndarray, timeout: float) -> tuple[Any, int, str]:
        if self._process is None:
            self._start()
        try:
            self._pipe.send(row)
            if self._pipe.poll(timeout):
                result: tuple[Any, int, str] = self._pipe.recv()
                return result
        except (EOFError, OSError):
            self._stop()
            return None, Status.FAILED, "the worker process ended"
        self._stop()
        return None, Status.TIMED_OUT, f"no result after {timeout} s"


@dataclass
class FunctionSimulator:
    """A Python function `f(x [d]) -> m numbers` as a simulator.

    Each of the `workers` is a process of its own, so the function must be importable (a top-level
    function of a module, or a `functools.partial` of one), and one that hangs is killed after
    `timeout` seconds. The cache key is the function's name with what a partial adds to it
    (`failure.identities.identity_of`), and `version`: change it when the function changes.

    Raises:
        ValueError: settings out of range.
        SimulatorError: the function cannot be imported, or never works.

    Example:
        >>> import math
        >>> simulate = FunctionSimulator(math.fsum, n_specs=1)
        >>> specs, status = simulate(np.array([[1.0, 2.0], [0.5, 0.5]]))
        >>> specs[:, 0].tolist(), status.tolist()
        ([3.0, 1.0], [0, 0])
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
        self._batch = Batch(
            self.n_specs,
            self.workers,
            self.retries,
            self.timeout,
            self.cache,
            self.retry_failed,
            f"function {identity_of(self.function)} version {self.version}",
        )

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`x [n, d] -> (specs [n, m], status [n])`; `messages` then tells of each bad row."""
        return self._batch.run(x, lambda group: _Process(self.function, group))

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

    def __init__(self, argv: tuple[str, ...], group: Group) -> None:
        self._argv = argv
        self._group = group

    def __enter__(self) -> _Command:
        return self

    def __exit__(self, *exc: object) -> None:
        pass

    def __call__(self, row: np.ndarray, timeout: float) -> tuple[Any, int, str]:
        done = self._group.run(self._argv, timeout=timeout, stdin=json.dumps(row.tolist()) + "\n")
        if done.returncode is None:
            return None, Status.TIMED_OUT, f"no result after {timeout} s"
        if done.returncode != 0:
            problem = f"exit status {done.returncode}: {done.stderr.strip()[-300:]}"
            return None, Status.FAILED, problem
        lines = done.stdout.strip().splitlines()
        try:
            return json.loads(lines[-1].replace("nan", "NaN")), Status.GOOD, ""
        except (IndexError, ValueError):
            problem = f"last line of the output is no JSON list: {lines[-1:]}"
            return None, Status.FAILED, problem


@dataclass
class CommandSimulator:
    """A program as a simulator: `x` as a JSON list on stdin, specifications as one on stdout.

    The last line of stdout counts, so the program may print what it likes before. The cache key is
    the command, `version`, and the content of the files in `depends` (netlists, model cards).

    Raises:
        ValueError: settings out of range.
        SimulatorError: the program cannot be started, or never works.
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
        self._batch = Batch(
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
        return self._batch.run(x, lambda group: _Command(argv, group))

    @property
    def messages(self) -> Mapping[int, str]:
        """Row -> what went wrong, for the last call."""
        return self._batch.messages

    @property
    def simulations(self) -> int:
        """Simulations started so far, retries included, cache hits not."""
        return self._batch.simulations
