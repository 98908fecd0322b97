"""Leases: which chunks somebody is working on, so that nobody else does the same work.

A lease is a file that only one process can create. Its holder touches it while it works; when it
has been silent for too long, or its process on this machine is gone, another one takes it over.
Losing a race costs double work at worst: a chunk's numbers are the same whoever computes them.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import socket
import threading
from pathlib import Path

DEATHS = 3
"""Workers that may die in a chunk before it is given up."""


def _machine() -> str:
    """This machine and, inside a container, its own numbering of processes."""
    try:
        space = os.readlink("/proc/self/ns/pid")
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        space = boot = ""
    return f"{socket.gethostname()} {boot} {space}"


def _gone(text: str) -> bool:
    """Whether the process that wrote a lease ran on this machine and does not any more."""
    try:
        about = json.loads(text)
        if about["machine"] != _machine() or about["pid"] == os.getpid():
            return False
        os.kill(about["pid"], 0)
    except ProcessLookupError:
        return True
    except (ValueError, KeyError, OSError):
        return False
    with contextlib.suppress(OSError):
        # A process that has ended but was not waited for is no worker either.
        return Path(f"/proc/{about['pid']}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    return False


class Lease:
    """A chunk of one's own, until `release` or death."""

    def __init__(self, path: Path, seconds: float) -> None:
        self.path = path
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._beat, args=(seconds / 4,), daemon=True)
        self._thread.start()

    def _beat(self, every: float) -> None:
        while not self._stop.wait(every):
            with contextlib.suppress(OSError):
                os.utime(self.path)

    def release(self) -> None:
        """Give it back."""
        self._stop.set()
        self.path.unlink(missing_ok=True)


def take(out: Path, name: str, seconds: float) -> Lease | None:
    """The lease of a chunk, or None when somebody else works on it.

    A lease whose holder died is taken over, and the death is noted in `dead/`.
    """
    path = out / "leases" / name
    text = json.dumps({"machine": _machine(), "pid": os.getpid(), "token": secrets.token_hex(4)})
    for _ in range(3):
        try:
            handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        except FileNotFoundError:
            path.parent.mkdir(parents=True, exist_ok=True)
            continue
        except FileExistsError:
            if not _break(path, seconds):
                return None
            continue
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        return Lease(path, seconds)
    return None


def _break(path: Path, seconds: float) -> bool:
    """Remove a lease whose holder died; False while it may be alive."""
    try:
        text = path.read_text(encoding="utf-8")
        age = _now(path.parent) - path.stat().st_mtime
    except FileNotFoundError:
        return True  # given back between two looks
    if age < seconds and not _gone(text):
        return False
    grave = path.parent.parent / "dead" / f"{path.name}.{secrets.token_hex(4)}"
    grave.parent.mkdir(exist_ok=True)
    try:
        os.rename(path, grave)  # of several one succeeds
    except FileNotFoundError:
        return True
    if grave.read_text(encoding="utf-8") != text:
        # Somebody was quicker and holds it now: give it back.
        with contextlib.suppress(OSError):
            os.rename(grave, path)
        return False
    return True


def _now(folder: Path) -> float:
    """Time by the clock that stamps files there: machines need not agree on theirs."""
    probe = folder / f".now.{os.getpid()}.{threading.get_ident()}"
    probe.touch()
    try:
        return probe.stat().st_mtime
    finally:
        probe.unlink(missing_ok=True)


def deaths(out: Path, name: str) -> int:
    """Workers that died with this chunk."""
    folder = out / "dead"
    return sum(1 for _ in folder.glob(f"{name}.*")) if folder.is_dir() else 0


def held(out: Path) -> set[str]:
    """Names of all chunks that are leased at this moment."""
    try:
        return {name for name in os.listdir(out / "leases") if not name.startswith(".")}
    except FileNotFoundError:
        return set()
