"""Reproduce the source: run what fills its tables, and write one page that shows all of it.

    python scripts/studies/reproduce.py --preset quick
    python scripts/studies/reproduce.py --table 3.1 3.2 3.3 --preset paper --seeds 5
    python scripts/studies/reproduce.py --report-only

The first runs a small piece of each chapter (four robots of each network on Scenario 1; four fusion
networks on HAR, or on simulated windows and says so; three searches for failures of the LDO
regulator) and writes `report/index.html`: all tables and figures beside the source's, filled up
with the results of record. The second makes tables of record in results/, `--preset paper` without
`--table` all of them; the third draws the page from what is there, in seconds.

Every run is kept as it comes: the same command again goes on after an interruption. With
`--restore` a new machine trains only the seeds of Tables 3.1 to 3.6 that results/ lacks. `--shard
0/2` and `--shard 1/2` in two shells (or on two machines that share the folder) halve the time of
the 3.x tables. What each costs is in docs/reproduction.md.
"""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.records import chapters
from snn_fusion_failure.runs import print_result, provenance, repository, run_command, write_json


@dataclasses.dataclass(frozen=True)
class Config:
    """Reproduce tables of the source."""

    table: tuple[str, ...] = ()
    """Numbers of the tables; all of the preset when left out."""
    preset: Literal["paper", "quick"] = "paper"
    """paper for the record, quick for a small piece of each chapter."""
    seeds: int | None = None
    """Independent runs per cell; paper: 64 robots, 5 trainings, 20 searches."""
    models: tuple[str, ...] = ()
    """Only these models (networks, search methods); all of the table when left out."""
    shard: str = "0/1"
    """i/n: do every n-th fusion run, starting with the i-th."""
    data_dir: Path | None = None
    """Folder of the data sets; $FUSION_DATA_DIR and the user cache are searched next."""
    out: Path | None = None
    """Folder of the single runs; runs/report for quick; each chapter's own for paper."""
    results: Path | None = None
    """Where the tables go; results/ for paper, OUT/results for quick."""
    collect_only: bool = False
    """Train nothing; rebuild the tables from the runs that are there."""
    restore: bool = False
    """Train no seed of Tables 3.1 to 3.6 again that the tables in RESULTS hold: on a new machine,
    only what is missing."""
    report_only: bool = False
    """Run and collect nothing; draw the page from the tables that are there."""
    report: Path | None = None
    """Folder of the page; report/, or OUT/report with --out."""
    overwrite: bool = False
    """Forget the quick runs in OUT."""


def _parse_shard(text: str) -> tuple[int, int]:
    try:
        index, count = (int(part) for part in text.split("/"))
    except ValueError:
        raise ValueError(f"shard={text!r}: expected i/n such as 0/4") from None
    if not 0 <= index < count:
        raise ValueError(f"shard={text!r}: expected 0 <= i < n")
    return index, count


def _tables(config: Config) -> tuple[str, ...]:
    """The tables to fill."""
    known = chapters.RUNNERS
    for table in config.table:
        if table in chapters.NOT_RUNNABLE:
            raise ValueError(f"table {table} {chapters.NOT_RUNNABLE[table]}")
    unknown = [t for t in config.table if t not in known]
    if unknown:
        raise ValueError(f"tables {unknown} are not known; known: {', '.join(known)}")
    return config.table or (chapters.QUICK_TABLES if config.preset == "quick" else tuple(known))


def _fill(config: Config, out: Path | None, results: Path) -> tuple[dict[str, Any], Any, int]:
    """Run the chapters; returns rows and times by table, and the number of runs.

    The times are `{"seconds": {tables: wall}, "cpu_seconds": {tables: CPU of this process}}`.
    """
    quick = config.preset == "quick"
    plan = chapters.Plan(
        preset=config.preset,
        results=results,
        piece=quick and not config.table,
        seeds=config.seeds,
        models=config.models,
        shard=_parse_shard(config.shard),
        data_dir=config.data_dir,
        out=out,
        collect_only=config.collect_only,
        restore=config.restore,
    )
    by_runner: dict[Callable[..., Any], list[str]] = {}
    for table in _tables(config):
        if config.overwrite and out is not None and (out / table).is_dir():
            shutil.rmtree(out / table)
        by_runner.setdefault(chapters.RUNNERS[table], []).append(table)
    written: dict[str, Any] = {}
    seconds: dict[str, float] = {}
    cpu_seconds: dict[str, float] = {}
    runs = 0
    for runner, tables in by_runner.items():
        started, used = time.monotonic(), time.process_time()
        found, count = runner(plan, tables)
        written |= found
        runs += count
        seconds[", ".join(tables)] = round(time.monotonic() - started, 1)
        cpu_seconds[", ".join(tables)] = round(time.process_time() - used, 1)
    return written, {"seconds": seconds, "cpu_seconds": cpu_seconds}, runs


def main(config: Config) -> dict[str, Any]:
    """Do the runs that are missing, write the tables and the page; returns rows by table."""
    from snn_fusion_failure.records import report as html_report

    quick = config.preset == "quick"
    if config.overwrite and not quick:
        raise ValueError("overwrite is for quick runs; remove the folder of a paper run yourself")
    _parse_shard(config.shard)
    _tables(config)
    out = config.out or (Path("runs") / "report" if quick else None)
    results = config.results or (
        repository.RESULTS if not quick or out is None else out / "results"
    )
    written: dict[str, Any] = {}
    runs = 0
    if not config.report_only:
        written, times, runs = _fill(config, out, results)
        if quick and out is not None and not config.collect_only:
            write_json(out / "report.json", times | provenance())
    fresh = results if results != repository.RESULTS else Path("runs") / "report" / "results"
    report = config.report or (config.out / "report" if config.out else Path("report"))
    page = html_report.write(report, fresh=fresh, record=repository.RESULTS)
    print_result(
        tables=",".join(written) or "none",
        runs=runs,
        results=results,
        page=page,
    )
    return written


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
