"""One runner per chapter of the source: which trainings fill which tables, at record or small size.

A runner does the runs that are missing in its folder and writes the tables; run again, it goes on
where it was. `quick` is a small honest piece: few seeds, short trainings, short searches.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.records import fusion_tables
from snn_fusion_failure.records.restored import restore
from snn_fusion_failure.records.rows import record_comparisons, record_table, summarize
from snn_fusion_failure.runs import enable_compilation_cache, progress, repository, write_json

Written = dict[str, list[dict[str, Any]]]
# Rows by table, and how many trainings or studies were done or taken up again for them.
Done = tuple[Written, int]

SCENARIOS = {"2.3": 1, "2.4": 2, "2.5": 3}
NETWORKS = ("S1", "S2", "S3", "S4", "Q-learning")
CIRCUITS = {"4.1": ("ldo", "LDO regulator"), "4.2": ("dcdc", "DC-DC converter")}

# The quick piece of a chapter.
QUICK_TABLES = ("2.3", "3.1", "4.1")
QUICK_ROW = "n_clean=1 uniform"
QUICK_MODELS = ("baseline", "netgated", "argate_plus", "argate_l")
QUICK_SPECS = {"4.1": "undershoot", "4.2": "output_accuracy"}
QUICK_METHODS = ("pbo", "hdbo", "rev_argate_bnn")
QUICK_SIMULATIONS = 100


@dataclasses.dataclass(frozen=True)
class Plan:
    """What to run and where.

    Attributes:
        preset: "paper" or "quick".
        piece: of Table 3.1, one row and one seed instead of all of it.
        seeds: independent runs per cell; the chapter's own number when None.
        models: only these models, networks or search methods; all when empty.
        shard: (i, n): every n-th fusion run, starting with the i-th.
        data_dir: folder of the data sets.
        out: folder of the single runs; each chapter's own when None.
        results: folder of the tables.
        collect_only: run nothing.
        restore: take the seeds that tables of record hold as done.
    """

    preset: str
    results: Path
    piece: bool = False
    seeds: int | None = None
    models: tuple[str, ...] = ()
    shard: tuple[int, int] = (0, 1)
    data_dir: Path | None = None
    out: Path | None = None
    collect_only: bool = False
    restore: bool = False

    def wants(self, model: str) -> bool:
        """Is this model asked for?"""
        return not self.models or model in self.models

    def record(self, table: str, title: str, rows: Sequence[dict[str, Any]]) -> None:
        """Write rows of a table into the folder of results."""
        path = self.results / f"table_{table.replace('.', '_')}.json"
        record_table(path, table, title, rows, preset=self.preset)


def source_tables() -> dict[str, Any]:
    """The source's printed numbers."""
    path = repository.ROOT / "results" / "source_tables.json"
    held: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return held


def _learn(plan: Plan, table: str, network: str) -> dict[str, Any] | None:
    """Score -> summary of one network, or of Q-learning; None when it may not be run."""
    from snn_fusion_failure.commands import train_rl, train_snn

    scenario: Any = SCENARIOS[table]
    preset: Any = plan.preset
    seeds = plan.seeds or (4 if preset == "quick" else 64)
    out = plan.out / table / network if plan.out else None
    if network == "Q-learning":
        out = out or Path("runs") / "reproduce_paper" / table / network
        held = out / "result.json"
        if held.exists():
            found: dict[str, Any] = json.loads(held.read_text(encoding="utf-8"))
            return found[str(scenario)]
        if plan.collect_only:
            return None
        rl = train_rl.Config(
            preset=preset, scenarios=(str(scenario),), seeds=seeds, out=out, overwrite=True
        )
        return train_rl.main(rl)[str(scenario)]
    default = Path("runs") / "train_snn" / f"scenario{scenario}_{network}_tuned"
    if plan.collect_only and not (out or default).exists():
        return None
    name: Any = network
    snn = train_snn.Config(
        scenario=scenario, model=name, preset=preset, seeds=seeds, out=out, resume=True
    )
    metrics: dict[str, Any] = train_snn.main(snn)["metrics"]
    return metrics


def spiking(plan: Plan, tables: Sequence[str]) -> Done:
    """Tables 2.3 to 2.5: the four networks and Q-learning on a scenario."""
    from snn_fusion_failure.commands.train_snn import UNITS

    written: Written = {}
    runs = 0
    for table in tables:
        source = source_tables()[table]["rows"]
        row = f"Scenario {SCENARIOS[table]}"
        for network in filter(plan.wants, NETWORKS):
            metrics = _learn(plan, table, network)
            if metrics is None:
                continue
            rows = []
            for metric, summary in metrics.items():
                if network == "Q-learning" and metric not in source[network]:
                    continue
                unit = UNITS.get(metric, "%")
                cell = {"row": row, "model": network, "metric": metric, "unit": unit, **summary}
                if metric in source[network]:
                    cell["source"] = source[network][metric]
                rows.append(cell)
            plan.record(table, f"{row}: success rates and steering movements", rows)
            written.setdefault(table, []).extend(rows)
            runs += 1
    return written, runs


