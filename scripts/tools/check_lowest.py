"""Run a few test files in an empty environment with other versions than the suite has.

    python scripts/tools/check_lowest.py
    python scripts/tools/check_lowest.py --keep runs/lowest
    python scripts/tools/check_lowest.py --python python3.13 --versions constraints

The versions are the lower bounds of `pyproject.toml`, or those of `constraints.txt` for a look at
another Python. Takes a few minutes, mostly for installing and compiling; the test files touch each
dependency once.
"""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.runs import repository, run_command

TESTS = (
    "tests/test_packages.py",
    "tests/jaxsnn/test_neurons.py",
    "tests/jaxsnn/test_plasticity.py",
    "tests/fusion/test_losses.py",
    "tests/fusion/test_fusion_plots.py",
    "tests/failure/test_acquisition.py",
    "tests/snn_fusion_failure/test_run.py",
    "tests/snn_fusion_failure/test_sweep_designs.py",
)


@dataclasses.dataclass(frozen=True)
class Config:
    """Check the lower bounds."""

    tests: tuple[str, ...] = TESTS
    """Test files to run."""
    keep: Path | None = None
    """Make the environment here and leave it."""
    python: str = sys.executable
    """The interpreter of the environment: a path or a name on the PATH, for example python3.13."""
    versions: Literal["lowest", "constraints"] = "lowest"
    """Lower bounds of pyproject.toml, or the versions of constraints.txt."""


def lowest(project: dict[str, Any]) -> list[str]:
    """`name==version` of the lower bounds of a project, those of its tests too.

    Raises:
        ValueError: a requirement has no lower bound.

    Example:
        >>> lowest({"dependencies": ["jax>=0.10"], "optional-dependencies": {"test": []}})
        ['jax==0.10']
    """
    pinned = []
    for text in (*project["dependencies"], *project["optional-dependencies"]["test"]):
        found = re.fullmatch(r"([\w.-]+)>=([\d.]+)", text)
        if found is None:
            raise ValueError(f"requirement={text!r}: expected name>=version; give a lower bound")
        version = found[2] if "." in found[2] else f"{found[2]}.0"
        pinned.append(f"{found[1]}=={version}")
    return pinned


def main(config: Config) -> dict[str, Any]:
    """Install and run; the status of the tests is that of the command.

    Raises:
        ValueError: the interpreter is not there, or a requirement has no lower bound.
    """
    interpreter = shutil.which(config.python)
    # A version manager leaves names on the PATH that lead to no interpreter.
    if interpreter is None or subprocess.run([interpreter, "-c", ""], check=False).returncode:
        raise ValueError(
            f"python={config.python!r}: expected an interpreter; install it or give its path"
        )
    text = (repository.ROOT / "pyproject.toml").read_text(encoding="utf-8")
    pinned = lowest(tomllib.loads(text)["project"])
    with tempfile.TemporaryDirectory(prefix="lowest-") as temporary:
        folder = config.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        listed = repository.ROOT / "constraints.txt"
        if config.versions == "lowest":
            listed = folder / "lowest.txt"
            listed.write_text("\n".join(pinned) + "\n", encoding="utf-8")
        subprocess.run([interpreter, "-m", "venv", str(folder / "venv")], check=True)
        python = str(folder / "venv" / "bin" / "python")
        names = [pin.split("==")[0] for pin in pinned]
        pip = [python, "-m", "pip", "install", "-q", "--disable-pip-version-check"]
        subprocess.run([*pip, "-c", str(listed), *names], check=True)
        environment = os.environ | {"PYTHONPATH": str(repository.ROOT)}
        # Programs that another version of jax has compiled are of no use.
        environment["JAX_COMPILATION_CACHE_DIR"] = str(folder / "cache")
        done = subprocess.run(
            [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *config.tests],
            cwd=repository.ROOT, env=environment, check=False,
        )  # fmt: skip
    return {"packages": len(pinned), "files": len(config.tests), "failed": done.returncode}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=dict)
