"""Reversible convolutional ARGate beside the ordinary: accuracy, auxiliary paths, memory, windows.

    python scripts/studies/study_rev_conv.py
    python scripts/studies/study_rev_conv.py --part memory
    python scripts/studies/study_rev_conv.py --part restoration
    python scripts/studies/study_rev_conv.py --validation --models rev_conv_argate --seeds 1

The table has rows as in Table 3.1 and `unseen kinds`, means over failures that no training had.
Columns: networks of record; a convolutional one with as many parameters and one with as much
training memory as the reversible network; reversible networks; one of them that stays as drawn with
a linear head (the trivial opponent); the gate that is told which sensors failed; and the crossing
with Bayesian gates and spiking encoders. `--part memory` compiles training at depths 4 to 32 with
and without the reverse rule. `--part restoration` trains on all but four subjects and restores a
failed sensor's windows from those of the others. Each training is kept as it comes in
`runs/study_rev_conv`, so the same command goes on after an interruption, and the table is written
again after each of them. With `--validation` the table scores held-out subjects and writes nothing
to `results/`. A training takes 15 to 60 s of CPU time.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal, NamedTuple

from snn_fusion_failure.records.rows import Compared, column_cells, record_table, summarize
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    print_result,
    progress,
    repository,
    run_command,
    write_json,
)

NAME = "study_rev_conv"
TITLE = "Reversible convolutional sensor fusion: accuracy, auxiliary paths, memory, restoration"
UNSEEN_ROW = "unseen kinds"
TRAINED_FOR_UNSEEN = "n_clean=5 uniform"
DATASET = "har"


class Column(NamedTuple):
    """A network of the table: options of `train_argate`."""

    model: str
    changes: tuple[str, ...] = ()
    encoder: str | None = None
    gate: str = "deterministic"


# The likeliest constants of results/study_bayesian_gate_choice.json.
_BAYESIAN = (
    *("model.gate_prior=0.1", "hyper.loss.divergence=0.1"),
    "model.loss.label_smoothing=0",
)
_DRAWN = ("model.encoder.reversible.learned=false", "model.head_widths=[]")
# As many parameters, and as much memory of training, as rev_conv_argate.
_PARAMETERS = ("model.encoder.conv_features=[24, 52]",)
_MEMORY = ("model.encoder.conv_features=[8, 16]",)
_DEEP = ("model.encoder.reversible.depths=[4, 4]",)
COLUMNS = {
    "baseline": Column("baseline"),
    "argate_l": Column("argate_l"),
    "argate_l_parameters": Column("argate_l", _PARAMETERS),
    "argate_l_memory": Column("argate_l", _MEMORY),
    "rev_conv_baseline": Column("rev_conv_baseline"),
    "rev_conv_argate_plus": Column("rev_conv_argate_plus"),
    "rev_conv_argate": Column("rev_conv_argate"),
    "rev_conv_argate_deep": Column("rev_conv_argate", _DEEP),
    "rev_conv_drawn_linear": Column("rev_conv_baseline", _DRAWN),
    "rev_conv_oracle": Column("oracle", (), "reversible"),
    "argate_l_bayesian": Column("argate_l", _BAYESIAN, gate="bayesian"),
    "rev_conv_argate_bayesian": Column("rev_conv_argate", _BAYESIAN, gate="bayesian"),
    "spiking_argate": Column("spiking_argate"),
    "spiking_argate_bayesian": Column("spiking_argate", _BAYESIAN, gate="bayesian"),
}


def _random(n_clean: int) -> dict[str, Any]:
    return {"protocol": "random", "n_clean": n_clean, "kind": "uniform"}


ROWS: dict[str, dict[str, Any]] = {
    TRAINED_FOR_UNSEEN: _random(5),
    "clean": {"protocol": "clean"},
    "n_clean=1 uniform": _random(1),
    "n_clean=8 uniform": _random(8),
}
"""Row -> options of `train_argate`."""
FEW = tuple(name for name in COLUMNS if name.endswith(("_memory", "_deep", "_linear", "_oracle",
            "_bayesian")) or name == "spiking_argate")  # fmt: skip
"""Columns of the first two rows only."""
PAIRS = (
    ("rev_conv_argate", "argate_l"),
    ("rev_conv_argate", "argate_l_parameters"),
    ("rev_conv_argate", "argate_l_memory"),
    ("rev_conv_argate_deep", "rev_conv_argate"),
    ("rev_conv_baseline", "baseline"),
    ("rev_conv_argate", "rev_conv_baseline"),
    ("rev_conv_argate_plus", "rev_conv_baseline"),
    ("rev_conv_baseline", "rev_conv_drawn_linear"),
    ("rev_conv_oracle", "rev_conv_argate"),
    ("rev_conv_argate_bayesian", "rev_conv_argate"),
    ("spiking_argate_bayesian", "spiking_argate"),
)
"""Columns that are compared seed by seed, in accuracy."""
COMPARED = (
    Compared("accuracy", PAIRS),
    Compared("aux_loss", PAIRS[:2]),
    Compared("aux_accuracy", PAIRS[:2]),
    Compared("failed_auroc", PAIRS[:2], 100.0),
)
"""Of the first two pairs the source's hypothesis too: better auxiliary paths, better weights."""
METRICS = {
    **dict.fromkeys(("accuracy", "accuracy_clean", "accuracy_corrupted", "aux_accuracy"), "%"),
    **dict.fromkeys(("ece", "nll", "aurc", "failed_auroc", "aux_loss"), "1"),
    **dict.fromkeys(("multiply_adds", "synaptic_operations", "parameters"), "1"),
    "training_memory": "MB",
}
SENSORS = {"body_acc_x": 0, "body_gyro_x": 3, "total_acc_x": 6}
"""Sensors that are restored, one at a time, and their places."""
RESTORED = {"rmse": "sd", "largest_error": "1", "coverage_90": "%", "restored_accuracy": "%"}


