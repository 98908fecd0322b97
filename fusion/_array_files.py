"""Files of arrays and a JSON header, whole or absent, without pickled objects."""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_type_hints

import jax.numpy as jnp
import numpy as np


def write_arrays(path: Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write an `.npz`; a reader sees the old file or the new one."""
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    if path.is_dir():
        raise ValueError(f"path={str(path)!r}: expected a file, not a folder; add a name")
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, header=text, **arrays)  # type: ignore[arg-type]
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_arrays(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file of `write_arrays`.

    Raises:
        FileNotFoundError: it is not there.
        ValueError: it is no such file.
    """
    if not path.exists():
        raise FileNotFoundError(f"path={str(path)!r}: expected a file; there is none, check it")
    try:
        # A stream of our own, since numpy leaves that of a damaged file open.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            held = {name: file[name] for name in file.files}
        return json.loads(held.pop("header").tobytes()), held
    except Exception:  # numpy says in many ways that a file is none of its own, or cut off
        raise ValueError(
            f"path={str(path)!r}: expected a whole file of FittedARGate.save or "
            "FittedSensors.save; check the path, or save it again"
        ) from None


def flatten(tree: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """Nested dictionaries as one, with names like `gate/split/bias`."""
    if not isinstance(tree, dict):
        return {prefix: np.asarray(tree)}
    return {
        name: value
        for key, branch in tree.items()
        for name, value in flatten(branch, f"{prefix}/{key}" if prefix else key).items()
    }


def unflatten(flat: dict[str, np.ndarray]) -> dict[str, Any]:
    """The inverse of `flatten`, with arrays on the device."""
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *path, last = name.split("/")
        branch = tree
        for key in path:
            branch = branch.setdefault(key, {})
        branch[last] = jnp.asarray(value)
    return tree


def build(kind: Any, values: Any) -> Any:
    """A frozen dataclass from the JSON of `dataclasses.asdict`; lists become tuples."""
    if isinstance(values, list):
        return tuple(build(None, value) for value in values)
    if not isinstance(values, dict):
        return values
    made = {}
    for name, hint in get_type_hints(kind).items():
        # `LossConfig | None` holds a LossConfig where the value is a mapping.
        inner = (k for k in (hint, *getattr(hint, "__args__", ())) if dataclasses.is_dataclass(k))
        made[name] = build(next(inner, None), values[name])
    return kind(**made)
