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
import functools
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.runs import provenance, to_jsonable
from snn_fusion_failure.runs.files import create_once
from snn_fusion_failure.sweeps.axes import Axis
from snn_fusion_failure.sweeps.designs import Design, digest
from snn_fusion_failure.sweeps.study import Metric, Study

OK, NON_FINITE, FAILED, MISSING = 0, 1, 2, 3
STATUS = ("ok", "non-finite", "failed", "missing")
SCHEME = 2
"""How keys follow from settings; numbers of another scheme are another sweep."""


@dataclasses.dataclass(frozen=True)
class Segment:
    """Settings times seeds on one budget, in chunks: what was planned at one time.

    Attributes:
        number: of the segment in its folder.
        budget: units of training; None: all of them.
        settings: numbers of settings, all with the same static values.
        seeds: the first, and one after the last.
    """

    number: int
    budget: int | None
    settings: tuple[int, ...]
    seeds: tuple[int, int]

    @functools.cached_property
    def trials(self) -> np.ndarray:
        """Setting and seed of each trial, `[n, 2]`."""
        seeds = np.arange(*self.seeds)
        settings = np.asarray(self.settings, np.int64)
        return np.stack([np.repeat(settings, len(seeds)), np.tile(seeds, len(settings))], 1)

    def n_chunks(self, sweep: Sweep) -> int:
        """Chunks of this segment."""
        return -(-len(self.settings) * (self.seeds[1] - self.seeds[0]) // sweep.chunk_trials)

    def chunk(self, sweep: Sweep, number: int) -> np.ndarray:
        """Trials of a chunk."""
        return self.trials[number * sweep.chunk_trials : (number + 1) * sweep.chunk_trials]


@dataclasses.dataclass(frozen=True)
class Sweep:
    """A sweep as its folder has it.

    Attributes:
        out: the folder.
        study: what a trial is; None where the folder is only looked at.
        design: what was asked for last.
        seeds: trials per setting.
        root: seed of all keys.
        chunk_trials: trials per file.
        width: trials side by side on a device.
        budgets: units of training after which settings are dropped; empty without halving.
        keep: share of the settings that stay at each of them.
        mode: `halving` waits for a whole rung, `asha` promotes whenever there is something to.
        common: seed k draws the same numbers in every setting.
        min_valid: share of a setting's seeds that must be valid for it to be ranked.
        batch: settings that an adaptive design asks for at a time.
        metrics, objective, budget_text: of the study.
        rung_objective: what settings are ranked by before they have all of their training.
        study_name, options, where: from which the study is made again.
        allow_mixed: chunks of other sources may stand beside.
        lease: seconds after which a silent worker's chunk is taken over.
    """

    out: Path
    study: Study | None
    design: Design
    seeds: int
    root: int = 0
    chunk_trials: int = 1
    width: int = 1
    budgets: tuple[int, ...] = ()
    keep: float = 0.25
    mode: str = "halving"
    common: bool = False
    min_valid: float = 0.75
    batch: int = 8
    metrics: Mapping[str, Metric] = dataclasses.field(default_factory=dict)
    objective: str = ""
    rung_objective: str = ""
    budget_text: str = ""
    study_name: str = ""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    where: str | None = None
    allow_mixed: bool = False
    lease: float = 60.0

    @property
    def leaves(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(axis.leaf for axis in self.design.axes)

    @property
    def static(self) -> tuple[str, ...]:
        """Names of the axes that compile anew."""
        return tuple(axis.leaf for axis in self.design.axes if axis.kind == "static")

    def static_values(self, row: Sequence[Any]) -> dict[str, Any]:
        """The static values of a setting."""
        return {a.leaf: v for a, v in zip(self.design.axes, row, strict=True) if a.kind == "static"}

    def columns(self, rows: Sequence[Sequence[Any]]) -> dict[str, np.ndarray]:
        """Numbers of the traced axes for some settings, in the axes' units."""
        found = {}
        for i, axis in enumerate(self.design.axes):
            if axis.kind == "category":
                found[axis.leaf] = np.asarray([axis.values.index(row[i]) for row in rows], float)
            elif axis.kind != "static":
                found[axis.leaf] = np.asarray([row[i] for row in rows], np.float64)
        return found

    def words(self, rows: Sequence[Sequence[Any]]) -> np.ndarray:
        """The words that keys are folded from, `[n, 2]` uint32."""
        found = [digest(self.leaves, row) for row in rows]
        return np.asarray(found, np.uint32).reshape(-1, 2)

    def settings(self) -> dict[str, Any]:
        """What cannot change while the sweep grows, JSON values."""
        value = {
            "scheme": SCHEME,
            "study": self.study_name,
            "options": self.options,
            "axes": [
                {"leaf": a.leaf, "unit": a.unit, "kind": a.kind} for a in self.design.axes
            ],
            # Labels are counted: another order would be another meaning.
            "labels": {a.leaf: a.values for a in self.design.axes if a.kind == "category"},
            "root": self.root,
            "common_seeds": self.common,
            "halving": {"budgets": self.budgets, "keep": self.keep, "mode": self.mode,
                        "min_valid": self.min_valid} if self.budgets else None,
            "adaptive": {"kind": self.design.kind, "batch": self.batch, "seed": self.design.seed,
                         "min_valid": self.min_valid}
            if self.design.kind in ("tpe", "cma", "gp") else None,
        }  # fmt: skip
        return dict(json.loads(json.dumps(to_jsonable(value))))


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


def read_plan(out: Path) -> list[dict[str, Any]]:
    """All parts of the plan, in order."""
    folder = out / "plan"
    if not folder.is_dir():
        return []
    names = sorted(n for n in os.listdir(folder) if n.endswith(".json") and not n.startswith("."))
    return [json.loads((folder / name).read_text(encoding="utf-8")) for name in names]


def append_plan(
    sweep: Sweep,
    rows: Sequence[Sequence[Any]],
    segments: Sequence[Mapping[str, Any]],
    *,
    after: int,
) -> bool:
    """Append settings and segments; of several processes one does.

    Args:
        sweep: its design and seeds are noted as what is asked for now.
        rows: settings that are new.
        segments: `budget`, `settings` and `seeds` of each new segment.
        after: parts of the plan that this follows from.

    Returns:
        Whether this call did; otherwise the plan has to be read again.
    """
    text = {
        "design": {**sweep.design.describe(), "seeds": sweep.seeds},
        "rows": rows,
        "segments": list(segments),
        "command": provenance()["command"],
    }
    path = sweep.out / "plan" / f"{after:06d}.json"
    return create_once(path, json.dumps(to_jsonable(text), allow_nan=False) + "\n")


def segments_of(plan: Sequence[Mapping[str, Any]]) -> list[Segment]:
    """The segments of a plan, numbered."""
    found: list[Segment] = []
    for part in plan:
        for s in part["segments"]:
            found.append(Segment(len(found), s["budget"], tuple(s["settings"]), tuple(s["seeds"])))
    return found


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


def all_chunks(sweep: Sweep) -> list[tuple[Segment, int]]:
    """Every chunk that is planned, in order."""
    segments = segments_of(read_plan(sweep.out))
    return [(s, number) for s in segments for number in range(s.n_chunks(sweep))]


def valid(status: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Trials that count in a mean: they ended well, with a finite number."""
    return (status == OK) & np.isfinite(values)
