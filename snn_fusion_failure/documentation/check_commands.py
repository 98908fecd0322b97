"""Run every command of README.md and docs/, each at its smallest size.

    python scripts/tools/check_commands.py
    python scripts/tools/check_commands.py --only train_snn reproduce
    python scripts/tools/check_commands.py --part 0/3

The commands are those that a reader finds, with the options of the table in
snn_fusion_failure/documentation/command_rules.py appended. They run in a copy of the repository in
a temporary folder, with made-up data sets and simulated KITTI frames, so that the repository and
its results/ are not touched. Commands of one area share a process, as a notebook would: what is
imported and compiled once serves the next. One line for each with its time; what is not run says
why; the log of a command that fails is shown. Exit status 1 when one fails. About nine minutes on
two cores, after the test suite has compiled."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import shlex
import shutil
import subprocess
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from snn_fusion_failure.documentation import command_rules, documented, sample_data
from snn_fusion_failure.documentation.executing import Done, run_area
from snn_fusion_failure.documentation.rule import Rule
from snn_fusion_failure.runs import repository, write_text

CHECKED = ("results", "docs", "README.md")
"""What no command may change in the repository itself."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Run the documented commands."""

    only: tuple[str, ...] = ()
    """Only commands in which one of these texts occurs."""
    part: str = "0/1"
    """Of the areas (commands that build on each other) only every N-th, from the I-th: I/N."""
    jobs: int = 2
    """Processes side by side."""
    list: bool = False
    """Print what would be run, and run nothing."""
    keep: Path | None = None
    """Make the copy here and leave it, with a log for each command."""


def missing(rule: Rule) -> str:
    """The program or package that a command needs and that is not here, in words."""
    name = rule.needs
    if not name or shutil.which(name) or importlib.util.find_spec(name):
        return ""
    return f"{name} is not installed"


def state(folder: Path) -> str:
    """What git says of the files that no command may change."""
    held = ""
    for arguments in (["status", "--porcelain"], ["diff", "HEAD"]):
        held += subprocess.run(
            ["git", *arguments, "--", *CHECKED],
            cwd=folder, capture_output=True, text=True, check=False,
        ).stdout  # fmt: skip
    return held


def copy_repository(target: Path) -> None:
    """All files of the repository that git does not ignore."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=repository.ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    for name in filter(None, listed.stdout.split("\0")):
        if (repository.ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(repository.ROOT / name, target / name)


def areas_of(part: str) -> set[str]:
    """The areas of a part I/N, dealt out in alphabetical order.

    Raises:
        ValueError: `part` is not of this form, or I is not below N.

    Example:
        >>> areas_of("0/1") == areas_of("0/2") | areas_of("1/2")
        True
    """
    index, _, count = part.partition("/")
    if not (index.isdigit() and count.isdigit() and int(index) < int(count)):
        raise ValueError(f"part={part!r}: expected I/N with I < N; type for example 0/3")
    areas = sorted({command.area for command in documented.documented()})
    return set(areas[int(index) :: int(count)])


def choose(config: Config) -> tuple[dict[int, documented.Command], dict[int, str]]:
    """Commands to run, and why others are not, by number.

    Raises:
        ValueError: the table has no rule for a command, `part` is no part, or `only` and `part`
            leave none.
    """
    commands = dict(enumerate(documented.documented()))
    areas = areas_of(config.part)
    chosen = {
        n: c
        for n, c in commands.items()
        if c.area in areas and (not config.only or any(text in c.text for text in config.only))
    }
    if not chosen:
        raise ValueError(
            f"only={config.only}, part={config.part!r}: no documented command is left; "
            "see all of them by --list"
        )
    lacking = [c.text for c in chosen.values() if c.rule is None]
    if lacking:
        raise ValueError(
            f"snn_fusion_failure/documentation/command_rules.py has no rule for {lacking[0]!r}"
        )
    why = {n: c.rule.not_run or missing(c.rule) for n, c in chosen.items() if c.rule}
    return {n: c for n, c in chosen.items() if not why[n]}, {n: w for n, w in why.items() if w}


def run_all(config: Config, folder: Path, chosen: dict[int, documented.Command]) -> list[Done]:
    """Run the chosen commands in the copy, area by area, and print a line for each."""
    (folder / "logs").mkdir(parents=True)
    copy_repository(folder)
    areas: dict[str, list[int]] = {}
    for number, command in chosen.items():
        areas.setdefault(command.area, []).append(number)
        # Before anything runs: another process must not see a file go.
        if command.rule and command.rule.forget:
            (folder / command.rule.forget).unlink(missing_ok=True)
        if command.rule and command.rule.held:
            write_text(folder / command.rule.held[0], command.rule.held[1])
    if command_rules.FUSION_DATA in areas:
        sample_data.make_data(folder / "data")
    finished: list[Done] = []
    lock = threading.Lock()

    def one(numbers: list[int]) -> None:
        for done in run_area(folder, numbers):
            with lock:
                finished.append(done)
                share = f"{len(finished)}/{len(chosen)}"
                mark = "FAILED" if done.error else "ok"
                print(
                    f"[{share:>6}] {done.seconds:6.1f} s (CPU {done.cpu:5.1f} s)  {mark:6}  "
                    f"{chosen[done.number].text}",
                    flush=True,
                )
                if done.error:
                    print(explain(folder, done, chosen[done.number]), flush=True)

    with ThreadPoolExecutor(config.jobs) as pool:
        list(pool.map(one, sorted(areas.values(), key=len, reverse=True)))
    return finished


def explain(folder: Path, done: Done, command: documented.Command) -> str:
    """What a command that failed was, and the end of what it printed."""
    lines = [f"  in {command.page}, run as: {shlex.join(command.words)}", f"  {done.error}"]
    for kind in ("out", "err"):
        log = folder / "logs" / f"{done.number:03d}.{kind}"
        if log.exists():
            text = log.read_text(encoding="utf-8", errors="replace").strip()
            lines += [f"  | {line}" for line in text.splitlines()[-8:]]
    return "\n".join(lines)


def main(config: Config) -> dict[str, Any]:
    """Run the commands; returns how many were run, were not run, and failed."""
    chosen, why = choose(config)
    commands = documented.documented()
    for number, reason in why.items():
        print(f"not run: {commands[number].text}: {reason}")
    if config.list:
        for command in chosen.values():
            print(f"{command.area:9} {shlex.join(command.words)}")
        return {"executed": 0, "not_run": len(why), "failed": 0}
    start, before = time.monotonic(), state(repository.ROOT)
    with contextlib.ExitStack() as stack:
        if config.keep is None:
            name = stack.enter_context(tempfile.TemporaryDirectory(prefix="commands-"))
            folder = Path(name).resolve() / "repository"
        else:
            folder = config.keep.resolve()
        finished = run_all(config, folder, chosen)
    failed = sum(bool(done.error) for done in finished)
    if state(repository.ROOT) != before:
        print(f"FAILED: something changed {', '.join(CHECKED)} of the repository meanwhile")
        failed += 1
    return {
        "executed": len(finished),
        "not_run": len(why),
        "failed": failed,
        "seconds": time.monotonic() - start,
        "cpu_seconds": sum(done.cpu for done in finished),
    }