@dataclasses.dataclass(frozen=True)
class Config:
    """Train and score the columns of the rows, or measure what reversibility is for."""

    part: Literal["table", "memory", "restoration"] = "table"
    rows: tuple[str, ...] = tuple(ROWS)
    models: tuple[str, ...] = tuple(COLUMNS)
    """Columns of the table."""
    seeds: int = 5
    """Trainings per cell."""
    depths: tuple[int, ...] = (4, 8, 16, 32)
    """Blocks of both stages together (`--part memory`)."""
    sensors: tuple[str, ...] = tuple(SENSORS)
    """What is restored (`--part restoration`)."""
    preset: str = "paper"
    changes: tuple[str, ...] = ()
    """Constants changed in every column, as `--set` of train_argate."""
    validation: bool = False
    """Score on held-out subjects instead of the test rows; nothing is recorded."""
    data_dir: Path | None = None
    """Folder of the data sets; $FUSION_DATA_DIR and the user cache are searched next."""
    out: Path = Path("runs") / NAME
    """Folder of the single runs."""
    results: Path = repository.RESULTS
    """Where the table goes."""
    collect_only: bool = False
    """Train nothing; rebuild the table from the runs that are there."""

    def __post_init__(self) -> None:
        """Refuse rows and columns that the study does not have."""
        for name, known in (("rows", ROWS), ("models", COLUMNS), ("sensors", SENSORS)):
            given = getattr(self, name)
            if unknown := sorted(set(given) - set(known)):
                raise ValueError(f"{name}={unknown}: expected some of {list(known)}; see the list")

    @property
    def folder(self) -> Path:
        """Where single runs of these settings are kept."""
        changed = "_".join(self.changes).replace("/", "-") or "preset"
        return self.out / ("validation" if self.validation else "test") / self.preset / changed


class Run(NamedTuple):
    """One training, or one restoration of all sensors (`row` is then "restoration")."""

    row: str
    model: str
    seed: int

    def path(self, config: Config) -> Path:
        """Where its scores are kept."""
        return config.folder / self.row.replace(" ", "_") / self.model / f"{self.seed}.json"


def runs(config: Config) -> list[Run]:
    """All runs that are asked for, whole rows of a seed first."""
    seeds = range(config.seeds)
    if config.part == "memory":
        return [Run("memory", "rev_conv_argate", 0)]
    if config.part == "restoration":
        return [Run("restoration", "rev_conv_argate", seed) for seed in seeds]
    first = tuple(ROWS)[:2]
    return [
        Run(row, model, seed)
        for seed in seeds
        for row in config.rows
        for model in config.models
        if row in first or model not in FEW
    ]


