"""Rows of the table of detours: where a learner learns, where it is tested, what is measured."""

from __future__ import annotations

from typing import Any

FAMILY = "held-out detour family"
ROWS = ("Scenario 1", "Scenario 2", "Scenario 3", "D1", "D2", "D3", FAMILY)


def is_family(row: str) -> bool:
    """Whether a learner is tested on other maps than the one it learns on."""
    return row == FAMILY or row.startswith("detour/")


def row_name(scenario: str) -> str:
    """What a map is called in the tables: `Scenario 1` for 1, `D1` for D1."""
    return scenario if scenario.startswith("D") else f"Scenario {scenario}"


def train_map(row: str) -> Any:
    """The map that a learner of a row learns on; a row may be a map's name, `detour/train/3`."""
    from jaxsnn import families, scenarios
    from jaxsnn.map_files import named_map

    if row == FAMILY:
        return families.family_map("detour", "train", 0)
    if is_family(row):
        return named_map(row)
    if row.startswith("D"):
        return scenarios.detour(int(row[1:]))
    return scenarios.scenario(int(row.removeprefix("Scenario ")))


def tested_maps(row: str, family_maps: int, split: str) -> list[Any]:
    """The maps of the testing trials: the first ones of a split of the family, or the row's own."""
    from jaxsnn import families

    if not is_family(row):
        return [train_map(row)]
    return [families.family_map("detour", split, i) for i in range(family_maps)]


def trials_per_map(row: str, test_trials: int) -> int:
    """Testing trials of each robot on each map."""
    return 1 if is_family(row) else test_trials


def values_of(maps: list[Any], status: Any, path: Any, starts: Any) -> dict[str, list[float]]:
    """One value per robot from `[maps, robots, trials]` of status, path and start points."""
    import numpy as np

    from jaxsnn import planner
    from jaxsnn.status import Status

    arrived = status == Status.ARRIVED
    ratio = np.full(path.shape, np.nan)
    for i, map in enumerate(maps):
        if arrived[i].any():
            points = starts[i][arrived[i]].astype(np.float64)
            ratio[i][arrived[i]] = path[i][arrived[i]] / planner.path_field(map).lengths(points)
    robots = range(status.shape[1])
    ratios = [float(np.nanmean(ratio[:, r])) for r in robots if arrived[:, r].any()]
    return {"sr_testing": (100.0 * arrived.mean(axis=(0, 2))).tolist(), "path_ratio": ratios}
