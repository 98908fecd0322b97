"""Run folders: claimed once, gone on with only under the same settings."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs.files import to_jsonable, write_json
from snn_fusion_failure.runs.origin import provenance


def open_run(
    out: Path,
    settings: Any,
    *,
    resume: bool = False,
    overwrite: bool = False,
    may_change: Sequence[str] = (),
) -> dict[str, Any]:
    """Claim the folder `out` for a run with these settings and write its `config.json`.

    A run that is gone on with keeps what its beginning was made by: each further part is a line of
    `resumed` with its own command, commit, versions, device and date, and what of `may_change` it
    has changed.

    Args:
        out: the run folder; made when it is missing.
        settings: dataclass or dict that defines the run (seeds included, output options not).
        resume: go on with the run that is in `out`; its settings must be the same.
        overwrite: forget the run that is in `out`.
        may_change: settings that may be others when the run goes on, such as a budget that grows.

    Returns:
        The settings as JSON values.

    Raises:
        ValueError: `out` holds another run, the settings of the run to resume differ, or they
            cannot be read.

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
        if not resume:
            raise ValueError(
                f"{out} already holds a run; pass --resume to go on with it, --overwrite to "
                "replace it, or another --out"
            )
        found = _read(config)
        held = found["settings"]
        keys = sorted(k for k in {*held, *wanted} if held.get(k) != wanted.get(k))
        grown = {k: wanted.get(k) for k in keys if k in may_change}
        keys = [k for k in keys if k not in grown]
        if keys:
            changes = "; ".join(f"{k}: {held.get(k)!r} -> {wanted.get(k)!r}" for k in keys)
            raise ValueError(
                f"{out} holds a run with other settings ({changes}); resume with the same "
                "settings or choose another --out"
            )
        part = {**provenance(), **({"settings": grown} if grown else {})}
        resumed = [*found.get("resumed", []), part]
        write_json(config, {**found, "resumed": resumed})
        return wanted
    if overwrite and out.exists():
        for name in ("metrics.jsonl", "result.json"):
            (out / name).unlink(missing_ok=True)
    write_json(config, {"settings": wanted, **provenance()})
    return wanted


def _read(config: Path) -> dict[str, Any]:
    """A `config.json`; it says what the run was made by, which nothing can say again."""
    try:
        found = json.loads(config.read_bytes())
        if not isinstance(found, dict) or not isinstance(found.get("settings"), dict):
            raise ValueError("no settings in it")
        return found
    except ValueError as error:
        raise ValueError(
            f"{config} cannot be read ({error}): expected the settings of the run to go on with; "
            "restore the file, pass --overwrite to begin anew, or choose another --out"
        ) from error
