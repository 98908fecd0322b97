"""Run folders: claimed once, gone on with only under the same settings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs.files import to_jsonable, write_json
from snn_fusion_failure.runs.origin import provenance


def open_run(
    out: Path, settings: Any, *, resume: bool = False, overwrite: bool = False
) -> dict[str, Any]:
    """Claim the folder `out` for a run with these settings and write its `config.json`.

    A run that is gone on with keeps what its beginning was made by: each further part is a line of
    `resumed` with its own command, commit, versions, device and date.

    Args:
        out: the run folder; made when it is missing.
        settings: dataclass or dict that defines the run (seeds included, output options not).
        resume: go on with the run that is in `out`; its settings must be the same.
        overwrite: forget the run that is in `out`.

    Returns:
        The settings as JSON values.

    Raises:
        ValueError: `out` holds another run, or the settings of the run to resume differ.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp()) / "mine"
        >>> open_run(folder, {"seed": 0}), open_run(folder, {"seed": 0}, resume=True)
        ({'seed': 0}, {'seed': 0})
        >>> open_run(folder, {"seed": 1}, resume=True)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: ... holds a run with other settings (seed: 0 -> 1)...
    """
    wanted = to_jsonable(settings)
    config = out / "config.json"
    if config.exists() and not overwrite:
        found = json.loads(config.read_text(encoding="utf-8"))
        held = found["settings"]
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
        resumed = [*found.get("resumed", []), provenance()]
        write_json(config, {**found, "resumed": resumed})
        return wanted
    if overwrite and out.exists():
        for name in ("metrics.jsonl", "result.json"):
            (out / name).unlink(missing_ok=True)
    write_json(config, {"settings": wanted, **provenance()})
    return wanted
