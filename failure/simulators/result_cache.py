"""Results of simulations on disk: one whole file each, found again by what was simulated."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

_log = logging.getLogger("failure.simulators")


T = TypeVar("T")


def load_record(path: Path, read: Callable[[dict[str, Any]], T]) -> T | None:
    """A record that `save_record` has written, or None; what cannot be read is set aside, named.

    Args:
        path: file of the record.
        read: what is wanted of it; a record without it cannot be read either.
    """
    try:
        record = json.loads(path.read_bytes())
        if not isinstance(record, dict):
            raise ValueError("no record")
        return read(record)
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        aside = path.with_suffix(".broken")
        os.replace(path, aside)
        why = f"{type(error).__name__}: {error}"
        _log.warning("%s cannot be read (%s): set aside, simulated again", aside, why)
        return None


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

    def load(
        self, x: np.ndarray, n_specs: int | None = None
    ) -> tuple[list[float], int, str] | None:
        """(specs, status, message) of a sample, or None when it has not been simulated.

        Args:
            x: the sample.
            n_specs: how many specifications it must have, where that is known.
        """

        def read(stored: dict[str, Any]) -> tuple[list[float], int, str]:
            specs = [float("nan") if v is None else float(v) for v in stored["specs"]]
            if n_specs is not None and len(specs) != n_specs:
                raise ValueError(f"{len(specs)} specifications: expected {n_specs}")
            return specs, int(stored["status"]), str(stored["message"])

        return load_record(self.path(x), read)

    def save(self, x: np.ndarray, specs: Sequence[float], status: int, message: str) -> None:
        """Write a sample atomically."""
        record = {
            "x": [float(v) for v in x],
            "specs": [float(v) if np.isfinite(v) else None for v in specs],
            "status": int(status),
            "message": message,
        }
        save_record(self.path(x), record)
