"""The folder of a sweep: what it is, what is planned, what is done.

    sweep.json         the study, its options, the axes' names, the seed; made once
    plan/000000.json   settings and segments, appended when the sweep grows or a rung is derived
    chunks/00003-000012.npz    chunk 12 of segment 3
    sources/ID.json    each source and set of versions that made chunks, with its provenance
    leases/            chunks that somebody is working on
    damaged/           chunks whose checksum was wrong

Files appear whole or not at all and are never changed, so any number of workers on any number of
machines may share a folder.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import provenance, to_jsonable
from snn_fusion_failure.runs.files import create_once
from snn_fusion_failure.sweeps.axes import Axis
from snn_fusion_failure.sweeps.definition import SCHEME, Sweep
from snn_fusion_failure.sweeps.designs import Design
from snn_fusion_failure.sweeps.plan import read_plan
from snn_fusion_failure.sweeps.study import Metric, Study


def claim(sweep: Sweep, **layout: Any) -> Sweep:
    """Make the folder, or join the one that is there.

    Workers may claim at the same time: the first one's file stands, the others read it. Layout
    (chunk size, trials per file) is that of the folder, since it does not change numbers.

    Raises:
        ValueError: the folder holds another sweep; the message lists what differs.
    """
    path = sweep.out / "sweep.json"
    wanted = sweep.settings()
    if not path.exists():
        shape = {"chunk_trials": sweep.chunk_trials, "chunk_size": sweep.width, **layout}
        text = {
            "settings": wanted,
            "layout": shape,
            "metrics": {name: dataclasses.asdict(m) for name, m in sweep.metrics.items()},
            "objective": sweep.objective,
            "rung_objective": sweep.rung_objective,
            "budget_text": sweep.budget_text,
            "where": sweep.where,
            **provenance(),
            "packages": _versions(),
        }
        create_once(path, json.dumps(to_jsonable(text), indent=1, allow_nan=False) + "\n")
    held = json.loads(path.read_text(encoding="utf-8"))
    if held["settings"].get("scheme") != SCHEME:
        raise ValueError(
            f"out={sweep.out}: expected a sweep of this version; an older one made it, with other "
            "keys; choose another --out, or --overwrite to delete it"
        )
    differences = _differences(held["settings"], wanted)
    if differences:
        raise ValueError(
            f"out={sweep.out}: holds a sweep with other settings ({'; '.join(differences)}); give "
            "the same to go on with it or let it grow, another --out, or --overwrite to delete it"
        )
    layout = held["layout"]
    return dataclasses.replace(
        sweep, chunk_trials=layout["chunk_trials"], width=layout["chunk_size"]
    )


def _differences(held: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """`name: old -> new` for what a user would have to change."""
    found = []
    for name in sorted({*held, *wanted}):
        old, new = held.get(name), wanted.get(name)
        if old == new:
            continue
        if isinstance(old, dict) and isinstance(new, dict):
            keys = sorted(k for k in {*old, *new} if old.get(k) != new.get(k))
            found += [f"{k}: {old.get(k)!r} -> {new.get(k)!r}" for k in keys]
        elif name == "axes":
            both = (held[name], wanted[name])
            found.append("axes: " + " -> ".join(" ".join(a["leaf"] for a in x) for x in both))
        else:
            found.append(f"{name}: {old!r} -> {new!r}")
    return found


def _versions() -> dict[str, str]:
    from importlib import metadata

    from snn_fusion_failure import __version__

    found = {name: metadata.version(name) for name in ("scipy", "xarray")}
    return {"snn-fusion-failure": __version__, **found}


def held_sweep(out: Path, *, load: bool = False, **changes: Any) -> Sweep:
    """The sweep that a folder holds.

    Args:
        out: the folder.
        load: import the study, to run what is missing; to look at results needs no study.
        changes: fields that do not come from the folder (`allow_mixed`, `lease`).

    Raises:
        ValueError: there is none.
    """
    from snn_fusion_failure.sweeps.study import load_study
    from snn_fusion_failure.sweeps.trial import from_trial

    path = out / "sweep.json"
    if not path.exists():
        raise ValueError(f"out={out}: holds no sweep (no sweep.json in it)")
    held = json.loads(path.read_text(encoding="utf-8"))
    s, layout = held["settings"], held["layout"]
    if s.get("scheme") != SCHEME:
        raise ValueError(f"out={out}: an older version made this sweep; read its results.nc")
    plan = read_plan(out)
    kind, seeds = "grid", 1
    axes: tuple[Axis, ...] = ()
    rows: tuple[tuple[Any, ...], ...] = ()
    extra: dict[str, Any] = {}
    if plan:
        asked = plan[-1]["design"]
        kind, seeds, extra = asked["kind"], asked["seeds"], asked
        axes = tuple(Axis(**{**a, "values": tuple(a["values"])}) for a in asked["axes"])
        rows = tuple(tuple(row) for part in plan for row in part["rows"])
    made = Design(kind, axes, rows, extra.get("samples", 0), extra.get("seed", 0))
    metrics = {name: Metric(**m) for name, m in held["metrics"].items()}
    study = None
    if load:
        study = load_study(s["study"], held=s["options"], where=held["where"])
        if not isinstance(study, Study):
            study = from_trial(
                study, axes, name=s["study"], metrics=metrics, objective=held["objective"]
            )
    halving, adaptive = s["halving"] or {}, s["adaptive"] or {}
    return Sweep(
        out, study, made, seeds, s["root"], layout["chunk_trials"], layout["chunk_size"],
        tuple(halving.get("budgets", ())), halving.get("keep", 0.25),
        halving.get("mode", "halving"), s["common_seeds"],
        halving.get("min_valid", adaptive.get("min_valid", 0.75)), adaptive.get("batch", 8),
        metrics, held["objective"], held["rung_objective"], held["budget_text"], s["study"],
        s["options"], held["where"],
        **changes,
    )  # fmt: skip


def forget(out: Path) -> None:
    """Delete the sweep in a folder, and nothing else that is in it."""
    for pattern in (
        "chunks*/*[0-9].npz", "chunks/*.retry", "plan/[0-9]*.json", "sources/*.json",
        "leases/[0-9]*", "damaged/*.npz", "dead/[0-9]*",
    ):  # fmt: skip
        for path in out.glob(pattern):
            path.unlink()
    for name in ("sweep.json", "results.nc"):
        (out / name).unlink(missing_ok=True)


def chunk_name(segment: int, chunk: int) -> str:
    """How files of a chunk are called."""
    return f"{segment:05d}-{chunk:06d}"


def chunk_path(out: Path, segment: int, chunk: int) -> Path:
    """File of a chunk."""
    return out / "chunks" / f"{chunk_name(segment, chunk)}.npz"


def done_chunks(out: Path) -> set[tuple[int, int]]:
    """Segment and number of the chunks whose files are there."""
    found = set()
    with contextlib.suppress(FileNotFoundError):
        for name in os.listdir(out / "chunks"):
            if name.endswith(".npz") and not name.startswith("."):
                segment, _, number = name.removesuffix(".npz").partition("-")
                found.add((int(segment), int(number)))
    return found
