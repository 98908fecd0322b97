"""What is scored of an experiment: success, steering movements, path against the shortest one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxsnn.experiment import Experiment
from jaxsnn.status import Status


def per_seed(experiment: Experiment, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """One JSON record per seed: status, steps and path of every trial, and mean firing rates."""
    phases = {"learning": experiment.learning, "testing": experiment.testing}
    if experiment.online is not None:
        phases["online"] = experiment.online
    records = []
    for index, seed in enumerate(seeds):
        record: dict[str, Any] = {"seed": int(seed)}
        for name, phase in phases.items():
            record[name] = {
                "status": np.asarray(phase.status[index]).tolist(),
                "steps": np.asarray(phase.steps[index]).tolist(),
                "path": [round(float(x), 2) for x in phase.path[index]],
                "rates": [round(float(x), 2) for x in np.asarray(phase.info[index]).mean(axis=0)],
            }
        records.append(record)
    return records


def success(record: Mapping[str, Any], phase: str) -> float:
    """Arrivals in percent of the trials of one seed (the source's `SR`)."""
    status = record[phase]["status"]
    return 100.0 * sum(s == Status.ARRIVED for s in status) / len(status)


def mean_of_arrivals(record: Mapping[str, Any], field: str) -> float | None:
    """Mean of steps or path over the testing trials that arrived; None when none did."""
    test = record["testing"]
    values = [v for v, s in zip(test[field], test["status"], strict=True) if s == Status.ARRIVED]
    return sum(values) / len(values) if values else None


def path_ratios(record: Mapping[str, Any], shortest: Sequence[float] | np.ndarray) -> list[float]:
    """Path over shortest path, for each testing trial of one seed that arrived."""
    test = record["testing"]
    return [
        path / length
        for path, length, status in zip(test["path"], shortest, test["status"], strict=True)
        if status == Status.ARRIVED
    ]


def score(
    records: Sequence[Mapping[str, Any]], shortest: Sequence[Any] | np.ndarray | None = None
) -> dict[str, list[float]]:
    """Values over seeds of what the source reports, and of the path against the shortest one.

    Args:
        records: from `per_seed`.
        shortest: from `experiment.shortest_paths`, for the same seeds and testing trials.

    Returns:
        `sr_learning`, `sr_testing`, `sr_online` [%], `n_mv` [steps], `path` [px], `path_ratio` and
        `path_ratio_median` [1]; a seed without an arrival has no value in the last four.
    """
    columns: dict[str, list[float | None]] = {
        "sr_learning": [success(r, "learning") for r in records],
        "sr_testing": [success(r, "testing") for r in records],
        "n_mv": [mean_of_arrivals(r, "steps") for r in records],
        "path": [mean_of_arrivals(r, "path") for r in records],
    }
    if "online" in records[0]:
        columns["sr_online"] = [success(r, "online") for r in records]
    if shortest is not None:
        ratios = [path_ratios(r, s) for r, s in zip(records, shortest, strict=True)]
        columns["path_ratio"] = [float(np.mean(r)) for r in ratios if r]
        columns["path_ratio_median"] = [float(np.median(r)) for r in ratios if r]
    return {k: [v for v in values if v is not None] for k, values in columns.items()}