def settings_of(config: Config, run: Run, dataset: Any) -> tuple[Any, Any]:
    """Settings of a run, and which sensors fail."""
    from snn_fusion_failure.commands import argate_runs

    column = COLUMNS[run.model]
    changes = (*column.changes, *config.changes)
    options: dict[str, Any] = column._asdict() | {"changes": changes, "preset": config.preset}
    row = ROWS.get(run.row, ROWS[TRAINED_FOR_UNSEEN])
    asked = argate_runs.Config(dataset=dataset.name, seed=run.seed, **options, **row)
    settings = argate_runs.build_settings(asked, dataset)
    (case,) = argate_runs.build_cases(asked, dataset).values()
    return settings, case.noise


def load_runs(config: Config) -> dict[tuple[str, str], dict[int, dict[str, Any]]]:
    """(row, column) -> seed -> scores, with the unseen kinds as a row of their own."""
    held: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    for run in runs(dataclasses.replace(config, part="table")):
        path = run.path(config)
        if not path.exists():
            continue
        record = json.loads(path.read_text(encoding="utf-8"))
        held.setdefault((run.row, run.model), {})[run.seed] = record
        if unseen := record.get("unseen"):
            held.setdefault((UNSEEN_ROW, run.model), {})[run.seed] = unseen
    for run in runs(dataclasses.replace(config, part="restoration")):
        if (path := run.path(config)).exists():
            for sensor, methods in json.loads(path.read_text(encoding="utf-8")).items():
                for method, scores in methods.items():
                    held.setdefault((f"{sensor} restored", method), {})[run.seed] = scores
    return held


def _cells(config: Config) -> list[dict[str, Any]]:
    """Rows in the schema of record."""
    # Auxiliary paths, gates and intervals are scored where there are any.
    rows = [
        {"row": row, "model": model} | cell
        for (row, model), by_seed in load_runs(config).items()
        for cell in column_cells(by_seed, RESTORED if row.endswith("restored") else METRICS)
    ]
    (memory,) = runs(dataclasses.replace(config, part="memory"))
    if (path := memory.path(config)).exists():
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            value = cell.pop("value")
            rows.append(cell | summarize([value]))
    return rows


def write(config: Config) -> list[dict[str, Any]]:
    """Put the table and its comparisons where they belong; returns its rows."""
    rows = _cells(config)
    if rows and not config.validation:
        path = config.results / f"{NAME}.json"
        record_table(path, NAME, TITLE, rows, preset=config.preset, compared=COMPARED)
    return rows


def execute(config: Config, run: Run, whole: Any) -> dict[str, Any]:
    """Do one run; returns its scores."""
    from fusion.data import validation_split
    from snn_fusion_failure.records import reversible_parts, reversible_scores

    if run.row == "memory":
        settings, _ = settings_of(config, run, whole)
        windows = whole.train_x[: reversible_parts.BATCH]
        of = settings.model, settings.hyper, windows, config.depths
        return {"cells": reversible_parts.memory_by_depth(*of)}
    held = validation_split(whole)
    if run.row == "restoration":
        settings, noise = settings_of(config, run, held)
        on = held if config.validation else whole
        sensors = {name: SENSORS[name] for name in config.sensors}
        return reversible_parts.restored_scores(settings, held, noise, on, sensors, run.seed)
    dataset = held if config.validation else whole
    settings, noise = settings_of(config, run, dataset)
    unseen = run.row == TRAINED_FOR_UNSEEN
    return reversible_scores.trained_scores(settings, dataset, noise, run.seed, unseen=unseen)


def main(config: Config) -> dict[str, Any]:
    """Do the runs that are missing, then write the table."""
    todo = [run for run in runs(config) if not run.path(config).exists()]
    todo = [] if config.collect_only else todo
    if todo:
        enable_compilation_cache()
        from fusion.data import load

        whole = load(DATASET, config.data_dir)
        with progress() as bar:
            task = bar.add_task("runs", total=len(todo), status="")
            for run in todo:
                bar.update(task, status=f"{run.row} {run.model} s{run.seed}")
                write_json(run.path(config), execute(config, run, whole))
                write(config)
                bar.advance(task)
    rows = write(config)
    for row in rows:
        if row["metric"] in ("accuracy", "rmse", "memory_by_depth"):
            unit = row["unit"]
            print(f"{row['row']:26} {row['model']:40} {row['mean']:9.3f} {unit} of {row['n']}")
    print_result(study=NAME, runs=len(todo), cells=len(rows))
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
