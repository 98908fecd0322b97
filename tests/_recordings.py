"""Recordings of Brian 2, made again where an interpreter can."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest


def assert_recording_is_made_again(
    reference: Path, recorded: Path, folder: Path, *, tolerance: float
) -> None:
    """The script `reference` gives the numbers of the file `recorded`; skipped without Brian 2."""
    # Brian 2.9 needs an older NumPy than ours, so an environment of its own.
    python = os.environ.get("BRIAN2_PYTHON", sys.executable)
    has = subprocess.run([python, "-c", "import brian2"], capture_output=True, check=False)
    if has.returncode:
        pytest.skip("no Brian 2: set BRIAN2_PYTHON to an interpreter that can import it")
    code = (
        "import importlib.util as u, pathlib\n"
        f"s = u.spec_from_file_location('r', r'{reference}'); m = u.module_from_spec(s)\n"
        f"s.loader.exec_module(m); m.GOLDEN = pathlib.Path(r'{folder}') / 'new.npz'; m.main()\n"
    )
    subprocess.run([python, "-c", code], check=True)
    old, new = np.load(recorded), np.load(folder / "new.npz")
    for name in set(old) - {"versions"}:
        np.testing.assert_allclose(new[name], old[name], rtol=tolerance, atol=tolerance)
