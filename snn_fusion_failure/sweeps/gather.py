"""All chunks as one labelled data set: xarray in memory, netCDF on disk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.runs.files import write_bytes
from snn_fusion_failure.sweeps.chunkfile import DamagedError
from snn_fusion_failure.sweeps.definition import MISSING, STATUS, Sweep
from snn_fusion_failure.sweeps.designs import digest
from snn_fusion_failure.sweeps.folder import chunk_path, done_chunks
from snn_fusion_failure.sweeps.plan import all_chunks, read_plan, segments_of
from snn_fusion_failure.sweeps.results import Found, Reader
from snn_fusion_failure.sweeps.rungs import is_complete

RESERVED = ("seed", "setting", "status", "budget", "source")
"""Names of the data set's own variables: no axis and no metric can have them."""


def damaged(sweep: Sweep, reader: Reader | None = None) -> list[Path]:
    """Chunk files whose checksum is wrong."""
    reader = reader or Reader(sweep.out)
    found = []
    for segment, number in sorted(done_chunks(sweep.out)):
        try:
            reader.chunk(segment, number)
        except DamagedError:
            found.append(chunk_path(sweep.out, segment, number))
    return found


def gather(sweep: Sweep, *, reader: Reader | None = None) -> Any:
    """An `xarray.Dataset` of what is there.

    A grid has a dimension per axis and `seed`; other designs have `setting` and `seed`, with the
    axes as coordinates along `setting`. Each metric is a variable with its unit; `status` says of
    each trial whether it is ok, not finite, failed (it raised an exception) or missing; `budget`
    is the largest budget that a setting was run on, where settings were dropped; `source` counts
    the sources, where several made the numbers. Attributes hold the configuration and the versions
    that made the numbers.

    Raises:
        DamagedError: the checksum of a chunk is wrong.
    """
    import xarray as xr

    reader = reader or Reader(sweep.out)
    plan = read_plan(sweep.out)
    rows = [tuple(row) for part in plan for row in part["rows"]]
    segments = segments_of(plan)
    found = reader.found(sweep, segments, len(rows), None)
    dims, coords, order = _coordinates(sweep, rows)
    shape = tuple(len(coords[d]) if d == "seed" else coords[d][1].shape[0] for d in dims)

    def placed(values: np.ndarray) -> np.ndarray:
        return values[order].reshape(shape)

    variables: dict[str, Any] = {}
    for name, metric in sweep.metrics.items():
        attributes = {"units": metric.unit or "1", "long_name": metric.text, "goal": metric.goal}
        variables[name] = (dims, placed(found.metrics[name]), attributes)
    flags = {"flag_values": np.arange(len(STATUS), dtype=np.int8),
             "flag_meanings": " ".join(s.replace("-", "_") for s in STATUS)}  # fmt: skip
    variables["status"] = (dims, placed(found.status), {"long_name": "how a trial ended", **flags})
    if len(found.sources) > 1:
        text = {"long_name": "which source made a trial, see attribute sources; -1: none"}
        variables["source"] = (dims, placed(found.source), text)
    if sweep.budgets:
        budget = _budgets(sweep, segments, found, reader, len(rows))
        text = {"long_name": f"{sweep.budget_text} a trial was run on; the largest: all of them"}
        variables["budget"] = (dims, placed(budget), text)
    return xr.Dataset(variables, coords, _about(sweep, plan, found, reader))


def _coordinates(sweep: Sweep, rows: list[tuple[Any, ...]]) -> Any:
    """Dimensions, coordinates, and the settings in the data set's order."""
    design = sweep.design
    numbers = {digest(sweep.leaves, row): i for i, row in enumerate(rows)}

    def values_of(values: Any) -> np.ndarray:
        words = any(isinstance(v, str) for v in values)
        return np.asarray([str(v) for v in values] if words else list(values))

    def attributes(axis: Any) -> dict[str, Any]:
        return {"units": axis.unit or "1", "kind": axis.kind, "log": int(axis.log)}

    coords: dict[str, Any] = {}
    grid = design.kind == "grid" and design.axes
    if grid:
        import itertools

        wanted = itertools.product(*(axis.values for axis in design.axes))
        order = np.asarray([numbers[digest(sweep.leaves, row)] for row in wanted], int)
        dims = (*sweep.leaves, "seed")
        for axis in design.axes:
            coords[axis.leaf] = (axis.leaf, values_of(axis.values), attributes(axis))
    else:
        order = np.arange(len(rows))
        dims = ("setting", "seed")
        coords["setting"] = ("setting", np.arange(len(rows)))
        for i, axis in enumerate(design.axes):
            column = values_of([row[i] for row in rows])
            coords[axis.leaf] = ("setting", column, attributes(axis))
    coords["seed"] = np.arange(sweep.seeds)
    return dims, coords, order


def _budgets(
    sweep: Sweep, segments: Any, found: Found, reader: Reader, n_settings: int
) -> np.ndarray:
    """How far each trial came."""
    budget = np.zeros(found.status.shape, np.int32)
    for step in sweep.budgets:
        below = reader.found(sweep, segments, n_settings, step)
        budget[below.status != MISSING] = step
    budget[found.status != MISSING] = np.iinfo(np.int32).max
    return budget


def _about(sweep: Sweep, plan: Any, found: Found, reader: Reader) -> dict[str, Any]:
    claimed = json.loads((sweep.out / "sweep.json").read_text(encoding="utf-8"))
    made = {k: claimed[k] for k in ("command", "git", "versions", "device", "date", "packages")}
    made["parts"] = [part["command"] for part in plan]
    config = {**claimed["settings"], "design": sweep.design.describe(), "seeds": sweep.seeds}
    sources = {}
    for name in found.sources:
        path = sweep.out / "sources" / f"{name}.json"
        about = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        sources[name] = {k: v for k, v in about.items() if k not in ("sources", "id")}
    planned_chunks = all_chunks(sweep)
    done = {x for x in done_chunks(sweep.out) if not reader.skips(*x)}
    return {
        "title": f"sweep of study {sweep.study_name}",
        "objective": sweep.objective,
        "min_valid": sweep.min_valid,
        "config": json.dumps(config),
        "layout": json.dumps(claimed["layout"]),
        "provenance": json.dumps(made),
        "sources": json.dumps(sources),
        "mixed": int(len(found.sources) > 1),
        "devices": "; ".join(found.devices),
        "complete": int(is_complete(sweep, reader)),
        "chunks": len(planned_chunks),
        "chunks_missing": sum((s.number, c) not in done for s, c in planned_chunks),
        "common_seeds": int(sweep.common),
        "compute_seconds": found.seconds,
        "failures": json.dumps({f"{s}/{k}": m for (s, k), m in sorted(found.messages.items())}),
        "notes": json.dumps(found.notes),
    }


def write_netcdf(dataset: Any, path: Path) -> None:
    """Write a data set as netCDF 3 (64-bit offsets), which every reader knows, atomically."""
    data = dataset.to_netcdf(None, engine="scipy", format="NETCDF3_64BIT")
    write_bytes(path, bytes(data))
