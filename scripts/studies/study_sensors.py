"""Studies beside Tables 3.1 to 3.6: other splits, signals, failures on known readings, mixtures.

    python scripts/studies/study_sensors.py --study driver_heads
    python scripts/studies/study_sensors.py --study driver_trip
    python scripts/studies/study_sensors.py --study driver_tagged
    python scripts/studies/study_sensors.py --study known_readings
    python scripts/studies/study_sensors.py --study kept_out_kinds --seeds 2
    python scripts/studies/study_sensors.py --study gate_targets

`driver_heads` has the driver's neighbourhood head and the signals of the default set;
`driver_trip` holds out whole trips; `driver_tagged` has the earlier stand-ins, one of which names
trips; `known_readings` lets sensors fail on values that they give when they work, with and without
the feature that tells known readings; `kept_out_kinds` trains HAR on all kinds of failure but one
and tests on that one; `gate_targets` compares what the gate can learn from. Each training is kept
as it comes in `runs/study_sensors`, so the same command goes on after an interruption. Writes
`results/study_NAME.json`; `above_equal_weights` in it is a difference seed by seed.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    print_result,
    progress,
    repository,
    run_command,
    write_json,
)

KINDS = ("uniform", "gaussian", "zero", "stuck", "drift", "dropout", "gain", "clip")


@dataclasses.dataclass(frozen=True)
class Case:
    """One row: options of `train_argate`, the kind in test where it is another, the columns."""

    name: str
    options: dict[str, Any]
    models: tuple[str, ...]
    test_kind: str | None = None


def _driver(name: str, n_clean: int, models: tuple[str, ...], **options: Any) -> Case:
    given = {"dataset": "driver", "protocol": "random", "n_clean": n_clean, **options}
    return Case(name, given, models)


_HEAD = ("equal_weights", "argate_plus", "forest_ceiling")
_ALL = (
    *("equal_weights", "netgated", "argate_plus", "argate_l", "argate_plus_printed"),
    *("argate_l_printed", "oracle", "forest_ceiling", "nearest_rows", "linear_fit"),
)
_GATES = {
    "as in the preset": (),
    "kl": ("model.loss.imitation=kl",),
    "held out": ("model.loss.target_training=held_out",),
    "kl, held out": ("model.loss.imitation=kl", "model.loss.target_training=held_out"),
    "masks": ("model.loss.mask_supervision=true",),
}


def _without_flag(n_clean: int, kind: str) -> list[Case]:
    changes = ("model.encoder.known_readings=false",)
    return [
        _driver(f"n_clean={n_clean} {kind}", n_clean, _HEAD[:2], kind=kind),
        _driver(
            f"n_clean={n_clean} {kind}, feature off", n_clean, _HEAD[:2], kind=kind, changes=changes
        ),
    ]


STUDIES: dict[str, tuple[str, list[Case]]] = {
    "driver_heads": (
        "Driver identification without a signal that names trips, neighbourhood head, accuracy %",
        [_driver(f"n_clean={n} uniform", n, _ALL) for n in (12, 8, 5)]
        + [_driver(f"n_clean={n} gaussian", n, _ALL[:-3], kind="gaussian") for n in (12, 8, 5)],
    ),
    "driver_trip": (
        "Driver identification, whole trips held out, accuracy %",
        [_driver(f"n_clean={n} uniform", n, _HEAD, split="trip") for n in (12, 8, 5)],
    ),
    "driver_tagged": (
        "Driver identification with a signal that names trips, accuracy %",
        [_driver(f"n_clean={n} uniform", n, _HEAD, features="tagged") for n in (12, 8, 5)],
    ),
    "known_readings": (
        "Driver identification, failed sensors that go on sending known readings, accuracy %",
        [case for kind in ("uniform", "stuck", "zero") for case in _without_flag(8, kind)],
    ),
    "kept_out_kinds": (
        "HAR trained on all kinds of failure but the one of the test, n_clean=5, accuracy %",
        [
            Case(
                kept,
                {"dataset": "har", "protocol": "random", "n_clean": 5}
                | {"kind": ",".join(k for k in KINDS if k != kept)},
                ("baseline", "argate_plus"),
                kept,
            )
            for kept in KINDS
        ],
    ),
    "gate_targets": (
        "What the gate of ARGate-L learns from, HAR, validation subjects, accuracy %",
        [
            Case(
                name,
                {"dataset": "har", "protocol": "random", "n_clean": 5, "validation": True}
                | {"changes": changes},
                ("argate_l",),
            )
            for name, changes in _GATES.items()
        ],
    ),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Run one of the studies."""

    study: str = "driver_trip"
    """driver_heads, driver_trip, driver_tagged, known_readings, kept_out_kinds or gate_targets."""
    preset: str = "paper"
    seeds: int = 5
    """Trainings per cell."""
    models: tuple[str, ...] = ()
    """Only these columns."""
    rows: tuple[str, ...] = ()
    """Only these rows."""
    data_dir: Path | None = None
    """Folder of the data sets; $FUSION_DATA_DIR and the user cache are searched next."""
    out: Path = Path("runs/study_sensors")
    """Folder of the single runs."""
    results: Path = repository.RESULTS
    """Where the table goes."""
    collect_only: bool = False
    """Train nothing; rebuild the table from the runs that are there."""


