"""Studies beside Tables 3.1 to 3.6: other splits, signals, failures on known readings, mixtures.

    python scripts/studies/study_sensors.py --study driver_heads --validation --models argate_plus
    python scripts/studies/study_sensors.py --study driver_trip
    python scripts/studies/study_sensors.py --study driver_tagged
    python scripts/studies/study_sensors.py --study known_readings
    python scripts/studies/study_sensors.py --study kept_out_kinds --seeds 2
    python scripts/studies/study_sensors.py --study har_long
    python scripts/studies/study_sensors.py --study gate_targets

`driver_heads` has the rows of Table 3.5, for choices on validation rows (the table itself is made
by `reproduce.py`); `driver_trip` holds out whole trips; `driver_tagged` has the earlier stand-ins,
one of which names trips; `known_readings` lets sensors fail on values that they give when they
work, with and without the feature that tells known readings; `kept_out_kinds` trains HAR on all
kinds of failure but one and tests on that one; `har_long` trains HAR four times as long as the
preset, beside networks that serve one sensor each; `gate_targets` compares what a gate can learn
from.

Nothing is chosen here: a run trains the preset for all of its epochs and is scored once, on the
test rows, or with `--validation` on training rows that `--split-seed` draws and no training sees.
Whole seeds come first; each training is kept in `runs/study_sensors` with the commit that made it
and its CPU time, so the same command goes on after an interruption, and `results/study_NAME.json`
is written after each; `--restore` takes what that table holds as done. `above_equal_weights` is a
difference seed by seed; paired t tests and Holm's correction over all comparisons of the table
stand beside its rows.
"""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.restored import held_scores
from snn_fusion_failure.records.rows import (
    Compared,
    column_cells,
    commits,
    record_table,
    summarize,
)
from snn_fusion_failure.records.sensor_cases import PAIRS, STUDIES, Case
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    print_result,
    progress,
    repository,
    run_command,
    write_json,
)
from snn_fusion_failure.runs.origin import check_recordable, commit


@dataclasses.dataclass(frozen=True)
class Config:
    """Run one of the studies."""

    study: str = "driver_trip"
    """driver_heads, driver_trip, driver_tagged, known_readings, kept_out_kinds, har_long or
    gate_targets."""
    preset: str = "paper"
    seeds: int = 5
    """Trainings per cell."""
    models: tuple[str, ...] = ()
    """Only these columns."""
    rows: tuple[str, ...] = ()
    """Only these rows."""
    validation: bool = False
    """Score on held-out training rows instead of the test rows, in a table of their own."""
    split_seed: int = 0
    """Draws the validation rows."""
    data_dir: Path | None = None
    """Folder of the data sets; $FUSION_DATA_DIR and the user cache are searched next."""
    out: Path = Path("runs/study_sensors")
    """Folder of the single runs."""
    results: Path = repository.RESULTS
    """Where the table goes."""
    collect_only: bool = False
    """Train nothing; rebuild the table from the runs that are there."""
    restore: bool = False
    """Train no seed again that the table in RESULTS holds: on a new machine, only what is missing.
    """

    def __post_init__(self) -> None:
        """Refuse unknown studies, rows and columns."""
        if self.study not in STUDIES:
            raise ValueError(f"study={self.study!r}: expected one of {', '.join(STUDIES)}")
        _, cases = STUDIES[self.study]
        for name, given, known in (
            ("rows", self.rows, [c.name for c in cases]),
            ("models", self.models, [m for c in cases for m in c.models]),
        ):
            if unknown := sorted(set(given) - set(known)):
                raise ValueError(f"{name}={unknown}: expected some of {list(dict.fromkeys(known))}")

    @property
    def name(self) -> str:
        """Of the table."""
        return f"study_{self.study}" + ("_validation" if self.validation else "")


@dataclasses.dataclass(frozen=True)
class Run:
    """One training, or one ceiling."""

    case: Case
    model: str
    seed: int

    def path(self, config: Config) -> Path:
        """Where its scores are kept."""
        rows = f"validation_{config.split_seed}" if config.validation else "test"
        case = self.case.name.replace(" ", "_").replace(",", "")
        folder = config.out / config.preset / config.study / rows / case / self.model
        return folder / f"{self.seed}.json"


def runs(config: Config) -> list[Run]:
    """All runs of the study, whole seeds first."""
    return [
        Run(case, model, seed)
        for seed in range(config.seeds)
        for case in STUDIES[config.study][1]
        for model in case.models
        if (not config.rows or case.name in config.rows)
        and (not config.models or model in config.models)
    ]


