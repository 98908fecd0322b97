"""The packages import quietly, export what they list, and stand alone."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("jaxsnn", "fusion", "failure")
HEAVY = ("brax", "matplotlib", "orbax", "xarray", "mujoco")


def test_import_is_quiet_and_leaves_settings_and_heavy_libraries_alone() -> None:
    probe = (
        "import sys, jax; before = dict(jax.config.values); "
        f"import {', '.join(PACKAGES)}; "
        "assert before == dict(jax.config.values), 'jax settings changed'; "
        f"print([m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", probe], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
    assert done.stderr == ""


@pytest.mark.parametrize("package", PACKAGES)
def test_all_names_exist(package: str) -> None:
    module = importlib.import_module(package)
    assert module.__all__
    assert [name for name in module.__all__ if not hasattr(module, name)] == []


def _imports(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def test_who_may_import_whom() -> None:
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            tops = {name.split(".")[0] for name in _imports(path)}
            others = (tops & {*PACKAGES, "scripts"}) - {package}
            allowed = {"fusion"} if path.name in ("rev_argate.py", "revnet.py") else set()
            assert others <= allowed, f"{path.relative_to(ROOT)} imports {others - allowed}"
            if "brax" in tops:
                assert path.name == "brax_env.py", f"{path} imports brax"
            if "matplotlib" in tops:
                assert path.name.endswith("plots.py"), f"{path} imports matplotlib"
    for path in (ROOT / "fusion" / "lattice").glob("*.py"):
        inside = {n for n in _imports(path) if n.startswith("fusion")}
        strangers = {n for n in inside if not n.startswith("fusion.lattice") and n != "fusion"}
        assert not strangers, f"{path.name} imports {strangers}: lattices are usable alone"
