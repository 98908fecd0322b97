"""Programs started for one simulation each: time limit, whole group ended, none left behind.

Every program leads a process group of its own, so a time limit or Ctrl-C ends it together with the
processes that it has started. For the ends that no code of ours sees (TERM, `kill -9`, a crash) a
guard stands by: a small process that holds one end of a pipe and ends all groups that are still
running when the other end, ours, closes. A program passes a gate first, which opens when the guard
knows of it, so that there is no moment at which it could be left alone.
"""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

_GUARD = """
import os, signal, sys
running = set()
for line in sys.stdin:
    (running.add if line[0] == "+" else running.discard)(int(line[1:]))
for group in running:
    try:
        os.killpg(group, signal.SIGKILL)
    except OSError:
        pass
"""

_GATE = 'read -r go </dev/fd/{0} || exit 125; exec "$@"'
"""Shell text that waits for a line on a file and then becomes the program."""

_lock = threading.Lock()
_guards: dict[int, subprocess.Popen[str]] = {}
"""Process id -> its guard; a forked child starts one of its own."""


class SimulatorError(ValueError):
    """A simulator cannot be started, has never worked, or failed where that was to stop the run."""


def never_worked(failed: int, message: str) -> SimulatorError:
    """The error of a simulator that has failed time and again and never worked."""
    return SimulatorError(
        f"the simulator has failed {failed} times and never worked; its last message: {message}"
    )


def _guard() -> subprocess.Popen[str]:
    held = _guards.get(os.getpid())
    if held is None or held.poll() is not None:
        # Its own session: Ctrl-C in the terminal must not end the guard before its work is done.
        held = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _GUARD],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            text=True,
        )
        _guards.clear()
        _guards[os.getpid()] = held
    return held


def _tell(sign: str, group: int) -> None:
    with _lock:
        stdin = _guard().stdin
        assert stdin is not None
        stdin.write(f"{sign}{group}\n")
        stdin.flush()


def watch(group: int) -> None:
    """Let the guard end a process group when this process is gone."""
    _tell("+", group)


def release(group: int) -> None:
    """The group has ended; the guard forgets it."""
    _tell("-", group)


def end_group(group: int) -> None:
    """Kill all processes of a group."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(group, signal.SIGKILL)


class Finished(NamedTuple):
    """What a program left: exit status (None: it was out of time), output, errors, seconds."""

    returncode: int | None
    stdout: str
    stderr: str
    seconds: float


class Group:
    """Programs that run side by side and can be ended together, from another thread too.

    Example:
        >>> Group().run(["echo", "good"], timeout=10.0).stdout
        'good\\n'
    """

    def __init__(self) -> None:
        self._running: set[int] = set()
        self._ended = False
        self._lock = threading.Lock()

    def end(self) -> None:
        """Kill what is running and start nothing more."""
        with self._lock:
            self._ended = True
            for group in self._running:
                end_group(group)

    def adopt(self, process_id: int) -> None:
        """End a process that leads a group of its own together with the others."""
        with self._lock:
            self._running.add(process_id)
        watch(process_id)

    def forget(self, process_id: int) -> None:
        """An adopted process has ended."""
        with self._lock:
            self._running.discard(process_id)
        release(process_id)

    def run(
        self,
        argv: Sequence[str],
        *,
        timeout: float,
        stdin: str = "",
        cwd: Path | None = None,
        env: Mapping[str, str] | None = None,
    ) -> Finished:
        """Run one program to its end or to its time limit.

        Args:
            argv: program and arguments.
            timeout: limit [s].
            stdin: what it reads.
            cwd: where it runs.
            env: its environment; ours when left out.
        Returns:
            Finished.
        Raises:
            SimulatorError: the program cannot be started, or `end` was called.
        """
        if shutil.which(argv[0]) is None:
            raise SimulatorError(
                f"command={argv[0]!r}: expected a program that can be started; there is none of "
                "this name; give the full path of the simulator"
            )
        # Files, not pipes: a background process that keeps a pipe open would hold us up.
        with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as out, \
                tempfile.TemporaryFile() as err:  # fmt: skip
            given.write(stdin.encode())
            given.seek(0)
            start = time.monotonic()
            gate, opener = os.pipe()
            try:
                with self._lock:
                    if self._ended:
                        raise SimulatorError("the simulations were ended")
                    process = subprocess.Popen(
                        ["/bin/sh", "-c", _GATE.format(gate), "sh", *argv],
                        stdin=given, stdout=out, stderr=err, cwd=cwd, env=env,
                        start_new_session=True, pass_fds=(gate,),
                    )  # fmt: skip
                    self._running.add(process.pid)
                watch(process.pid)
                os.write(opener, b"go\n")
            finally:
                os.close(gate)
                os.close(opener)
            try:
                timed_out = not _wait(process, timeout)
            finally:
                # Also after a good end: what the program left running goes with it.
                end_group(process.pid)
                process.wait()
                self.forget(process.pid)
            seconds = time.monotonic() - start
            texts = []
            for file in (out, err):
                file.seek(0)
                texts.append(file.read().decode("utf-8", errors="replace"))
        return Finished(None if timed_out else process.returncode, texts[0], texts[1], seconds)


def _wait(process: subprocess.Popen[bytes], timeout: float) -> bool:
    """Whether the process ended in time; without polling where the system has process files."""
    if hasattr(os, "pidfd_open"):
        handle = os.pidfd_open(process.pid)
        try:
            poll = select.poll()
            poll.register(handle, select.POLLIN)
            return bool(poll.poll(1e3 * timeout))
        finally:
            os.close(handle)
    try:
        process.wait(timeout)
    except subprocess.TimeoutExpired:
        return False
    return True
