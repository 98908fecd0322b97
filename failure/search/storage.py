"""The folder of a search: what defines it, its log, its spaces and surrogates.

`search.json` holds the identity, `evaluations.jsonl` one line per answered batch, `space.npz` and
`surrogate.npz` what a restart would otherwise fit again. Everything but the log can be computed
again, so a file that cannot be read is named, set aside (`.damaged`) and replaced.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from failure.search.history import SearchConfig, SearchState
from failure.search.trees import set_aside, write_whole

FORMAT = 2
"""Version of the folder; 1 kept neither column, sense, simulator nor start."""

LOG = "evaluations.jsonl"


def _plain(value: Any) -> Any:
    """Settings as JSON gives them back; named tuples by field, not by position."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if hasattr(value, "_asdict"):
        return {name: _plain(part) for name, part in value._asdict().items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return value.item() if hasattr(value, "item") else value


def _digest(identity: Mapping[str, Any]) -> str:
    """Short name of an identity without the budget, which may grow."""
    rest = {k: v for k, v in identity.items() if k != "n_total"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()[:12]


def claim(
    folder: Path,
    config: SearchConfig,
    *,
    column: int,
    sense: str,
    simulator: str,
    start: SearchState | None,
) -> str:
    """Write the identity of a new run, or check that of the one to go on with.

    The budget `n_total` may grow; everything else must be the same.

    Returns:
        A short name of the identity, which every line of the log carries.

    Raises:
        ValueError: the folder holds another run; the text lists each difference. No name for the
            simulator, which would be that of any other.
    """
    if not simulator:
        raise ValueError(
            f"identity={simulator!r}: expected a name of the simulator; without one its folder "
            "would answer for any other"
        )
    wanted: dict[str, Any] = {"format": FORMAT, **_plain(config)}
    wanted |= {"column": int(column), "sense": sense, "simulator": simulator, "start": None}
    if start is not None and start.n:
        data = hashlib.sha256()
        for part in (start.x, start.y):
            data.update(np.ascontiguousarray(part, "<f8").tobytes())
        wanted["start"] = f"{start.n} evaluations {data.hexdigest()[:12]}"
    wanted = json.loads(json.dumps(wanted))
    path = folder / "search.json"
    folder.mkdir(parents=True, exist_ok=True)
    held = _held(path, wanted)
    if held is not None:
        grown = held.get("n_total", 0) < wanted["n_total"]
        names = [
            k
            for k in sorted({*held, *wanted})
            if held.get(k) != wanted.get(k) and not (k == "n_total" and grown)
        ]
        if names:
            changes = "; ".join(f"{k}: {held.get(k)!r} -> {wanted.get(k)!r}" for k in names)
            hint = "resume with the same settings (n_total may grow) or choose another folder"
            if held.get("format", 1) < FORMAT:
                hint = (
                    "it was written by an earlier version, which did not record them; start from "
                    "its samples: run(..., state=start_from(config, *samples(folder)))"
                )
            raise ValueError(f"{folder} holds a search with other settings ({changes}); {hint}")
    if held != wanted:
        write_whole(path, lambda file: file.write((json.dumps(wanted, indent=1) + "\n").encode()))
    return _digest(wanted)


def _held(path: Path, wanted: dict[str, Any]) -> dict[str, Any] | None:
    """The identity that is written down; rebuilt from the log's own mark when unreadable."""
    if not path.exists():
        return None
    try:
        held = json.loads(path.read_bytes())
        if not isinstance(held, dict):
            raise ValueError("no settings in it")
        return held
    except ValueError as error:
        records, _ = _parse(path.parent / LOG)
        marks = {record.get("run") for record in records}
        if marks - {_digest(wanted)}:
            raise ValueError(
                f"{path}: {error}; the log beside it belongs to other settings, so the run "
                "cannot go on; choose another folder"
            ) from error
        set_aside(path, str(error), "written again from the settings given now")
        return None


def append_log(
    folder: Path, mark: str, state: SearchState, count: int, messages: Mapping[int, str]
) -> None:
    """Log the last `count` evaluations; one line, flushed to the disk."""
    rows = slice(state.n - count, state.n)
    line = {
        "run": mark,
        "n": state.n - count,
        "x": state.x[:, rows].tolist(),
        "u": state.u[:, rows].tolist(),
        "y": [[v if math.isfinite(v) else None for v in seed] for seed in state.y[:, rows]],
        "status": state.status[:, rows].tolist(),
        "clipped": state.clipped[:, rows].tolist(),
    }
    if messages:
        line["messages"] = {str(row): text for row, text in messages.items()}
    with (folder / LOG).open("a", encoding="utf-8") as file:
        file.write(json.dumps(line, allow_nan=False) + "\n")
        file.flush()
        os.fsync(file.fileno())


def _parse(path: Path) -> tuple[list[dict[str, Any]], tuple[int, str] | None]:
    """Records up to the first that cannot be read, and the number and trouble of that line."""
    lines = path.read_bytes().split(b"\n") if path.exists() else []
    records: list[dict[str, Any]] = []
    at = 0
    for number, line in enumerate(lines, 1):
        if not line and number == len(lines):
            break
        try:
            if number == len(lines):
                raise ValueError("torn: no line end")
            record = json.loads(line)
            y = np.asarray(record["y"], np.float64)
            shapes = {np.shape(record[k])[:2] for k in ("x", "u", "status", "clipped")}
            if record["n"] != at or shapes != {y.shape}:
                raise ValueError(f"expected evaluations from number {at} on, alike in all fields")
        except (ValueError, KeyError, TypeError, IndexError) as error:
            return records, (number, f"{type(error).__name__}: {error}")
        records.append(record)
        at += y.shape[1]
    return records, None


def read_log(folder: Path, mark: str | None = None) -> list[dict[str, Any]]:
    """The evaluations of a folder, in order; what cannot be read is simulated again.

    A last line that a kill has torn is dropped without a word: its evaluation was never used. Any
    other line that cannot be read ends the log there, with a warning that names it.

    Raises:
        ValueError: a line belongs to a run of other settings.
    """
    path = folder / LOG
    records, trouble = _parse(path)
    for number, record in enumerate(records, 1):
        if mark is not None and record.get("run", mark) != mark:
            raise ValueError(
                f"{path}, line {number}: it belongs to a run with other settings; choose another "
                "folder"
            )
    if trouble is not None:
        number, why = trouble
        good = path.read_bytes().split(b"\n")[: number - 1]
        if "torn" not in why:
            set_aside(path, f"line {number} cannot be read ({why})", "simulated again from there")
        write_whole(path, lambda file: file.write(b"".join(line + b"\n" for line in good)))
    return records


def messages(folder: Path) -> list[str]:
    """What a simulator has said of the invalid evaluations of a folder, in order."""
    return [text for r in _parse(folder / LOG)[0] for text in r.get("messages", {}).values()]


def samples(folder: Path | str) -> tuple[np.ndarray, np.ndarray]:
    """Valid evaluations of a folder, of all seeds and of any version: `(x [n, D], y [n])`.

    The start of another search: `start_from(config, *samples(folder))`.
    """
    records, _ = _parse(Path(folder) / LOG)
    if not records:
        raise ValueError(f"folder={str(folder)!r}: expected a search with evaluations in it")
    x = np.concatenate([np.asarray(r["x"], np.float64) for r in records], 1)
    y = np.concatenate([np.asarray(r["y"], np.float64) for r in records], 1)
    good = np.isfinite(y)
    return x[good], y[good]