@dataclasses.dataclass(frozen=True)
class Run:
    """One training, or one ceiling."""

    study: str
    case: Case
    model: str
    seed: int

    def path(self, out: Path) -> Path:
        """Where its scores are kept."""
        name = self.case.name.replace(" ", "_").replace(",", "")
        return out / self.study / name / self.model / f"{self.seed}.json"


def runs(config: Config) -> list[Run]:
    """All runs of the study, whole seeds first.

    Raises:
        ValueError: an unknown study, row or column.
    """
    if config.study not in STUDIES:
        raise ValueError(f"study={config.study!r}: expected one of {', '.join(STUDIES)}")
    _, cases = STUDIES[config.study]
    for name, given, known in (
        ("rows", config.rows, [c.name for c in cases]),
        ("models", config.models, [m for c in cases for m in c.models]),
    ):
        if unknown := sorted(set(given) - set(known)):
            raise ValueError(f"{name}={unknown}: expected some of {list(dict.fromkeys(known))}")
    return [
        Run(config.study, case, model, seed)
        for seed in range(config.seeds)
        for case in cases
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

    forest = run.model in CEILINGS
    options = RunConfig(
        model="argate_plus" if forest else run.model,
        preset=preset,
        seed=run.seed,
        **run.case.options,
    )
    (case,) = build_cases(options, dataset).values()
    if forest:
        return score(run.model, dataset, case.noise, run.seed)
    noise = dataclasses.replace(case.noise, test_kind=run.case.test_kind)
    settings = build_settings(options, dataset)
    fitted, output = train_and_test(settings, dataset, noise, run.seed)
    found = scores(output, dataset.n_classes)
    return found | {"epochs": settings.train.epochs, "train_loss": fitted.history[-1]["total"]}


def collect(config: Config) -> list[dict[str, Any]]:
    """Rows of the study in the schema of record, from the runs on disk."""
    from snn_fusion_failure.records.fusion_tables import METRICS

    held: dict[tuple[str, str], dict[int, dict[str, Any]]] = {}
    for run in runs(config):
        path = run.path(config.out)
        if path.exists():
            record = json.loads(path.read_text(encoding="utf-8"))
            held.setdefault((run.case.name, run.model), {})[run.seed] = record
    rows = []
    for (name, model), by_seed in held.items():
        equal = held.get((name, "equal_weights"), {})
        if model not in ("equal_weights", "forest_ceiling", "nearest_rows", "linear_fit"):
            for seed in set(equal) & set(by_seed):
                gain = by_seed[seed]["accuracy"] - equal[seed]["accuracy"]
                by_seed[seed]["above_equal_weights"] = gain
        records = list(by_seed.values())
        for metric in (*METRICS, "above_equal_weights"):
            values = [r[metric] for r in records if r.get(metric) is not None]
            if not values or (metric in METRICS and len(values) < len(records)):
                continue
            unit = "1" if metric.startswith("gate") else "%"
            cell = {"row": name, "model": model, "metric": metric, "unit": unit}
            rows.append(cell | summarize(values))
    return rows


def load_for(case: Case, data_dir: Path | None) -> Any:
    """The data set of a row."""
    from fusion.data import load, validation_split

    options = case.options
    dataset = load(
        options["dataset"],
        data_dir,
        split=options.get("split"),
        features=options.get("features"),
    )
    return validation_split(dataset) if options.get("validation") else dataset


def main(config: Config) -> dict[str, Any]:
    """Do the runs that are missing, then write the table."""
    todo = [run for run in runs(config) if not run.path(config.out).exists()]
    todo = [] if config.collect_only else todo
    title, cases = STUDIES[config.study]
    if todo:
        enable_compilation_cache()
        # All rows of a study have one data set.
        dataset = load_for(cases[0], config.data_dir)
        with progress() as bar:
            task = bar.add_task("runs", total=len(todo), status="")
            for run in todo:
                bar.update(task, status=f"{run.case.name} {run.model} s{run.seed}")
                write_json(run.path(config.out), execute(run, dataset, config.preset))
                bar.advance(task)
    rows = collect(config)
    if rows:
        name = f"study_{config.study}"
        record_table(config.results / f"{name}.json", name, title, rows, preset=config.preset)
    print_result(study=config.study, runs=len(todo), cells=len(rows))
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