def sensor_fusion(plan: Plan, tables: Sequence[str]) -> Done:
    """Tables 3.1 to 3.6; a quick piece of 3.1 on simulated windows when HAR is not at hand."""
    from fusion.data import load

    out = plan.out or Path("runs") / f"reproduce_{plan.preset}"
    seeds = plan.seeds or (1 if plan.piece else 5)
    if plan.restore:
        restore(tables, plan.results, out, seeds)
    todo = [
        run
        for table in tables
        for run in fusion_tables.runs(table, seeds)
        if plan.wants(run.model)
        and (not plan.piece or (run.row.name == QUICK_ROW and run.model in QUICK_MODELS))
    ]
    # Seed by seed over all tables: an early stop then leaves complete tables of few seeds.
    index, count = plan.shard
    todo = sorted(todo, key=lambda run: run.seed)
    todo = todo[index::count]
    todo = [] if plan.collect_only else [run for run in todo if not run.path(out).exists()]
    if todo:
        enable_compilation_cache()
        names = {run.row.settings["dataset"] for run in todo}
        try:
            datasets = {name: load(name, plan.data_dir) for name in sorted(names)}
        except FileNotFoundError as error:
            if not plan.piece:
                raise
            print(f"simulated windows instead of HAR: {error}", file=sys.stderr)
            return _simulated(plan, out, seeds)
        with progress() as bar:
            task = bar.add_task("runs", total=len(todo), status="")
            for run in todo:
                bar.update(task, status=f"{run.table} {run.row.name} {run.model} s{run.seed}")
                # Another shard may have done it in the meantime.
                if not run.path(out).exists():
                    dataset = datasets[run.row.settings["dataset"]]
                    record = fusion_tables.execute(run, dataset, plan.preset)
                    write_json(run.path(out), record)
                bar.advance(task)
    written: Written = {}
    for table in tables:
        rows, studies = fusion_tables.collect(table, out, seeds, source_tables())
        # Columns that were not asked for keep the command and the seeds that made them.
        rows = [row for row in rows if plan.wants(row["model"])]
        if not rows:
            continue
        title, _ = fusion_tables.TABLES[table]
        plan.record(table, title, rows)
        if studies:
            record_comparisons(plan.results, table, title, studies, preset=plan.preset)
        written[table] = rows
    return written, len(todo)


def _simulated(plan: Plan, out: Path, seeds: int) -> Done:
    """The quick piece on simulated windows; its rows are named so and have no printed number."""
    from fusion.data import load

    settings = {"dataset": "simulated", "protocol": "random", "n_clean": 1, "kind": "uniform"}
    row = fusion_tables.Row("simulated windows (HAR not at hand), n_clean=1 uniform", settings)
    dataset = load("simulated")
    rows = []
    runs = 0
    for model in filter(plan.wants, QUICK_MODELS):
        records = []
        for seed in range(seeds):
            run = fusion_tables.Run("3.1", row, model, seed)
            if not run.path(out).exists():
                write_json(run.path(out), fusion_tables.execute(run, dataset, plan.preset))
                runs += 1
            records.append(json.loads(run.path(out).read_text(encoding="utf-8")))
        for metric in ("accuracy", "accuracy_clean", "accuracy_corrupted"):
            cell = {"row": row.name, "model": model, "metric": metric, "unit": "%"}
            rows.append(cell | summarize([record[metric] for record in records]))
    plan.record("3.1", fusion_tables.TABLES["3.1"][0], rows)
    return {"3.1": rows}, runs


def failures(plan: Plan, tables: Sequence[str]) -> Done:
    """Tables 4.1 and 4.2: searches for failures of a circuit."""
    from failure.search.methods import BY_VALUES
    from snn_fusion_failure.records import failure_tables

    quick = plan.preset == "quick"
    written: Written = {}
    runs = 0
    for table in tables:
        circuit, title = CIRCUITS[table]
        out = plan.out / table if plan.out else Path("runs") / f"table_{table.replace('.', '_')}"
        if plan.collect_only:
            held = out / f"rows_{circuit}.json"
            rows = json.loads(held.read_text(encoding="utf-8")) if held.exists() else []
        else:
            names = QUICK_METHODS if quick else BY_VALUES
            methods = tuple(filter(plan.wants, names))
            if not methods:  # which the study would read as all of them
                continue
            config = failure_tables.Config(
                circuit=circuit, out=out, methods=methods,
                seeds=plan.seeds or (2 if quick else 20),
            )  # fmt: skip
            if quick:
                config = dataclasses.replace(
                    config, specs=(QUICK_SPECS[table],), tasks=("box",), probability=False,
                    n_total=QUICK_SIMULATIONS,
                )  # fmt: skip
            rows = failure_tables.main(config)["rows"]
            runs += 1
        if rows:
            plan.record(table, title, rows)
            written[table] = rows
    return written, runs


RUNNERS: dict[str, Callable[[Plan, Sequence[str]], Done]] = {
    **dict.fromkeys(SCENARIOS, spiking),
    **dict.fromkeys(fusion_tables.TABLES, sensor_fusion),
    **dict.fromkeys(CIRCUITS, failures),
}
"""Table -> what fills it."""

NOT_RUNNABLE = {
    "3.7": "needs the KITTI training set, which is not part of this repository",
    "3.8": "needs the labels of the KITTI test set, which its makers keep",
}
"""Tables of the source that no command here fills, and why."""
