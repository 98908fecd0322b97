"""Trees of arrays on disk, by field names; a file that cannot be read is named and set aside."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from failure.search.spaces import SPACES


def set_aside(path: Path, why: str, instead: str) -> None:
    """Rename a file that cannot be read, and say so."""
    kept, number = path.with_name(path.name + ".damaged"), 1
    while kept.exists():
        kept, number = path.with_name(f"{path.name}.damaged{number}"), number + 1
    os.replace(path, kept)
    warnings.warn(f"{path}: {why}; kept as {kept.name}, {instead}", RuntimeWarning, stacklevel=3)


def write_whole(path: Path, write: Callable[[Any], None]) -> None:
    """Replace a file in one step, so that a kill leaves the old or the new one."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)


def _leaves(tree: Any, name: str) -> dict[str, np.ndarray]:
    """Arrays of nested named tuples and tuples by the path of field names."""
    if tree is None:
        return {}
    if hasattr(tree, "_asdict"):
        parts = tree._asdict().items()
    elif isinstance(tree, tuple | list):
        parts = ((str(k), part) for k, part in enumerate(tree))
    else:
        return {name: np.asarray(tree)}
    return {k: v for key, part in parts for k, v in _leaves(part, f"{name}.{key}").items()}


def save_tree(path: Path, tree: Any, at: int) -> None:
    """Save a space or a surrogate's parts by field names, and the count it was made at."""
    arrays: dict[str, Any] = _leaves(tree, "tree")
    kind = np.asarray(type(tree).__name__)
    write_whole(path, lambda file: np.savez(file, at=np.asarray(at), kind=kind, **arrays))


def _build(arrays: Mapping[str, np.ndarray], name: str, kind: Any, inner: Mapping[str, Any]) -> Any:
    """The tree below `name`: an array, a tuple, a named tuple, or None where nothing is."""
    if name in arrays:
        return jnp.asarray(arrays[name])
    if not any(key.startswith(f"{name}.") for key in arrays):
        return None
    if kind is not None:
        return kind(
            **{
                field: _build(arrays, f"{name}.{field}", inner.get(field), {})
                for field in kind._fields
            }
        )
    count = len(
        {key[len(name) + 1 :].split(".")[0] for key in arrays if key.startswith(name + ".")}
    )
    return tuple(_build(arrays, f"{name}.{k}", None, {}) for k in range(count))


def load_tree(
    path: Path, kind: Any = None, inner: Mapping[str, Any] | None = None
) -> tuple[Any, int] | None:
    """What `save_tree` saved, and its count; None where there is none or it cannot be read.

    Args:
        path: the file.
        kind: the class of the tree; one of `spaces.SPACES` by its saved name without.
        inner: classes of its fields that are named tuples themselves.
    """
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        if kind is None:
            kind, inner = SPACES[str(arrays["kind"])]
        found = _build(arrays, "tree", kind, inner or {})
        if found is None:
            raise ValueError("nothing in it")
        return found, int(arrays["at"])
    except Exception as error:
        set_aside(path, f"{type(error).__name__}: {error}", "computed again")
        return None
