"""What made a number: command, commit, versions, device and date."""

from __future__ import annotations

import datetime
import os
import platform
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs.repository import IS_CHECKOUT, ROOT, require_checkout

ALLOW_DIRTY = "SFF_ALLOW_DIRTY"
"""Environment variable that lets a command record numbers from changed, uncommitted code."""
_NOT_CODE = (":(exclude)results", ":(exclude)docs")
# What recording itself writes: a second command after it is not made by other code.


def command_line() -> str:
    """The command that is running, as a reader would type it from the repository root."""
    script = Path(sys.argv[0])
    if script.name == "sff":
        head = ["sff"]
    else:
        try:
            script = script.resolve().relative_to(ROOT)
        except ValueError:
            script = Path(script.name)
        head = ["python", str(script)]
    arguments: list[str] = []
    for argument in sys.argv[1:]:
        if arguments and arguments[-1] == "--data-dir":
            arguments.append("$FUSION_DATA_DIR")
        elif argument.startswith("/"):
            arguments.append(f"PATH/{Path(argument).name}")
        else:
            arguments.append(shlex.quote(argument))
    return " ".join([*head, *arguments])


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def changed_code() -> list[str]:
    """Files of the checkout that differ from the commit, results and pages left out."""
    if not IS_CHECKOUT:
        return []
    try:
        lines = _git("status", "--porcelain", "--untracked-files=no", "--", ".", *_NOT_CODE)
    except (OSError, subprocess.CalledProcessError):
        return []
    return [line[3:] for line in lines.splitlines()]


def commit() -> str:
    """The commit, with `-dirty` behind it where code was changed; the version of a wheel."""
    from snn_fusion_failure import __version__

    if not IS_CHECKOUT:
        return f"{__version__} (installed)"
    try:
        name = _git("describe", "--always")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{name}-dirty" if changed_code() else name


def check_recordable(option: str = "--record") -> None:
    """Refuse to write a result of record where nobody could say which code made it.

    Raises:
        ValueError: there is no checkout, or its code was changed and not committed and
            `SFF_ALLOW_DIRTY=1` is not set. Numbers that are recorded all the same carry `-dirty`
            in their `git` field.
    """
    require_checkout(option)
    changed = changed_code()
    if changed and os.environ.get(ALLOW_DIRTY) != "1":
        few = ", ".join(changed[:3]) + (" ..." if len(changed) > 3 else "")
        raise ValueError(
            f"{option}: expected committed code, so that a number of record names what made it; "
            f"{few} changed; commit first, or set {ALLOW_DIRTY}=1, which the file will say"
        )


def versions() -> dict[str, str]:
    """Versions of Python and of the libraries that numbers depend on."""
    found = {"python": platform.python_version()}
    for name in ("jax", "jaxlib", "flax", "optax", "numpy"):
        found[name] = metadata.version(name)
    return found


def provenance() -> dict[str, Any]:
    """Command, commit, versions, device and date, as a result of record states them."""
    import jax

    device = jax.devices()[0]
    kind = f"{device.platform}: {device.device_kind}"
    if device.platform == "cpu":
        kind = f"cpu: {os.cpu_count()} cores, {platform.machine()}"
    return {
        "command": command_line(),
        "git": commit(),
        "versions": versions(),
        "device": kind,
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
    }
