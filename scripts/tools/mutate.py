"""Break the code in some seventy places, one at a time: do the tests notice?

    python scripts/tools/mutate.py
    python scripts/tools/mutate.py --only rewards rank

Each edit of `tests/mutants.toml` names a file, what stands there, what to write instead, and the
tests that must fail then. Everything happens in a copy of the repository in a temporary folder.
An edit that no test notices is a survivor: a hole in the tests, or a change without a meaning, and
then the list says why. Exit status 1 when there is a survivor without a reason, or a reason without
a survivor. About ten CPU-minutes.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import WorkFailedError, repository, run_command

LIST = repository.ROOT / "tests" / "mutants.toml"

_SERVER = """
import json, os, sys
import jax, numpy, pytest, scipy.stats, xarray  # once for all: a forked child has them

for line in sys.stdin:
    child = os.fork()
    if child == 0:
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 1), os.dup2(sink, 2), os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os._exit(int(pytest.main(json.loads(line))))
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@dataclasses.dataclass(frozen=True)
class Config:
    """Mutants to run."""

    only: tuple[str, ...] = ()
    """Parts of file names; all edits when left out."""
    timeout: float = 120.0
    """Seconds after which tests that a mutant keeps busy are ended; it counts as noticed."""


@dataclasses.dataclass(frozen=True)
class Mutant:
    """One edit.

    Attributes:
        file: in the repository.
        old, new: what stands there, once, and what is written instead.
        tests: arguments of pytest; one of them must fail.
        survives: why no test can notice.
    """

    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    survives: str = ""

    @property
    def name(self) -> str:
        """In one line."""
        return f"{self.file}: {' '.join(self.old.split())} -> {' '.join(self.new.split())}"

    def apply(self, root: Path) -> str:
        """Write the edit below `root`; returns the text before.

        Raises:
            ValueError: `old` does not stand there exactly once.
        """
        path = root / self.file
        text = path.read_text(encoding="utf-8")
        if text.count(self.old) != 1:
            raise ValueError(
                f"old={self.old!r}: expected once in {self.file}, found {text.count(self.old)} "
                "times; bring tests/mutants.toml up to date"
            )
        path.write_text(text.replace(self.old, self.new), encoding="utf-8")
        return text


def read_list(path: Path = LIST) -> list[Mutant]:
    """The edits of a list, in order."""
    groups = tomllib.loads(path.read_text(encoding="utf-8"))["group"]
    found = []
    for group in groups:
        for edit in group["edits"]:
            old, new, *reason = edit
            found.append(Mutant(group["file"], old, new, tuple(group["tests"]), *reason))
    return found


class Tests:
    """pytest in a copy of the repository, in processes that begin with the libraries loaded."""

    def __init__(self, root: Path, timeout: float) -> None:
        env = {**os.environ, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
        env.setdefault("JAX_PLATFORMS", "cpu")
        self._timeout = timeout
        self._server = subprocess.Popen(
            [sys.executable, "-c", _SERVER], cwd=root, env=env, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip

    def passes(self, tests: tuple[str, ...]) -> bool:
        """Whether these tests pass.

        Raises:
            WorkFailedError: pytest found no such tests, or could not begin.
        """
        import threading

        assert self._server.stdin is not None and self._server.stdout is not None
        options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
        self._server.stdin.write(json.dumps([*options, *tests]) + "\n")
        self._server.stdin.flush()
        child = int(self._server.stdout.readline())
        clock = threading.Timer(self._timeout, _end, (child,))
        clock.start()
        status = int(self._server.stdout.readline())
        clock.cancel()
        if status in (4, 5):  # pytest: wrong usage, nothing collected
            raise WorkFailedError(f"tests={' '.join(tests)}: expected tests; pytest found none")
        return status == 0

    def close(self) -> None:
        """End the server."""
        assert self._server.stdin is not None and self._server.stdout is not None
        self._server.stdin.close()
        self._server.wait()
        self._server.stdout.close()


def _end(child: int) -> None:
    import contextlib
    import signal

    with contextlib.suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)


def copy_repository(target: Path) -> None:
    """What tests need of the repository, as it stands."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=repository.ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    for name in filter(None, listed.stdout.split("\0")):
        source = repository.ROOT / name
        if source.is_file() and not name.startswith(("results/", "docs/")):
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target / name)


def main(config: Config) -> dict[str, Any]:
    """Run the edits; returns how many were noticed and which survived.

    Raises:
        ValueError: no edit is meant.
        WorkFailedError: tests fail without any edit, or survivors and reasons do not agree.
    """
    mutants = [m for m in read_list() if not config.only or any(o in m.file for o in config.only)]
    if not mutants:
        raise ValueError(f"only={' '.join(config.only)}: expected part of a file's name in {LIST}")
    wrong = []
    survivors = 0
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        copy_repository(root)
        tests = Tests(root, config.timeout)
        for group in dict.fromkeys(m.tests for m in mutants):
            if not tests.passes(group):
                raise WorkFailedError(f"tests={' '.join(group)}: fail without any edit")
        for number, mutant in enumerate(mutants, 1):
            start = time.monotonic()
            before = mutant.apply(root)
            survived = tests.passes(mutant.tests)
            (root / mutant.file).write_text(before, encoding="utf-8")
            word = "SURVIVED" if survived else "noticed "
            seconds = time.monotonic() - start
            print(f"{number:>3} {word} {seconds:5.1f} s  {mutant.name}", flush=True)
            if survived:
                survivors += 1
                print(f"      {mutant.survives or 'no test notices'}", flush=True)
            if survived != bool(mutant.survives):
                wrong.append(mutant.name)
        tests.close()
    if wrong:
        raise WorkFailedError(f"{len(wrong)} edits are not as in {LIST.name}: {'; '.join(wrong)}")
    return {"mutants": len(mutants), "noticed": len(mutants) - survivors, "survivors": survivors}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=dict)
