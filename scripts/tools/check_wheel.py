"""Build the wheel, install it into an empty folder and import the packages from outside.

    python scripts/tools/check_wheel.py

Checks that the wheel holds the three packages with their type information and nothing else, and
that importing them prints nothing, warns of nothing and leaves jax's settings alone. Takes about
half a minute.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from snn_fusion_failure.runs import fail, print_result, repository

PACKAGES = ("jaxsnn", "fusion", "failure")

PROBE = f"""
import jax
before = dict(jax.config.values)
import {", ".join(PACKAGES)}
changed = [k for k, v in jax.config.values.items() if before.get(k) != v]
assert not changed, f"import changed jax settings: {{changed}}"
for module in ({", ".join(PACKAGES)}):
    assert "site" in module.__file__, module.__file__
    missing = [name for name in module.__all__ if not hasattr(module, name)]
    assert not missing, f"{{module.__name__}}.__all__ names what is not there: {{missing}}"
"""


def main() -> dict[str, int]:
    """Build, inspect, import; raises on the first thing that is wrong."""
    with tempfile.TemporaryDirectory() as folder:
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, "wheel", "--no-deps", "-w", folder, str(repository.ROOT)], check=True)
        (wheel,) = Path(folder).glob("*.whl")
        names = zipfile.ZipFile(wheel).namelist()
        for package in PACKAGES:
            if f"{package}/py.typed" not in names:
                raise ValueError(f"{wheel.name} lacks {package}/py.typed")
        strangers = {n.split("/")[0] for n in names if ".dist-info" not in n} - set(PACKAGES)
        if strangers:
            raise ValueError(f"{wheel.name} holds more than the packages: {sorted(strangers)}")
        site = Path(folder) / "site"
        subprocess.run(
            [*pip, "install", "--no-deps", "--target", str(site), str(wheel)], check=True
        )
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", PROBE],
            cwd=folder,
            env={"PYTHONPATH": str(site), "PATH": "", "HOME": folder, "JAX_PLATFORMS": "cpu"},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode or done.stdout or done.stderr:
            raise ValueError(f"importing from the wheel was not quiet:\n{done.stdout}{done.stderr}")
    print_result(wheel=wheel.name, files=len(names))
    return {"files": len(names)}


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        fail(str(error))
