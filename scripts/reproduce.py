"""Reproduce tables of the source and write them to results/, one JSON file per table.

    python scripts/reproduce.py --table 3.1 3.2 3.3 --preset paper --seeds 5

Each training's scores are kept in `--out` as they come: run the same command again after an
interruption and it goes on where it was. `--shard 0/2` and `--shard 1/2` in two shells (or on two
machines that share the folder) halve the time. On one CPU core a HAR run takes about 15 s and a
driver run about 12 s; Table 3.1 with 5 seeds is 210 runs.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import tyro

from scripts import _fusion_tables, _run


@dataclasses.dataclass(frozen=True)
class Config:
    """Reproduce tables of the source."""

    table: tuple[str, ...] = ("3.1", "3.2", "3.3", "3.4", "3.5", "3.6")
    """Numbers of the tables."""
    preset: str = "paper"
    """paper for the record, quick for a short check."""
    seeds: int = 5
    """Independent trainings per cell."""
    models: tuple[str, ...] = ()
    """Only these models; all of the table when left out."""
    shard: str = "0/1"
    """i/n: do every n-th run, starting with the i-th."""
    data_dir: Path | None = None
    """Folder of the data sets; $FUSION_DATA_DIR and the user cache are searched next."""
    out: Path | None = None
    """Folder of the single runs; runs/reproduce_<preset> when left out."""
    results: Path = _run.RESULTS
    """Where the tables go."""
    collect_only: bool = False
    """Train nothing; rebuild the tables from the runs that are there."""


def _parse_shard(text: str) -> tuple[int, int]:
    try:
        index, count = (int(part) for part in text.split("/"))
    except ValueError:
        raise ValueError(f"shard={text!r}: expected i/n such as 0/4") from None
    if not 0 <= index < count:
        raise ValueError(f"shard={text!r}: expected 0 <= i < n")
    return index, count


def _source() -> dict[str, Any]:
    """The source's printed numbers of the tables that are reproduced."""
    path = _run.REPOSITORY / "results" / "source_tables.json"
    held: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return held


def write_tables(config: Config, out: Path) -> dict[str, Any]:
    """Write the tables (and the paired comparisons) that have runs; returns them by number."""
    written = {}
    for table in config.table:
        rows, studies = _fusion_tables.collect(table, out, config.seeds, _source())
        if not rows:
            continue
        title, _ = _fusion_tables.TABLES[table]
        name = table.replace(".", "_")
        path = config.results / f"table_{name}.json"
        _run.record_table(path, table, title, rows, preset=config.preset)
        if studies:
            study = {"table": table, "title": f"{title}: paired comparisons", "rows": studies}
            _run.write_json(
                config.results / f"study_paired_{name}.json",
                study | {"preset": config.preset} | _run.provenance(),
            )
        written[table] = rows
    return written


def main(config: Config) -> dict[str, Any]:
    """Do the runs that are missing, then write the tables."""
    unknown = [t for t in config.table if t not in _fusion_tables.TABLES]
    if unknown:
        known = ", ".join(_fusion_tables.TABLES)
        raise ValueError(f"tables {unknown} are not known; known: {known}")
    index, count = _parse_shard(config.shard)
    out = config.out or Path("runs") / f"reproduce_{config.preset}"
    todo = [
        run
        for table in config.table
        for run in _fusion_tables.runs(table, config.seeds)
        if not config.models or run.model in config.models
    ]
    # The source's models first, seed by seed over all tables: an early stop then leaves complete
    # tables of few seeds.
    reference = _fusion_tables.REFERENCES
    todo = sorted(todo, key=lambda run: (run.model in reference, run.seed))[index::count]
    todo = [] if config.collect_only else [run for run in todo if not run.path(out).exists()]
    if todo:
        _run.enable_compilation_cache()
        from fusion.data import load

        names = {run.row.settings["dataset"] for run in todo}
        datasets = {name: load(name, config.data_dir) for name in sorted(names)}
        with _run.progress() as bar:
            task = bar.add_task("runs", total=len(todo), status="")
            for run in todo:
                bar.update(task, status=f"{run.table} {run.row.name} {run.model} s{run.seed}")
                if not run.path(out).exists():
                    dataset = datasets[run.row.settings["dataset"]]
                    record = _fusion_tables.execute(run, dataset, config.preset)
                    _run.write_json(run.path(out), record)
                bar.advance(task)
    written = write_tables(config, out)
    _run.print_result(tables=",".join(written) or "none", runs=len(todo), results=config.results)
    return written


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, description=__doc__))
    except (ValueError, FileNotFoundError) as error:
        _run.fail(str(error))
