"""AVOD against AVOD-ARGate: clean frames and every sensor failure, over seeds.

    python scripts/simulate_kitti.py --frames 400 --val 100 --test 100 --size small --out SIM
    python scripts/studies/study_detector.py --data SIM --any-size --seeds 3
    python scripts/studies/study_detector.py --data SIM --any-size --seeds 3 --split test

trains both models on the same frames with the same failures (one sensor fails in two thirds of
them), evaluates them on the validation list with all sensors working and with each failure, and
writes `results/study_detector.json`. Settings are chosen on that list; `--split test` evaluates the
same runs on frames that no choice has seen and writes `results/study_detector_test.json`. (The
numbers of record of both models, with severities, are those of `study_robustness.py`.) Every
training and every evaluation is kept as it comes, so the same command goes on after an
interruption. About 8 CPU-minutes a training and 0.15 CPU-seconds a frame and evaluation (`small`).

    python scripts/studies/study_detector.py --real --data KITTI --cache CACHE --seeds 1 --steps 600

is a check of the whole pipeline on however few real frames are there: train and evaluate on the
training list. It writes `results/study_kitti_real.json`; it is no benchmark.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.commands import detector_options as choices
from snn_fusion_failure.commands import detector_runs as runs
from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import print_result, repository, run_command

MODELS: tuple[choices.Model, ...] = ("avod", "avod_argate")
METRICS = (
    "3d_easy_r40", "3d_moderate_r40", "3d_hard_r40", "bev_moderate_r40", "2d_moderate_r40",
    "3d_moderate_r11", "3d_moderate_r40_iou50", "bev_moderate_r40_iou50", "weight_auroc",
    "weight_camera", "seconds_per_frame",
)  # fmt: skip
# Averaged over the failures as well.
FAILURE_METRICS = (
    "3d_moderate_r40", "bev_moderate_r40", "3d_moderate_r40_iou50", "bev_moderate_r40_iou50",
    "weight_auroc",
)  # fmt: skip
TITLES = {
    "study_detector": "Car detection on simulated frames with one sensor failed",
    "study_kitti_real": "Pipeline check on the real frames at hand (no benchmark)",
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Train and evaluate both detectors."""

    data: Path
    """KITTI folder, simulated or real."""
    cache: Path | None = None
    """Where the prepared examples go; DATA/cache_PRESET when left out."""
    seeds: int = 3
    first_seed: int = 0
    models: tuple[choices.Model, ...] = MODELS
    size: choices.SizeOption = "small"
    steps: int | None = None
    failures: bool = True
    """Sensors fail in training as well, for both models alike."""
    kinds: tuple[str, ...] = ()
    """Failures to evaluate; all when left out."""
    split: Literal["val", "test"] = "val"
    """Frames to evaluate: `val` to choose settings, `test` for the numbers of record."""
    severity: float = 1.0
    overlap: float = 0.7
    """Least overlap of a hit; at 0.5 on the ground and in 3D all are scored as well."""
    real: bool = False
    """Pipeline check: train clean and evaluate on the training list, no failures."""
    any_size: bool = False
    """Accept images of other sizes than the benchmark's (simulated frames)."""
    changes: choices.Changes = ()
    """Constants of all runs, `detector.path_drop=0` `params.gate.tau=0.2`."""
    learning_rate: float | None = None
    path_drop: float | None = None
    """As `--set detector.path_drop=...`."""
    out: Path = Path("runs/study_detector")
    """Folder of the runs."""
    results: Path = repository.RESULTS
    name: str | None = None
    """Of the table; study_detector or study_kitti_real when left out. `_test` is added to tables of
    the test frames."""
    collect_only: bool = False


def evaluations(config: Config) -> list[tuple[str, int, str | None]]:
    """(model, seed, failure) of everything to evaluate, whole seeds first."""
    from fusion.detection.learning.training import SENSOR_FAILURES

    unknown = [kind for kind in config.kinds if kind not in SENSOR_FAILURES]
    if unknown:
        raise ValueError(f"kinds={unknown[0]!r}: expected of {', '.join(SENSOR_FAILURES)}")
    kinds: tuple[str | None, ...] = (None, *(config.kinds or SENSOR_FAILURES))
    if config.real:
        kinds = (None,)
    seeds = range(config.first_seed, config.first_seed + config.seeds)
    return [(model, seed, kind) for seed in seeds for model in config.models for kind in kinds]


def _run_path(config: Config, model: str, seed: int) -> Path:
    return config.out / f"{_table(config)}_{config.size}" / f"{model}_s{seed}"


def _table(config: Config) -> str:
    return config.name or ("study_kitti_real" if config.real else "study_detector")


def _record(config: Config, model: str, seed: int, failure: str | None) -> Path:
    split = "test_" if _split(config) == "test" else ""
    return _run_path(config, model, seed) / f"eval_{split}{failure or 'clean'}" / "result.json"


def _split(config: Config) -> str:
    return "train" if config.real else config.split


