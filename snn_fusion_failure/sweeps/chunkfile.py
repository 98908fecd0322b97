"""One chunk as a file: an npz archive with its own checksum behind it."""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.runs.files import write_bytes

_MARK = b"sha256:"
_TAIL = len(_MARK) + 64


class DamagedError(ValueError):
    """A chunk file is not what was written; `path` is the file."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(f"{path}: damaged, {what}")
        self.path = path


def save_chunk(
    path: Path,
    trials: np.ndarray,
    words: np.ndarray,
    metrics: Mapping[str, np.ndarray],
    status: np.ndarray,
    *,
    carry: Sequence[np.ndarray] = (),
    **about: Any,
) -> None:
    """Write a chunk atomically: a reader sees all of it or nothing, even after a power cut.

    Args:
        path: the file.
        trials: setting and seed of each, `[n, 2]`.
        words: digest of each setting, `[n, 2]`.
        metrics: name -> `[n]`.
        status: `[n]`.
        carry: leaves `[n, ...]` from which the trials can be gone on with.
        about: JSON values: `seconds`, `messages` (trial -> what went wrong), `source`, `notes`.
    """
    arrays: dict[str, Any] = {f"metric_{name}": np.asarray(v) for name, v in metrics.items()}
    arrays |= {f"carry_{i:03d}": np.asarray(leaf) for i, leaf in enumerate(carry)}
    buffer = io.BytesIO()
    np.savez(
        buffer, trial=trials.astype(np.int32), words=words, status=status,
        about=np.asarray(json.dumps(about)), **arrays,
    )  # fmt: skip
    body = buffer.getvalue()
    # As the comment of the archive, whose length stands in its last two bytes: still an npz.
    mark = _MARK + hashlib.sha256(body).hexdigest().encode()
    write_bytes(path, body[:-2] + _TAIL.to_bytes(2, "little") + mark)


def load_chunk(
    path: Path, names: Sequence[str] | None = None, *, carry: bool = False
) -> dict[str, Any]:
    """`trial`, `words`, `status`, `about`, the named metrics (all: None) and, if asked, `carry`.

    Raises:
        DamagedError: the checksum is wrong; names the file.
    """
    data = path.read_bytes()
    body, mark = data[:-_TAIL], data[-_TAIL:]
    body = body[:-2] + b"\0\0"
    if mark != _MARK + hashlib.sha256(body).hexdigest().encode():
        raise DamagedError(path, f"{len(data)} bytes that do not fit their checksum")
    try:
        with np.load(io.BytesIO(body)) as held:
            if names is None:
                names = [k.removeprefix("metric_") for k in held.files if k.startswith("metric_")]
            found: dict[str, Any] = {name: held[f"metric_{name}"] for name in names}
            found |= {name: held[name] for name in ("trial", "words", "status")}
            found["about"] = json.loads(str(held["about"]))
            if carry:
                leaves = sorted(k for k in held.files if k.startswith("carry_"))
                found["carry"] = [held[k] for k in leaves]
            return found
    except (KeyError, ValueError) as error:
        raise DamagedError(path, str(error)) from error


def set_aside(path: Path) -> Path:
    """Move a damaged chunk out of the way, so that it is computed again; returns where it went."""
    target = path.parent.parent / "damaged" / path.name
    target.parent.mkdir(exist_ok=True)
    number = 0
    while target.exists():
        number += 1
        target = target.with_name(f"{path.stem}.{number}.npz")
    os.replace(path, target)
    return target
