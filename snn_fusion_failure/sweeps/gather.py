"""All chunks as one labelled data set: xarray in memory, netCDF on disk."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.sweeps.chunks import next_rung
from snn_fusion_failure.sweeps.folder import (
    MISSING,
    STATUS,
    Sweep,
    chunk_path,
    done_chunks,
    load_chunk,
)

__all__ = ["gather", "is_complete", "write_netcdf"]


def gather(sweep: Sweep) -> Any:
    """An `xarray.Dataset` of what is there.

    A grid has a dimension per axis and `seed`; other designs have `setting` and `seed`, with the
    axes as coordinates along `setting`. Each metric is a variable with its unit; `status` says of
    each trial whether it is ok, not finite, failed (its chunk raised an exception) or missing;
    `budget` is the largest budget that a setting was run on, where settings were dropped.
    Attributes hold the configuration and the versions that made the numbers.
    """
    import xarray as xr

    design, study = sweep.design, sweep.study
    n = sweep.n_trials
    metrics = {name: np.full(n, np.nan) for name in study.metrics}
    status = np.full(n, MISSING, np.int8)
    budget = np.zeros(n, np.int32)
    seconds, messages = 0.0, {}
    for step in (*sweep.budgets, None):
        for number in sorted(done_chunks(sweep, step)):
            held = load_chunk(chunk_path(sweep, number, step), list(study.metrics))
            trials = held["trial"]
            seconds += held["seconds"]
            if held["message"]:
                messages[f"{number}" if step is None else f"{step}/{number}"] = held["message"]
            # A dropped setting keeps the numbers of its last rung out of the metrics: they were
            # made with less training and are no answer to the same question.
            if step is None:
                status[trials] = held["status"]
                for name in metrics:
                    metrics[name][trials] = held[name]
            else:
                budget[trials] = step
    if sweep.budgets:
        budget[status != MISSING] = np.iinfo(np.int32).max

    names = [axis.leaf for axis in design.axes]
    if design.kind == "grid":
        dims = (*names, "seed")
        coords: dict[str, Any] = {
            axis.leaf: (axis.leaf, np.asarray(axis.values), {"units": axis.unit or "1"})
            for axis in design.axes
        }
    else:
        dims = ("setting", "seed")
        coords = {
            axis.leaf: ("setting", design.values[:, i], {"units": axis.unit or "1"})
            for i, axis in enumerate(design.axes)
        }
        coords["setting"] = np.arange(design.n)
    coords["seed"] = np.arange(sweep.seeds)
    shape = (*design.shape, sweep.seeds)
    variables: dict[str, Any] = {}
    for name, metric in study.metrics.items():
        attributes = {"units": metric.unit or "1", "long_name": metric.text, "goal": metric.goal}
        variables[name] = (dims, metrics[name].reshape(shape), attributes)
    flags = {"flag_values": np.arange(len(STATUS), dtype=np.int8),
             "flag_meanings": " ".join(s.replace("-", "_") for s in STATUS)}  # fmt: skip
    variables["status"] = (dims, status.reshape(shape), {"long_name": "how a trial ended", **flags})
    if sweep.budgets:
        text = f"{study.budget_text} a trial was run on; the largest number: all of them"
        variables["budget"] = (dims, budget.reshape(shape), {"long_name": text})
    claimed = json.loads((sweep.out / "sweep.json").read_text(encoding="utf-8"))
    made = {k: v for k, v in claimed.items() if k not in ("settings", "layout")}
    about: dict[str, Any] = {
        "title": f"sweep of study {study.name}",
        "objective": study.objective,
        "config": json.dumps({k: v for k, v in claimed["settings"].items() if k != "values"}),
        "layout": json.dumps(claimed["layout"]),
        "provenance": json.dumps(made),
        "complete": int(is_complete(sweep)),
        "compute_seconds": seconds,
        "failures": json.dumps(messages),
    }
    return xr.Dataset(variables, coords, about)


def is_complete(sweep: Sweep) -> bool:
    """Whether all chunks of all rungs are there."""
    rung = next_rung(sweep)
    return rung.budget is None and len(done_chunks(sweep)) >= rung.n_chunks(sweep)


def write_netcdf(dataset: Any, path: Path) -> None:
    """Write a data set as netCDF 3 (64-bit offsets), which every reader knows, atomically."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    try:
        dataset.to_netcdf(temporary, engine="scipy", format="NETCDF3_64BIT")
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
