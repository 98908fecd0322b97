"""Documented commands of one area, run one after another in a process of their own.

Commands of an area share the process, as a notebook would: what is imported and compiled once
serves the next. What each prints goes to a log; what went wrong comes back as one line of JSON.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import runpy
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path

from snn_fusion_failure.documentation import documented, sample_data
from snn_fusion_failure.runs import repository


@dataclasses.dataclass(frozen=True)
class Done:
    """One command that was run: wall and CPU seconds, and what went wrong."""

    number: int
    seconds: float
    cpu: float
    error: str = ""


@contextlib.contextmanager
def into_files(log: Path) -> Iterator[None]:
    """All that this process and its children print goes to `log`.out and `log`.err."""
    held = os.dup(1), os.dup(2)
    sys.stdout.flush()
    sys.stderr.flush()
    with (
        log.with_suffix(".out").open("w", encoding="utf-8") as out,
        log.with_suffix(".err").open("w", encoding="utf-8") as err,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            os.dup2(out.fileno(), 1)
            os.dup2(err.fileno(), 2)
            yield
        finally:
            for number, descriptor in enumerate(held, start=1):
                os.dup2(descriptor, number)
                os.close(descriptor)


def execute(words: Sequence[str], log: Path) -> str:
    """Run one command in this process, as `python` would; returns what went wrong."""
    error = ""
    held = sys.argv
    with into_files(log):
        try:
            if words[:2] == ["python", "-c"]:
                exec(compile(words[2], "<command>", "exec"), {"__name__": "__main__"})
            else:
                sys.argv = list(words)
                runpy.run_path(words[0], run_name="__main__")
        except SystemExit as leaving:
            error = f"exit status {leaving.code}" if leaving.code else ""
        except BaseException:
            traceback.print_exc()
            error = traceback.format_exc().strip().splitlines()[-1]
        finally:
            sys.argv = held
    printed = log.with_suffix(".out").read_text(encoding="utf-8").strip().splitlines()
    if not error and words[0] != "python" and not (printed and printed[-1].startswith("result:")):
        error = "the last line is no `result: ...`"
    return error


def cpu_seconds() -> float:
    """CPU time of this process and of its children that have ended."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def work(folder: Path, numbers: Sequence[int]) -> None:
    """Run commands one after another in the copy; a JSON line for each on stdout."""
    commands = documented.documented()
    if folder != repository.ROOT:
        raise RuntimeError(f"scripts come from {repository.ROOT}, expected {folder}")
    logs = folder / "logs"
    if any(commands[n].area == "detector" for n in numbers):
        with into_files(logs / "frames"):
            sample_data.make_frames(folder)
    for number in numbers:
        start, used = time.monotonic(), cpu_seconds()
        error = execute(commands[number].words, logs / f"{number:03d}")
        if (pyplot := sys.modules.get("matplotlib.pyplot")) is not None:
            pyplot.close("all")
        done = Done(number, time.monotonic() - start, cpu_seconds() - used, error)
        print(json.dumps(dataclasses.asdict(done)), flush=True)


def run_area(folder: Path, numbers: Sequence[int]) -> Iterator[Done]:
    """Run commands of one area in a process of their own."""
    environment = os.environ | {
        "PYTHONPATH": str(folder),
        "FUSION_DATA_DIR": str(folder / "data"),
        "MPLBACKEND": "agg",
    }
    environment.setdefault("JAX_COMPILATION_CACHE_DIR", str(repository.ROOT / ".cache" / "jax"))
    environment.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    code = (
        "import sys; from pathlib import Path; "
        "from snn_fusion_failure.documentation.executing import work; "
        "work(Path(sys.argv[1]), [int(n) for n in sys.argv[2:]])"
    )
    left = list(numbers)
    with subprocess.Popen(
        [sys.executable, "-c", code, str(folder), *map(str, numbers)],
        cwd=folder, env=environment, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        for line in process.stdout or ():
            done = Done(**json.loads(line))
            left.remove(done.number)
            yield done
    for number in left:
        yield Done(number, 0.0, 0.0, f"its process ended with status {process.returncode}")
