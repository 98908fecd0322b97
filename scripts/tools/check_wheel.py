"""Build the wheel, install it into a fresh environment and work with it from outside.

    python scripts/tools/check_wheel.py

Checks what the wheel holds, that importing is quiet, that the links of its long description are
absolute, and that the commands work where there is no repository: a sweep of a study in the current
directory, from the shell and from Python; a training; a search for failures of a two-line
simulator; where ngspice is installed, one of a netlist of `examples/`; `--help` of all commands;
`--record` refused. The environment shares the libraries of the running Python
(`--full` installs them all from the registry). Two to three minutes.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from pathlib import Path

from snn_fusion_failure.cli import COMMANDS
from snn_fusion_failure.runs import print_result, repository, run_command

PACKAGES = ("jaxsnn", "fusion", "failure", "snn_fusion_failure")

PROBE = f"""
import jax
before = dict(jax.config.values)
import {", ".join(PACKAGES)}
changed = [k for k, v in jax.config.values.items() if before.get(k) != v]
assert not changed, f"import changed jax settings: {{changed}}"
for module in ({", ".join(PACKAGES)}):
    assert "site-packages" in module.__file__, module.__file__
    missing = [name for name in module.__all__ if not hasattr(module, name)]
    assert not missing, f"{{module.__name__}}.__all__ names what is not there: {{missing}}"
"""

STUDY = """
import jax, jax.numpy as jnp

def trial(params, key):
    x = params["width"] * jax.random.normal(key, (100,))
    return {"spread": jnp.std(x)}
"""

SWEEP = """
from my_study import trial
from snn_fusion_failure.sweeps import choice, grid, loguniform, sweep

data = sweep(trial, space={"width": grid(1.0, 3.0)}, seeds=4, out="runs/mine")
assert dict(data.sizes) == {"width": 2, "seed": 4}, data.sizes
assert float(data["spread"].sel(width=3.0).mean()) > 2.0
"""

SIMULATOR = """
def simulate(x):
    return -abs(x - 2.5).sum()
