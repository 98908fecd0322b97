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

from snn_fusion_failure.runs.repository import ROOT


def command_line() -> str:
    """The command that is running, as a reader would type it from the repository root."""
    script = Path(sys.argv[0])
    try:
        script = script.resolve().relative_to(ROOT)
    except ValueError:
        script = Path(script.name)
    arguments: list[str] = []
    for argument in sys.argv[1:]:
        if arguments and arguments[-1] == "--data-dir":
            arguments.append("$FUSION_DATA_DIR")
        elif argument.startswith("/"):
            arguments.append(f"PATH/{Path(argument).name}")
        else:
            arguments.append(shlex.quote(argument))
    return " ".join(["python", str(script), *arguments])


def provenance() -> dict[str, Any]:
    """Command, commit, versions, device and date, as a result of record states them."""
    import jax

    names = ("jax", "jaxlib", "flax", "optax", "numpy")
    versions = {"python": platform.python_version()}
    for name in names:
        versions[name] = metadata.version(name)
    try:
        git = subprocess.run(
            ["git", "describe", "--always", "--dirty"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        git = "unknown"
    device = jax.devices()[0]
    kind = f"{device.platform}: {device.device_kind}"
    if device.platform == "cpu":
        kind = f"cpu: {os.cpu_count()} cores, {platform.machine()}"
    return {
        "command": command_line(),
        "git": git,
        "versions": versions,
        "device": kind,
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
    }
