"""Files that are either whole or absent, and values as plain JSON."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import secrets
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

_STALE = 10.0
"""Seconds after which the claim of a process that died between two calls is removed."""


def to_jsonable(value: Any) -> Any:
    """Dataclasses, paths, arrays and numpy scalars as plain JSON values; NaN becomes `null`."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return to_jsonable(dataclasses.asdict(value))
    if isinstance(value, dict):
        return {str(k): to_jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set):
        return [to_jsonable(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return to_jsonable(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


@contextlib.contextmanager
def _beside(path: Path) -> Iterator[tuple[IO[bytes], Path]]:
    """A new file in the folder of `path`, synchronised on leaving, deleted after an exception.

    Its name begins with a dot, so that no reader takes it for the file that it becomes. Opened
    rather than made by `tempfile`, whose files are private whatever the user's umask.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.parent / f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}"
    handle = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    try:
        with os.fdopen(handle, "wb") as file:
            yield file, temporary
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path` atomically: a reader sees the old file or the new one."""
    with _beside(path) as (file, temporary):
        file.write(data)
    try:
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` atomically: a reader sees the old file or the new one."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "found.json"
        >>> write_json(path, {"rate": float("nan"), "n": 2})
        >>> json.loads(path.read_text(encoding="utf-8"))
        {'rate': None, 'n': 2}
    """
    write_text(path, json.dumps(to_jsonable(value), indent=1, allow_nan=False) + "\n")


def create_once(path: Path, text: str) -> bool:
    """Write a file unless it is there already; of several writers exactly one succeeds.

    A hard link fails where the file exists. File systems without links (exFAT, SMB, FUSE) get the
    same guarantee from a claim file that only one process can create.

    Returns:
        Whether this call made the file. Either way it is there, and whole.
    """
    if path.exists():
        return False
    with _beside(path) as (file, temporary):
        file.write(text.encode("utf-8"))
    try:
        try:
            os.link(temporary, path)
        except FileExistsError:
            return False
        except OSError:
            return _rename_once(temporary, path)
        return True
    finally:
        temporary.unlink(missing_ok=True)


def _rename_once(temporary: Path, path: Path) -> bool:
    claim = path.with_name(f".{path.name}.claim")
    while not path.exists():
        try:
            os.close(os.open(claim, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        except FileExistsError:
            with contextlib.suppress(FileNotFoundError):
                if time.time() - claim.stat().st_mtime > _STALE:
                    claim.unlink()
            time.sleep(0.01)
            continue
        try:
            if path.exists():
                return False
            os.replace(temporary, path)
            return True
        finally:
            claim.unlink(missing_ok=True)
    return False


def append_metrics(out: Path, record: dict[str, Any]) -> None:
    """Append one line to `metrics.jsonl` of a run folder."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "metrics.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(to_jsonable(record), allow_nan=False) + "\n")