def _prepare(config: Config) -> None:
    """Write the cache, or what it lacks of the list to evaluate."""
    from fusion.detection.learning.cache import open_cache
    from snn_fusion_failure.commands import train_detector as command

    prepared = choices.Prepare(config.data, config.size, config.cache, any_size=config.any_size)
    folder = runs.cache_folder(prepared)
    if not (folder / "cache.json").exists():
        command.prepare(prepared)
    split = _split(config)
    if split not in open_cache(folder).splits:
        command.prepare(dataclasses.replace(prepared, splits=(split,), add=True))


def execute(config: Config) -> int:
    """Do what is missing; returns the number of evaluations done."""
    from fusion.detection.learning.cache import open_cache
    from snn_fusion_failure.commands import train_detector as command

    _prepare(config)
    split, done = _split(config), 0
    checked: set[Path] = set()
    changes = config.changes
    if config.path_drop is not None:
        changes = (*changes, f"detector.path_drop={config.path_drop}")
    for model, seed, failure in evaluations(config):
        record, run = _record(config, model, seed, failure), _run_path(config, model, seed)
        options = choices.Train(
            config.data, model, config.size, config.cache, seed=seed, steps=config.steps,  # type: ignore[arg-type]
            failures=config.failures and not config.real, changes=changes,
            learning_rate=config.learning_rate, out=run,
            resume=(run / "config.json").exists(),
        )  # fmt: skip
        if run not in checked:
            cache = open_cache(runs.cache_folder(options))
            runs.check_settings(run, runs.build(options, cache))
            checked.add(run)
        if record.exists():
            continue
        if not (run / "result.json").exists():
            print(f"train {model} seed {seed}", flush=True)
            command.train(options)
        result = command.evaluate(
            choices.Eval(
                config.data, model, config.size, config.cache, split=split, seed=seed, run=run,  # type: ignore[arg-type]
                failure=failure, severity=config.severity, overlap=config.overlap,
                pictures=2 if failure is None else 0, out=record.parent,
            )
        )  # fmt: skip
        print(
            f"{model} seed {seed} {failure or 'clean'}: 3D moderate "
            f"{result['3d_moderate_r40']:.2f}",
            flush=True,
        )
        done += 1
    return done


def _unit(metric: str) -> str:
    if metric == "seconds_per_frame":
        return "s"
    return "1" if metric.startswith("weight") or "loss" in metric else "%"


def collect(config: Config) -> list[dict[str, Any]]:
    """Rows of the study in the schema of record."""
    held: dict[tuple[str, str], list[dict[str, Any]]] = {}
    trained: dict[str, list[dict[str, Any]]] = {}
    for model, seed, failure in evaluations(config):
        path = _record(config, model, seed, failure)
        if path.exists():
            record = json.loads(path.read_text(encoding="utf-8"))
            held.setdefault((failure or "clean", model), []).append(record)
            if failure is None:
                text = (_run_path(config, model, seed) / "result.json").read_text("utf-8")
                trained.setdefault(model, []).append(json.loads(text))
    rows = []

    def add(row: str, model: str, metric: str, values: list[Any]) -> None:
        if values and all(isinstance(v, int | float) for v in values):
            cell = {"row": row, "model": model, "metric": metric, "unit": _unit(metric)}
            cell["split"] = "train" if row == "training" else _split(config)
            rows.append(cell | summarize(values))

    for (row, model), records in held.items():
        for metric in METRICS:
            add(row, model, metric, [record.get(metric) for record in records])
    # The mean over failures, of seeds for which every failure was evaluated.
    for model in config.models:
        failing = [records for (row, m), records in held.items() if m == model and row != "clean"]
        if failing and len({len(records) for records in failing}) == 1:
            for metric in FAILURE_METRICS:
                columns = [[r.get(metric) for r in records] for records in failing]
                if all(isinstance(v, int | float) for column in columns for v in column):
                    means = [sum(c) / len(c) for c in zip(*columns, strict=True)]
                    add("mean of failures", model, metric, means)
    for model, records in trained.items():
        add("training", model, "first_loss", [r["first_loss"] for r in records])
        add("training", model, "loss", [r["loss"] for r in records])
    return rows


def main(config: Config) -> dict[str, Any]:
    """Do the runs that are missing, then write the table."""
    done = 0 if config.collect_only else execute(config)
    rows = collect(config)
    table = _table(config)
    if rows:
        title = TITLES.get(table, TITLES["study_detector"])
        if _split(config) == "test":
            table, title = f"{table}_test", f"{title}: test frames"
        record_table(config.results / f"{table}.json", table, title, rows, preset=config.size)
    fields = {
        f"{row['model']}_{row['row'].replace(' ', '_')}": row["mean"]
        for row in rows
        if row["metric"] == "3d_moderate_r40" and row["row"] in ("clean", "mean of failures")
    }
    print_result(evaluations=done, rows=len(rows), **fields)
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
