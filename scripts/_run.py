"""What every script shares: run folders, atomic files, results of record, progress, the last line.

A script computes with the packages and leaves the bookkeeping to this file, so that all of them
keep the same promises: nothing is overwritten silently, a file is either whole or absent, a number
of record carries the command, versions, device and seeds that made it.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import math
import os
import platform
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
RESULTS = REPOSITORY / "results"


def enable_compilation_cache() -> None:
    """Keep compiled programs in `.cache/jax`, unless the user has set a cache of their own."""
    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(REPOSITORY / ".cache" / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


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


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` atomically: a reader sees the old file or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically."""
    write_text(path, json.dumps(to_jsonable(value), indent=1, allow_nan=False) + "\n")


def append_metrics(out: Path, record: dict[str, Any]) -> None:
    """Append one line to `metrics.jsonl` of a run folder."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "metrics.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(to_jsonable(record), allow_nan=False) + "\n")


def open_run(
    out: Path, settings: Any, *, resume: bool = False, overwrite: bool = False
) -> dict[str, Any]:
    """Claim the folder `out` for a run with these settings and write its `config.json`.

    Args:
        out: the run folder; made when it is missing.
        settings: dataclass or dict that defines the run (seeds included, output options not).
        resume: go on with the run that is in `out`; its settings must be the same.
        overwrite: forget the run that is in `out`.

    Returns:
        The settings as JSON values.

    Raises:
        ValueError: `out` holds another run, or the settings of the run to resume differ.
    """
    wanted = to_jsonable(settings)
    config = out / "config.json"
    if config.exists() and not overwrite:
        held = json.loads(config.read_text(encoding="utf-8"))["settings"]
        if not resume:
            raise ValueError(
                f"{out} already holds a run; pass --resume to go on with it, --overwrite to "
                "replace it, or another --out"
            )
        if held != wanted:
            keys = sorted(k for k in {*held, *wanted} if held.get(k) != wanted.get(k))
            changes = "; ".join(f"{k}: {held.get(k)!r} -> {wanted.get(k)!r}" for k in keys)
            raise ValueError(
                f"{out} holds a run with other settings ({changes}); resume with the same "
                "settings or choose another --out"
            )
    if overwrite and out.exists():
        for name in ("metrics.jsonl", "result.json"):
            (out / name).unlink(missing_ok=True)
    write_json(config, {"settings": wanted, **provenance()})
    return wanted


def command_line() -> str:
    """The command that is running, as a reader would type it from the repository root."""
    script = Path(sys.argv[0])
    try:
        script = script.resolve().relative_to(REPOSITORY)
    except ValueError:
        script = Path(script.name)
    arguments: list[str] = []
    for argument in sys.argv[1:]:
        if arguments and arguments[-1] == "--data-dir":
            arguments.append("$FUSION_DATA_DIR")
        elif argument.startswith("/"):
            arguments.append(f"PATH/{Path(argument).name}")
        else:
            arguments.append(shlex.quote(argument))
    return " ".join(["python", str(script), *arguments])


def provenance() -> dict[str, Any]:
    """Command, commit, versions, device and date, as a result of record states them."""
    import jax

    names = ("jax", "jaxlib", "flax", "optax", "numpy")
    versions = {"python": platform.python_version()}
    for name in names:
        versions[name] = metadata.version(name)
    try:
        git = subprocess.run(
            ["git", "describe", "--always", "--dirty"],
            cwd=REPOSITORY,
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        git = "unknown"
    device = jax.devices()[0]
    kind = f"{device.platform}: {device.device_kind}"
    if device.platform == "cpu":
        kind = f"cpu: {os.cpu_count()} cores, {platform.machine()}"
    return {
        "command": command_line(),
        "git": git,
        "versions": versions,
        "device": kind,
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
    }


def summarize(values: Sequence[float]) -> dict[str, Any]:
    """`n`, `mean`, `ci95` (Student's t interval of the mean) and the `values` themselves."""
    from fusion.evaluate import mean_interval

    values = list(values)
    if len(values) == 1:
        return {"n": 1, "mean": values[0], "ci95": None, "values": values}
    found = mean_interval(values)
    return {"n": len(values), "mean": found.mean, "ci95": [found.low, found.high], "values": values}


def record_table(
    path: Path, table: str, title: str, rows: Iterable[dict[str, Any]], *, preset: str
) -> None:
    """Write or update a table of record; rows are replaced by (row, model, metric), others stay.

    Every row keeps the command and the commit that made it.
    """
    made = provenance()
    rows = [{"command": made["command"], "git": made["git"], **row} for row in rows]
    held: list[dict[str, Any]] = []
    if path.exists():
        held = json.loads(path.read_text(encoding="utf-8"))["rows"]

    def key(row: dict[str, Any]) -> tuple[Any, ...]:
        return row["row"], row["model"], row["metric"]

    new = {key(row) for row in rows}
    kept = [row for row in held if key(row) not in new]
    write_json(
        path,
        {"table": table, "title": title, "preset": preset, **made, "rows": kept + rows},
    )


def record_comparisons(
    results: Path, table: str, title: str, rows: list[dict[str, Any]], *, preset: str
) -> None:
    """Write the paired comparisons of a table of record beside it, as `study_paired_N.json`."""
    write_json(
        results / f"study_paired_{table.replace('.', '_')}.json",
        {"table": table, "title": f"{title}: paired comparisons", "rows": rows, "preset": preset}
        | provenance(),
    )


def progress() -> Any:
    """A rich progress bar on stderr, so that stdout stays clean for `result:`."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[status]}"),
        console=Console(stderr=True),
    )


def print_result(**fields: Any) -> None:
    """The last line of a script: `result: name=value ...`, one line, for other programs to read."""
    parts = []
    for name, value in fields.items():
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        parts.append(f"{name}={text}")
    print("result: " + " ".join(parts), flush=True)


def fail(message: str) -> None:
    """Say what is wrong on stderr and leave with exit status 2."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)