"""

MAP = """
{"target": [400, 300], "starts": [[90, 300, 20]], "circles": [[250, 400, 30]]}
"""


@dataclasses.dataclass(frozen=True)
class Config:
    """How to check."""

    full: bool = False
    """Install every dependency from the registry rather than share those of this Python."""
    commands: bool = True
    """Run the commands as well; without, build and import only."""


def check_contents(wheel: Path) -> int:
    """What is in the wheel and what must not be; returns the number of files."""
    archive = zipfile.ZipFile(wheel)
    names = archive.namelist()
    needed = [f"{package}/py.typed" for package in PACKAGES]
    needed += ["snn_fusion_failure/results/source_tables.json", "jaxsnn/native/window.cc"]
    for name in needed:
        if name not in names:
            raise ValueError(f"{wheel.name} lacks {name}")
    strangers = {n.split("/")[0] for n in names if ".dist-info" not in n} - set(PACKAGES)
    if strangers:
        raise ValueError(f"{wheel.name} holds more than the packages: {sorted(strangers)}")
    (about,) = (n for n in names if n.endswith(".dist-info/METADATA"))
    text = archive.read(about).decode()
    if "](docs/" in text or "](LICENSE" in text:
        raise ValueError("the long description has links that only work in the repository")
    if "Project-URL: Repository" not in text:
        raise ValueError("the wheel names no repository")
    return len(names)


def environment(folder: Path, wheel: Path, full: bool) -> Path:
    """A fresh virtual environment with the wheel; returns its folder of programs."""
    venv = folder / "venv"
    subprocess.run([sys.executable, "-m", "venv", str(venv)], check=True)
    python = venv / "bin" / "python"
    pip = [str(python), "-m", "pip", "--quiet", "--disable-pip-version-check", "install"]
    subprocess.run([*pip, *(() if full else ("--no-deps",)), str(wheel)], check=True)
    if not full:
        # A plain line adds the folder, but not the editable installs that it has `.pth` files of.
        (site,) = (venv / "lib").glob("python*/site-packages")
        (site / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return venv / "bin"


def run(command: list[str], folder: Path, *, status: int = 0) -> str:
    """Output of a command in a clean environment; raises when it ends otherwise."""
    kept = ("HOME", "PATH", "JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME")
    env = {name: os.environ[name] for name in kept if name in os.environ}
    env |= {"JAX_PLATFORMS": "cpu", "MPLBACKEND": "agg"}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    if done.returncode != status:
        raise ValueError(
            f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout}{done.stderr[-3000:]}"
        )
    return done.stdout + done.stderr


def check_help(sff: str, folder: Path) -> int:
    """Every command is listed and explains itself; returns how many commands ran."""
    listed = run([sff], folder)
    for name in COMMANDS:
        if f"  {name} " not in listed:
            raise ValueError(f"sff: expected {name!r} in its list\n{listed}")
        found = run([sff, name, "--help"], folder)
        if f"usage: sff {name}" not in found:
            raise ValueError(f"sff {name} --help: expected its usage in\n{found}")
    return 1 + len(COMMANDS)


def netlist_commands(sff: str, folder: Path) -> list[tuple[list[str], str]]:
    """A search in one of the netlists, which are copied to `folder`; none without ngspice."""
    for file in (repository.ROOT / "examples").glob("*.cir"):
        shutil.copy(file, folder)
    if shutil.which("ngspice") is None:
        print("== ngspice is not installed: the search in a netlist is left out", flush=True)
        return []
    options = ["--netlist", "sram_cell.cir", "--vary", "pu1:20m", "pd1:20m", "ax1:20m"]
    options += ["--measure", "snm1>=130", "--n-total", "30", "--out", "runs/cell"]
    return [([sff, "find-failures", *options], "worst_distance=6.2")]


def check_commands(programs: Path, folder: Path) -> int:
    """A user's own study, simulator, netlist and training; returns how many commands ran."""
    work = folder / "work"
    (work / "scripts").mkdir(parents=True)
    (work / "scripts" / "__init__.py").write_text("raise RuntimeError('not ours')\n")
    (work / "my_study.py").write_text(STUDY)
    (work / "use_it.py").write_text(SWEEP)
    (work / "my_simulator.py").write_text(SIMULATOR)
    (work / "my.json").write_text(MAP)
    sff, python = str(programs / "sff"), str(programs / "python")
    sweep = [sff, "sweep", "--study", "my_study:trial", "--grid", "width=1,2,3", "--seeds", "4"]
    commands = [
        ([python, "use_it.py"], ""),
        ([*sweep, "--out", "runs/shell", "--quiet"], "complete=True"),
        ([*sweep, "--out", "runs/two", "--quiet", "--workers", "2"], "complete=True"),
        ([sff, "sweep", "show", "runs/shell"], "width"),
        ([sff, "train-argate", "--dataset", "simulated", "--preset", "quick"], "result: "),
        ([sff, "find-failures", "--circuit", "my_simulator:simulate", "--dimensions", "2",
          "--spec", "value", "--preset", "quick", "--threshold=-1"], "success=1"),
        ([sff, "train-snn", "--map", "my.json", "--seeds", "1", "--max-steps", "3",
          "--preset", "quick"], "result: "),
        *netlist_commands(sff, work),
    ]  # fmt: skip
    for command, wanted in commands:
        print("==", " ".join(Path(c).name if c == command[0] else c for c in command), flush=True)
        found = run(command, work)
        if wanted not in found:
            raise ValueError(f"{' '.join(command)}: expected {wanted!r} in\n{found}")
    refused = run([sff, "train-snn", "--record"], work, status=2)
    if "expected a checkout" not in refused:
        raise ValueError(f"--record was not refused with its reason:\n{refused}")
    return len(commands) + 1 + check_help(sff, work)


def main(config: Config) -> dict[str, int]:
    """Build, inspect, import, work; raises on the first thing that is wrong."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, "wheel", "--no-deps", "-w", name, str(repository.ROOT)], check=True)
        (wheel,) = folder.glob("*.whl")
        files = check_contents(wheel)
        programs = environment(folder, wheel, config.full)
        loud = run([str(programs / "python"), "-W", "error", "-c", PROBE], folder)
        if loud:
            raise ValueError(f"importing from the wheel was not quiet:\n{loud}")
        commands = check_commands(programs, folder) if config.commands else 0
    print_result(wheel=wheel.name, files=files, commands=commands)
    return {"files": files, "commands": commands}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
