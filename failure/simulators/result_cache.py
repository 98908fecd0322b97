"""Results of simulations on disk: one whole file each, found again by what was simulated."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

_log = logging.getLogger("failure.simulators")


def load_record(path: Path) -> dict[str, Any] | None:
    """A record that `save_record` has written, or None; what cannot be read is set aside, named."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(record, dict):
            raise ValueError("no record")
    except FileNotFoundError:
        return None
    except (ValueError, UnicodeDecodeError) as error:
        aside = path.with_suffix(".broken")
        os.replace(path, aside)
        _log.warning("%s cannot be read (%s): set aside, simulated again", aside, error)
        return None
    return record


def save_record(path: Path, record: dict[str, Any]) -> None:
    """Write a record so that a reader finds it whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            json.dump(record, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


@dataclass(frozen=True)
class Cache:
    """Results by sample, named by the hash of simulator and parameters.

    A run that is killed at any point keeps what it has paid for, and several runs may share a
    folder.
    """

    folder: Path
    identity: str

    def path(self, x: np.ndarray) -> Path:
        """File of a sample; the same numbers give the same file on every machine."""
        digest = hashlib.sha256(self.identity.encode())
        digest.update(np.ascontiguousarray(x, "<f8").tobytes())
        name = digest.hexdigest()
        return self.folder / name[:2] / f"{name}.json"

    def load(self, x: np.ndarray) -> tuple[list[float], int, str] | None:
        """(specs, status, message) of a sample, or None when it has not been simulated."""
        stored = load_record(self.path(x))
        if stored is None:
            return None
        specs = [float("nan") if v is None else float(v) for v in stored["specs"]]
        return specs, int(stored["status"]), str(stored["message"])

    def save(self, x: np.ndarray, specs: Sequence[float], status: int, message: str) -> None:
        """Write a sample atomically."""
        record = {
            "x": [float(v) for v in x],
            "specs": [float(v) if np.isfinite(v) else None for v in specs],
            "status": int(status),
            "message": message,
        }
        save_record(self.path(x), record)
