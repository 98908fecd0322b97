"""Spiking sensor fusion beside the convolutional: accuracy, unseen failures, cost; seed by seed.

    python scripts/studies/study_spiking_fusion.py
    python scripts/studies/study_spiking_fusion.py --rows "n_clean=5 uniform" --seeds 2
    python scripts/studies/study_spiking_fusion.py --validation --models spiking_argate

Rows as in Table 3.1, their mean over 8, 5 and 1 working sensors, and `unseen kinds`, the mean
accuracy of the networks of `n_clean=5 uniform` under failures that no training had. Columns: the
convolutional networks of record and one made as small as the spiking ones, the spiking networks,
spiking encoders that stay as drawn with a linear head (the trivial opponent), synapses that learn
by reward-modulated STDP, and the gate that is told which sensors failed. Each training is kept as
it comes in `runs/study_spiking_fusion`, so the same command goes on after an interruption, and the
table is written again after each of them. With `--validation` it scores on held-out subjects and
writes nothing to `results/`.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.rows import (
    Compared,
    column_cells,
    record_table,
    recorded,
    values_by_seed,
)
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    print_result,
    progress,
    repository,
    run_command,
    write_json,
)

NAME = "study_spiking_fusion"
TITLE = "Spiking sensor fusion with auxiliary paths: accuracy and cost"
UNSEEN_ROW = "unseen kinds"
TRAINED_FOR_UNSEEN = "n_clean=5 uniform"
FAILING = ("n_clean=8 uniform", "n_clean=5 uniform", "n_clean=1 uniform")
FAILING_ROW = "mean of 8, 5 and 1"
"""Of every seed: does a gate help where sensors fail?"""

_FIXED = ("model.encoder.spiking.learning=fixed", "model.head_widths=[]")
_REWARD = ("model.encoder.spiking.learning=reward_stdp",)
# As few multiply-adds as the spiking networks have operations of both kinds.
_SMALL = (
    *("model.encoder.features=16", "model.encoder.conv_features=[8, 16]"),
    "model.head_widths=[64]",
)
COLUMNS: dict[str, tuple[str, tuple[str, ...], str | None]] = {
    "baseline": ("baseline", (), None),
    "argate_l": ("argate_l", (), None),
    "small_argate_l": ("argate_l", _SMALL, None),
    "spiking_baseline": ("spiking_baseline", (), None),
    "spiking_netgated": ("spiking_netgated", (), None),
    "spiking_argate_plus": ("spiking_argate_plus", (), None),
    "spiking_argate": ("spiking_argate", (), None),
    "spiking_fixed_linear": ("spiking_baseline", _FIXED, None),
    "spiking_reward_stdp": ("spiking_argate", _REWARD, None),
    "spiking_oracle": ("oracle", (), "spiking"),
}
"""Column -> model, changed constants, encoder."""


def _random(dataset: str, n_clean: int) -> dict[str, Any]:
    return {"dataset": dataset, "protocol": "random", "n_clean": n_clean, "kind": "uniform"}


ROWS: dict[str, dict[str, Any]] = {
    TRAINED_FOR_UNSEEN: _random("har", 5),
    "clean": {"dataset": "har", "protocol": "clean"},
    "n_clean=1 uniform": _random("har", 1),
    "n_clean=8 uniform": _random("har", 8),
    "driver n_clean=8 uniform": _random("driver", 8) | {"head": "dense"},
}
"""Row -> options of `train_argate`."""
DRIVER_COLUMNS = ("baseline", "argate_l", "spiking_baseline", "spiking_argate")
PAIRS = (
    ("spiking_argate", "spiking_baseline"),
    ("spiking_argate", "spiking_netgated"),
    ("spiking_argate_plus", "spiking_baseline"),
    ("spiking_argate", "argate_l"),
    ("spiking_argate", "small_argate_l"),
    ("spiking_argate", "spiking_fixed_linear"),
    ("spiking_reward_stdp", "spiking_fixed_linear"),
    ("spiking_oracle", "spiking_argate"),
)
"""Columns that are compared seed by seed."""
METRICS = {
    **dict.fromkeys(("accuracy", "accuracy_clean", "accuracy_corrupted"), "%"),
    **dict.fromkeys(("gate_auroc_pooled", "multiply_adds", "multiply_adds_with_fft"), "1"),
    **dict.fromkeys(("synaptic_operations", "spikes", "parameters"), "1"),
    "energy": "nJ",
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Train and score the columns of the rows."""

    rows: tuple[str, ...] = tuple(ROWS)
    models: tuple[str, ...] = tuple(COLUMNS)
    """Columns of the table."""
    seeds: int = 5
    """Trainings per cell."""
    preset: str = "paper"
    changes: tuple[str, ...] = ()
    """Constants changed in every column, as `--set` of train_argate."""
    validation: bool = False
    """Score on held-out subjects (or rows) instead of the test rows; nothing is recorded."""
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
        for name, given, known in (("rows", self.rows, ROWS), ("models", self.models, COLUMNS)):
            if unknown := sorted(set(given) - set(known)):
                raise ValueError(f"{name}={unknown}: expected some of {list(known)}; see the list")


@dataclasses.dataclass(frozen=True)
class Run:
    """One training."""

    row: str
    model: str
    seed: int

    def path(self, config: Config) -> Path:
        """Where its scores are kept."""
        part = "validation" if config.validation else "test"
        changed = "_".join(config.changes).replace("/", "-") or "preset"
        folder = config.out / part / changed / self.row.replace(" ", "_") / self.model
        return folder / f"{self.seed}.json"


