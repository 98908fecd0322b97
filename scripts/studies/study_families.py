"""How hard the map families are, and what each axis of difficulty adds.

    python scripts/studies/study_families.py

For the four families of `jaxsnn.families`, on the first maps of the test split: success of the
drivers that learn nothing (blind, reflex 60, reflex 100), from the same starts everywhere, the
share of maps that the planner solves with 15 px to spare and the length of its paths (`path`, and
`path_shortest` as near to everything as the robot's radius lets it). Then the family "detour" with
one axis switched on at a time: moving obstacles, a stuck sonar, noise, several robots in one world
(`family_map(..., moving=4)` and so on; the walls stay the same). Last the maps with a name, S1 to
S3 and D1 to D3. No network is trained. Writes `results/study_families.json`; two CPU-minutes, most
of them to draw the maps of "cluttered".
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import enable_compilation_cache, progress, repository, run_command
from snn_fusion_failure.runs.origin import check_recordable

FAMILIES = ("open", "cluttered", "detour", "maze")
AXES: dict[str, dict[str, Any]] = {
    "4 moving obstacles": {"moving": 4},
    "8 moving obstacles": {"moving": 8},
    "inner left sonar stuck at 20 px": {"sonar_stuck": {1: 20.0}},
    "inner left sonar dead (300 px)": {"sonar_stuck": {1: 300.0}},
    "noise on the sonars, 20 px": {"sonar_noise": 20.0},
    "noise on all sensors, 20 px and 10 degrees": {
        "sonar_noise": 20.0, "distance_noise": 20.0, "angle_noise": 10.0,
    },
    "4 robots in one world": {"robots": 4},
}  # fmt: skip
"""Row of the table -> options of `family_map`."""
BASE = "detour"
NAMED = {f"Scenario {i}": f"S{i}" for i in (1, 2, 3)} | {f"D{i}": f"D{i}" for i in (1, 2, 3)}
"""Row of the table -> name of a map."""
TITLE = "Map families and axes of difficulty: drivers that learn nothing, and the planner"


@dataclasses.dataclass(frozen=True)
class Config:
    """Measure families of maps."""

    families: tuple[str, ...] = FAMILIES
    axes: tuple[str, ...] = tuple(AXES)
    """Of the family "detour", each by itself."""
    named: tuple[str, ...] = tuple(NAMED)
    """Maps with a name."""
    maps: int = 20
    """First ones of the test split."""
    robots: int = 16
    trials: int = 5
    """Of each robot on each map."""


def measured(config: Config, map: Any) -> dict[str, tuple[str, str, float]]:
    """Driver or planner -> metric, unit and value of a map; several robots share its world."""
    from jaxsnn.families import difficulty

    found = difficulty(map, robots=config.robots, trials=config.trials)._asdict()
    shortest = found.pop("shortest")
    if len(map.starts) > 2:
        found = together(config, map)
    rates = {name: ("sr_testing", "%", rate) for name, rate in found.items()}
    solved = math.isfinite(shortest)
    ways = {"planner, path": ("path", "px", shortest)} if solved else {}
    return rates | ways | {
        "planner": ("share_solved", "%", 100.0 * solved),
        "planner, shortest path": ("path_shortest", "px", shortest_path(map)),
    }  # fmt: skip


def shortest_path(map: Any) -> float:
    """Mean length of the shortest ways from the start circles, by the robot's own radius [px]."""
    import numpy as np

    from jaxsnn.planner import path_field

    drawn = np.asarray(map.start_probs) > 0
    return float(np.mean(path_field(map).lengths(np.asarray(map.starts, np.float64)[drawn, :2])))


def together(config: Config, map: Any) -> dict[str, float]:
    """Success of robots that share a world, over as many runs as robots have trials [%]."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn.drivers import DRIVERS, drive_together
    from jaxsnn.status import Status

    keys = jax.random.split(jax.random.key(20_170), config.robots * config.trials)
    ends = {
        name: np.asarray(drive_together(jax.tree.map(jnp.float32, params), map, keys=keys))
        for name, params in DRIVERS.items()
    }
    return {name: 100.0 * float(np.mean(end == Status.ARRIVED)) for name, end in ends.items()}


def cases(config: Config) -> Iterator[tuple[str, Sequence[Callable[[], Any]]]]:
    """Row, and what makes its maps."""
    from jaxsnn.families import family_map
    from jaxsnn.map_files import named_map

    rows: list[tuple[str, str, dict[str, Any]]] = [(f, f, {}) for f in config.families]
    rows += [(f"{BASE}, {axis}", BASE, AXES[axis]) for axis in config.axes]
    for row, family, options in rows:
        make = functools.partial(family_map, family, "test", **options)
        yield row, [functools.partial(make, number=number) for number in range(config.maps)]
    for row in config.named:
        yield row, [functools.partial(named_map, NAMED[row])]


def main(config: Config) -> dict[str, float]:
    """Measure every case; returns the success of the better reflex by row."""
    for name, given, allowed in (
        ("families", config.families, FAMILIES),
        ("axes", config.axes, tuple(AXES)),
        ("named", config.named, tuple(NAMED)),
    ):
        if unknown := [g for g in given if g not in allowed]:
            raise ValueError(f"{name}={unknown}: expected some of {list(allowed)}; choose")
    if config.maps < 1:
        raise ValueError(f"maps={config.maps}: expected at least one; raise it")
    check_recordable()
    enable_compilation_cache()
    todo, best = list(cases(config)), {}
    rows: list[dict[str, Any]] = []
    with progress() as bar:
        task = bar.add_task("maps", total=sum(len(maps) for _, maps in todo), status="")
        for row, maps in todo:
            values: dict[str, list[float]] = {}
            units: dict[str, tuple[str, str]] = {}
            for make in maps:
                for model, (metric, unit, value) in measured(config, make()).items():
                    values.setdefault(model, []).append(value)
                    units[model] = metric, unit
                bar.update(task, advance=1, status=row)
            for model, (metric, unit) in units.items():
                rows.append(
                    {"row": row, "model": model.split(",")[0], "metric": metric, "unit": unit,
                     **summarize(values[model])}
                )  # fmt: skip
            means = {model: sum(v) / len(v) for model, v in values.items()}
            best[row] = max(means["reflex_60"], means["reflex_100"])
            print(row, {model: round(mean, 1) for model, mean in means.items()}, flush=True)
    path = repository.RESULTS / "study_families.json"
    record_table(path, path.stem, TITLE, rows, preset=f"{config.maps} maps of the test split")
    return best


def fields(done: dict[str, float]) -> dict[str, Any]:
    """What the result line says."""
    return {"cases": len(done), "file": "results/study_families.json"}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=fields)
