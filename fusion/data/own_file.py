"""One's own windows from an `.npz` file of a small, checked schema, and recordings from CSV."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fusion.data.arrays import from_arrays
from fusion.data.dataset import Dataset

SCHEMA = {
    "x": "[N, K, T] windows of K sensors, or [N, K] single readings, in their own units",
    "y": "[N] class numbers or names",
    "groups": "[N] what must not be torn apart, such as a person; optional",
    "channels": "[K] names of the sensors; optional",
    "classes": "[C] names of the class numbers; optional",
}
"""Arrays of the file."""


def load_file(path: str | Path, *, seed: int = 0) -> Dataset:
    """Read, check, split and scale a file of windows.

    Args:
        path: `.npz` with the arrays of `SCHEMA`, without pickled objects.
        seed: of the draw of test rows, a quarter of the groups (or rows).

    Raises:
        FileNotFoundError: it is not there.
        ValueError: no `.npz`, arrays missing, unknown, pickled, or not of their shape.
    """
    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"data={str(file)!r}: no such file; check the path")
    try:
        with np.load(file, allow_pickle=False) as held:
            arrays: dict[str, Any] = {name: held[name] for name in held.files}
    except (ValueError, OSError, AttributeError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"data={str(file)!r}: expected an .npz file of plain arrays ({error}); write it with "
            "numpy.savez, names as arrays of strings"
        ) from None
    missing = [name for name in ("x", "y") if name not in arrays]
    unknown = sorted(set(arrays) - set(SCHEMA))
    if missing or unknown:
        names = ", ".join(f"{name} {text}" for name, text in SCHEMA.items())
        raise ValueError(
            f"data={str(file)!r} with arrays {sorted(arrays)}: expected {names}; "
            f"{'add ' + ', '.join(missing) if missing else 'rename ' + ', '.join(unknown)}"
        )
    x = arrays.pop("x")
    given = {n: [str(v) for v in arrays.pop(n)] for n in ("channels", "classes") if n in arrays}
    return from_arrays(
        x[:, :, None] if x.ndim == 2 else x,
        arrays["y"],
        groups=arrays.get("groups"),
        channels=given.get("channels"),
        classes=given.get("classes"),
        seed=seed,
    )


def read_recording(path: Path, channels: Sequence[str]) -> np.ndarray:
    """A recording `[sample, sensor]` from CSV, its columns in the order of the channels.

    Args:
        path: header of channel names, one sample a line; an empty cell is a lost sample (NaN).
        channels: of the network; other columns are left out.

    Raises:
        ValueError: missing columns, or a cell that is no number, with its line.
    """
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        missing = [c for c in channels if c not in (rows.fieldnames or ())]
        if missing:
            raise ValueError(f"{path}, line 1: columns {missing} are missing from the header")
        found = []
        for number, row in enumerate(rows, start=2):
            try:
                found.append([float(row[c] or "nan") for c in channels])
            except (TypeError, ValueError):
                raise ValueError(
                    f"{path}, line {number}: expected {len(channels)} numbers; leave the cell of a "
                    "lost sample empty"
                ) from None
    return np.asarray(found).reshape(-1, len(channels))