def runs(config: Config) -> list[Run]:
    """All runs that are asked for, whole rows of a seed first."""
    return [
        Run(row, model, seed)
        for seed in range(config.seeds)
        for row in config.rows
        for model in config.models
        if not row.startswith("driver") or model in DRIVER_COLUMNS
    ]


def execute(config: Config, run: Run, dataset: Any) -> dict[str, Any]:
    """Train one network; its scores, its cost and its accuracy under unseen kinds."""
    import jax

    from fusion import evaluate, export
    from fusion.loop import test_output
    from fusion.sizes import count_parameters
    from fusion.spiking.operations import cost, multiply_adds
    from snn_fusion_failure.commands import argate_runs
    from snn_fusion_failure.records.fusion_tables import UNSEEN_KINDS

    model, changes, encoder = COLUMNS[run.model]
    options = argate_runs.Config(
        model=model,
        encoder=encoder,
        preset=config.preset,
        changes=(*changes, *config.changes),
        seed=run.seed,
        **ROWS[run.row],
    )
    settings = argate_runs.build_settings(options, dataset)
    (case,) = argate_runs.build_cases(options, dataset).values()
    fitted, output = argate_runs.train_and_test(settings, dataset, case.noise, run.seed)
    found = argate_runs.scores(output, dataset.n_classes)
    price = cost(settings.model, export(fitted.state.params), dataset.test_x[:1024])
    spiking = settings.model.encoder.series == "spiking"
    fast = None if spiking else sum(multiply_adds(settings.model, fast=True).values())
    record = (
        found
        | price._asdict()
        | {
            "multiply_adds_with_fft": fast,
            "parameters": count_parameters(settings.model)["main"],
            "epochs": settings.train.epochs,
            "train_loss": fitted.history[-1]["total"],
            "train_accuracy": 100.0 * fitted.history[-1]["accuracy"],
        }
    )
    if run.row == TRAINED_FOR_UNSEEN:
        record["unseen"] = {}
        key = jax.random.key(run.seed)
        for kind in UNSEEN_KINDS:
            other = test_output(
                settings.model, fitted.state, dataset, case.noise, key=key, kind=kind
            )
            right = evaluate.accuracy(other.labels, other.logits.argmax(-1))
            record["unseen"][kind] = 100.0 * right
    return record


def load_runs(config: Config) -> dict[tuple[str, str], dict[int, dict[str, Any]]]:
    """(row, column) -> seed -> scores, with the unseen kinds as a row of their own."""
    held: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    for run in runs(config):
        path = run.path(config)
        if not path.exists():
            continue
        record = json.loads(path.read_text(encoding="utf-8"))
        held.setdefault((run.row, run.model), {})[run.seed] = record
        if unseen := record.get("unseen"):
            mean = {"accuracy": sum(unseen.values()) / len(unseen)}
            held.setdefault((UNSEEN_ROW, run.model), {})[run.seed] = mean
    return held


def failing_means(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Every column's accuracy in the mean of the rows with failing sensors, seed by seed."""
    held: dict[str, dict[str, dict[int, float]]] = {}
    for cell in rows:
        if cell["metric"] == "accuracy" and cell["row"] in FAILING:
            held.setdefault(cell["model"], {})[cell["row"]] = values_by_seed(cell)
    found = []
    for model, by_row in held.items():
        common = sorted(set.intersection(*(set(by_row.get(row, {})) for row in FAILING)))
        means = {s: {"accuracy": sum(by_row[r][s] for r in FAILING) / len(FAILING)} for s in common}
        if means:
            cell = {"row": FAILING_ROW, "model": model}
            found += [cell | score for score in column_cells(means, {"accuracy": "%"})]
    return found


def write(config: Config) -> list[dict[str, Any]]:
    """Put the table where it belongs; returns its rows."""
    # A gate is not scored where no sensor fails, nor where there is none.
    rows = [
        {"row": row, "model": model} | cell
        for (row, model), by_seed in load_runs(config).items()
        for cell in column_cells(by_seed, METRICS)
    ]
    if rows and not config.validation:
        path = config.results / f"{NAME}.json"
        rows += failing_means(recorded(path) + rows)
        record_table(
            path,
            NAME,
            TITLE,
            rows,
            preset=config.preset,
            compared=[Compared("accuracy", PAIRS)],
        )
    return rows


def main(config: Config) -> dict[str, Any]:
    """Do the runs that are missing, then write the table."""
    todo = [run for run in runs(config) if not run.path(config).exists()]
    todo = [] if config.collect_only else todo
    if todo:
        enable_compilation_cache()
        from fusion.data import load, validation_split

        loaded = {}
        for name in sorted({ROWS[run.row]["dataset"] for run in todo}):
            data = load(name, config.data_dir)
            loaded[name] = validation_split(data) if config.validation else data
        with progress() as bar:
            task = bar.add_task("runs", total=len(todo), status="")
            for run in todo:
                bar.update(task, status=f"{run.row} {run.model} s{run.seed}")
                found = execute(config, run, loaded[ROWS[run.row]["dataset"]])
                write_json(run.path(config), found)
                write(config)
                bar.advance(task)
    rows = write(config)
    for row in rows:
        if row["metric"] == "accuracy":
            print(f"{row['row']:26} {row['model']:22} {row['mean']:6.2f} % of {row['n']} seeds")
    print_result(study=NAME, runs=len(todo), cells=len(rows))
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
