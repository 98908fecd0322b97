"""Look at a sweep, finished or running: the best settings, pictures, an interactive page, files."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro


@dataclasses.dataclass(frozen=True)
class Show:
    """Print the best settings of a sweep and draw it."""

    out: Annotated[Path, tyro.conf.Positional]
    """The sweep's folder."""
    top: int = 10
    """Settings to print."""
    objective: str | None = None
    """Metric to rank by; the sweep's own when left out."""
    min_valid: float | None = None
    """Share of a setting's seeds that must be valid for it to be ranked."""
    pareto: tuple[str, ...] = ()
    """Metrics of which to print the settings that no other beats in all."""
    compare: tuple[int, ...] = ()
    """Places of two settings in the table, as 1 2: their difference with its interval."""
    importance: bool = False
    """Share of the variance between settings that each axis explains."""
    figures: bool = True
    """Draw heat maps and parallel coordinates into OUT."""
    page: bool = True
    """Write OUT/index.html, an interactive page that needs no network."""
    export: tuple[Literal["csv", "parquet"], ...] = ()
    """Write all trials as OUT/trials.csv or .parquet (needs pyarrow)."""
    watch: bool = False
    """Print again whenever something has changed, until the sweep is complete; page included."""
    every: float = 2.0
    """Seconds between looks, with --watch."""


def show(config: Show) -> dict[str, Any]:
    """Print and draw a sweep, complete or not; with `watch`, as long as it runs."""
    found = look(config)
    while config.watch and not found["result"]["complete"]:
        time.sleep(config.every)
        print("\033[2J\033[H", end="")  # a clean screen
        found = look(config)
    return found


def look(config: Show) -> dict[str, Any]:
    """One look at the folder."""
    from snn_fusion_failure.sweeps import rank
    from snn_fusion_failure.sweeps.engine import collect
    from snn_fusion_failure.sweeps.folder import held_sweep
    from snn_fusion_failure.sweeps.worker import brief

    sweep = held_sweep(config.out)
    dataset, result = collect(sweep)
    if config.objective:
        rank.rank(dataset, objective=config.objective)  # refuses what cannot be ranked by
        dataset.attrs["objective"] = config.objective
    if config.min_valid is not None:
        dataset.attrs["min_valid"] = config.min_valid
    rows = rank.rank(dataset)
    failures = json.loads(dataset.attrs["failures"])
    for place, message in list(failures.items())[:5]:
        setting, _, seed = place.partition("/")
        print(f"setting {setting} seed {seed} failed: {brief(message)}")
    if len(failures) > 5:
        print(f"... and {len(failures) - 5} more")
    for note in json.loads(dataset.attrs["notes"]):
        print(note)
    print(rank.table(dataset, rows, top=config.top))
    if config.pareto:
        front = rank.pareto(dataset, config.pareto)
        columns = rank.axis_columns(dataset)
        print(f"Pareto front of {', '.join(config.pareto)}:")
        for index in front:
            at = " ".join(f"{k}={rank.value_text(v[index])}" for k, v in columns.items())
            means = " ".join(f"{m}={rank.mean_of(dataset, m, index):.4g}" for m in config.pareto)
            print(f"  {at}: {means}")
    if config.compare:
        print(_comparison(config, dataset, rows))
    if config.importance:
        from snn_fusion_failure.sweeps.importance import importance

        print("share of the variance between settings that an axis explains (alone, in all):")
        for leaf, (first, total) in importance(dataset).items():
            print(f"  {leaf}: {first:.2f}, {'-' if total is None else f'{total:.2f}'}")
    if config.figures and rows:
        from snn_fusion_failure.sweeps.plots import plot_all

        for name, figure in plot_all(dataset).items():
            figure.savefig(config.out / name, dpi=120)
            print(config.out / name)
    if config.page:
        from snn_fusion_failure.sweeps.page import write_page

        print(write_page(dataset, config.out / "index.html", live=not result["complete"]))
    if config.export:
        from snn_fusion_failure.sweeps.export import export

        for kind in config.export:
            print(export(dataset, config.out, kind))
    return {"result": result}


def _comparison(config: Show, dataset: Any, rows: list[dict[str, Any]]) -> str:
    from snn_fusion_failure.sweeps.rank import compare

    if len(config.compare) != 2 or not all(1 <= i <= len(rows) for i in config.compare):
        raise ValueError(
            f"compare={' '.join(map(str, config.compare))}: expected two places of the table, "
            f"from 1 to {len(rows)}"
        )
    a, b = (rows[i - 1]["setting"] for i in config.compare)
    found = compare(dataset, a, b)
    how = "paired over common seeds" if found["paired"] else "independent seeds, Welch"
    low, high = found["ci95"]
    return (
        f"{config.compare[0]} minus {config.compare[1]}: {found['difference']:.4g}, 95 % interval "
        f"{low:.4g} .. {high:.4g}, p = {found['p']:.3g} ({how}, n = {found['n']})"
    )