def execute(run: Run, dataset: Any, preset: str) -> dict[str, Any]:
    """Train and score one run."""
    from snn_fusion_failure.commands.argate_runs import Config as RunConfig
    from snn_fusion_failure.commands.argate_runs import (
        build_cases,
        build_settings,
        scores,
        train_and_test,
    )
    from snn_fusion_failure.records.ceilings import CEILINGS, score
    from snn_fusion_failure.records.dedicated import dedicated

    start = time.process_time()
    model = "argate_plus" if run.model in (*CEILINGS, "dedicated") else run.model
    options = RunConfig(model=model, preset=preset, seed=run.seed, **run.case.options)
    (case,) = build_cases(options, dataset).values()
    found: dict[str, Any]
    if run.model in CEILINGS:
        found = dict(score(run.model, dataset, case.noise, run.seed))
    elif run.model == "dedicated":
        found = dedicated(dataset, case.noise, run.seed, preset=preset)
    else:
        noise = dataclasses.replace(case.noise, test_kind=run.case.test_kind)
        settings = build_settings(options, dataset)
        fitted, output = train_and_test(settings, dataset, noise, run.seed)
        found = scores(output, dataset.n_classes)
        found |= {"epochs": settings.train.epochs, "train_loss": fitted.history[-1]["total"]}
    return found | {"git": commit(), "cpu_seconds": time.process_time() - start}


def load_runs(config: Config) -> dict[tuple[str, str], dict[int, dict[str, Any]]]:
    """(row, column) -> seed -> scores of the runs on disk."""
    held: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    for run in runs(config):
        if (path := run.path(config)).exists():
            record = json.loads(path.read_text(encoding="utf-8"))
            held.setdefault((run.case.name, run.model), {})[run.seed] = record
    return held


def collect(config: Config) -> list[dict[str, Any]]:
    """Rows in the schema of record."""
    from snn_fusion_failure.records.fusion_tables import METRICS

    held = load_runs(config)
    units = {metric: "1" if metric.startswith("gate") else "%" for metric in METRICS}
    rows: list[dict[str, Any]] = []
    for (name, model), by_seed in held.items():
        cell: dict[str, Any] = {"row": name, "model": model}
        cell |= {"git": commits(by_seed.values())}
        # A gate is not scored where no sensor fails, nor where there is none.
        rows += [cell | scores for scores in column_cells(by_seed, units)]
        equal = held.get((name, "equal_weights"), {})
        common = sorted(set(equal) & set(by_seed))
        if common and (model, "equal_weights") in PAIRS:
            gains = [by_seed[s]["accuracy"] - equal[s]["accuracy"] for s in common]
            cell |= {"metric": "above_equal_weights", "unit": "%", "seeds": common}
            rows.append(cell | summarize(gains))
    return rows


def restore(config: Config) -> None:
    """Write the single runs that the table of record holds and `out` lacks."""
    held = held_scores(config.results / f"{config.name}.json")
    for run in runs(config):
        scores = held.get((run.case.name, run.model, run.seed), {})
        if "accuracy" in scores and not run.path(config).exists():
            write_json(run.path(config), scores)


def load_data(config: Config) -> Any:
    """The data set of a study; its rows share one."""
    from fusion.data import load, validation_split

    _, (case, *_) = STUDIES[config.study]
    given: dict[str, Any] = {name: case.options.get(name) for name in ("split", "features")}
    dataset = load(case.options["dataset"], config.data_dir, **given)
    held_out = config.validation or case.options.get("validation")
    return validation_split(dataset, seed=config.split_seed) if held_out else dataset


def write(config: Config) -> list[dict[str, Any]]:
    """Put the table where it belongs; returns its rows."""
    rows = collect(config)
    if rows:
        title, _ = STUDIES[config.study]
        if config.validation:
            title = title.replace(", accuracy", ", validation rows, accuracy")
        record_table(
            config.results / f"{config.name}.json",
            config.name,
            title,
            rows,
            preset=config.preset,
            compared=[Compared("accuracy", PAIRS)],
        )
    return rows


def main(config: Config) -> dict[str, Any]:
    """Do the runs that are missing; the table is written after each."""
    if config.restore:
        restore(config)
    todo = [run for run in runs(config) if not run.path(config).exists()]
    todo = [] if config.collect_only else todo
    if config.results.resolve().is_relative_to(repository.RECORD):
        check_recordable(f"record of {config.name}")
    if todo:
        enable_compilation_cache()
        dataset = load_data(config)
        with progress() as bar:
            task = bar.add_task("runs", total=len(todo), status="")
            for run in todo:
                bar.update(task, status=f"{run.case.name} {run.model} s{run.seed}")
                write_json(run.path(config), execute(run, dataset, config.preset))
                write(config)
                bar.advance(task)
    rows = write(config)
    print_result(study=config.study, runs=len(todo), cells=len(rows))
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
