"""Detectors under every sensor failure and severity, kinds that training never saw, and a bound.

    python scripts/simulate_kitti.py --layouts KITTI/training/label_2 --frames 2400 --val 100 \
        --test 100 --size small --out SIM
    python scripts/studies/study_robustness.py --data SIM --any-size --seeds 3 --split test
    python scripts/studies/study_robustness.py --data SIM --any-size --seeds 3 --split test \
        --fold seed
    python scripts/studies/study_robustness.py --data SIM --any-size --seeds 5 --split test \
        --fold all --models dense
    python scripts/studies/study_robustness.py --data SIM --any-size --seeds 3 --split test \
        --models avod avod_argate --levels 1 3 5

trains every model on the same frames with the same failures (one sensor fails in two thirds of
them), measures 3D moderate R40 with all sensors working and in every cell of failure and severity,
and writes `results/study_robustness.json` (`_val` is added to tables of validation frames, on
which settings are chosen), with paired differences of clean frames and means seed by seed, p values
corrected over all of them. Without `--steps` a model has its preset's, 2,000 (`avod`) and 6,000
(`dense`) at `small`. Only rows of `--models` are written, all others stay as they are in the table;
where the cells of `dense` are not in `--out`, the corruption error is taken against its rows there.

`dense_oracle` is told which sensor fails and how severely: no gate of this network can know more.
`camera_only` and `lidar_only` are the trained `dense` with the fusion weights fixed at (1, 0) and
(0, 1), which path drop in training prepares it for.

`--fold` leaves a third of the failures out of the training (0, 1, 2, or `seed` for the seed modulo
three): the row `unseen kinds` is their mean, `seen kinds (folds)` that of the others. With `all` no
sensor fails in training, and rows end in `(none seen)`. `best_of_both` is the better of `dense`,
`camera_only` and `lidar_only` in each cell, chosen afterwards: no switch between them has more.
Every training and every cell is kept as it comes, seeds whole first, so the same command goes on
after an interruption; `--collect-only` writes the table of what is there. Prints `result: ...`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.commands import detector_options as choices
from snn_fusion_failure.commands import detector_runs as runs
from snn_fusion_failure.commands.detector_cells import (
    METRIC,
    Cell,
    measure_cells,
    read_cells,
    read_frames,
    recorded_cells,
)
from snn_fusion_failure.commands.detector_rows import METRICS, best_of, fold_rows
from snn_fusion_failure.records.detector_folds import FOLDS, Fold, unseen_kinds
from snn_fusion_failure.records.rows import Compared, column_cells, record_table
from snn_fusion_failure.runs import print_result, repository, run_command

MODELS: tuple[choices.Model, ...] = (
    "dense", "dense_argate", "dense_oracle", "avod", "avod_argate",
)  # fmt: skip
BASELINE: choices.Model = "dense"
SINGLE = {"camera_only": (1.0, 0.0), "lidar_only": (0.0, 1.0)}
"""Detectors of one sensor, made from the trained baseline by fixed fusion weights."""
BOUND = "best_of_both"
"""The better of `dense` and its single sensors in each cell, chosen afterwards."""
FoldOption = Literal["none", "0", "1", "2", "seed", "all"]
GROUPS = (
    "clean", "seen kinds", "misaligned", "clean (folds)", "seen kinds (folds)", "unseen kinds",
    "clean (none seen)", "unseen kinds (none seen)",
)  # fmt: skip
"""Rows that are compared seed by seed; single cells are too many to tell anything of each."""
PAIRS = (
    ("dense_argate", "dense"), ("dense_oracle", "dense"), ("dense_oracle", "dense_argate"),
    ("dense", "lidar_only"), (BOUND, "dense"), ("avod_argate", "avod"),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Config:
    """Train and evaluate detectors under failures."""

    data: Path
    """KITTI folder, simulated or real."""
    cache: Path | None = None
    """Where the prepared examples go; DATA/cache_SIZE when left out."""
    seeds: int = 3
    first_seed: int = 0
    models: tuple[choices.Model, ...] = MODELS
    size: choices.SizeOption = "small"
    steps: int | None = None
    """Of all models; each its preset's when left out."""
    levels: tuple[int, ...] = (1, 2, 3, 4, 5)
    """Severities in fifths."""
    kinds: tuple[str, ...] = ()
    """Failures to evaluate; all when left out."""
    fold: FoldOption = "none"
    """Group of failures that training does not see; `all`: no sensor fails in training."""
    train_split: str = "train"
    """List to train on, a shorter one to see what few frames do; with a `--name` of its own."""
    split: Literal["val", "test"] = "val"
    """Frames to evaluate: `val` to choose settings, `test` for the numbers of record."""
    overlap: float | None = None
    """Least overlap of a hit; the benchmark's when left out."""
    any_size: bool = False
    """Accept images of other sizes than the benchmark's (simulated frames)."""
    changes: choices.Changes = ()
    """Constants of all trainings, `detector.path_drop=0` `params.gate.tau=0.2`."""
    out: Path = Path("runs/study_robustness")
    """Folder of the trainings."""
    results: Path = repository.RESULTS
    name: str = "study_robustness"
    """Of the table."""
    collect_only: bool = False


@dataclasses.dataclass(frozen=True)
class Training:
    """One training of the study: a model, a seed, and the fold whose kinds it does not see."""

    model: choices.Model
    seed: int
    fold: Fold

    def folder(self, config: Config) -> Path:
        """Where it is kept."""
        fold = "" if self.fold is None else f"_fold{self.fold}"
        return config.out / config.size / f"{self.model}{fold}_s{self.seed}"

    @property
    def unseen(self) -> tuple[str, ...]:
        """Kinds left out of the training."""
        return unseen_kinds(self.fold)


def trainings(config: Config) -> list[Training]:
    """What a command line trains, whole seeds first."""

    def fold(seed: int) -> Fold:
        if config.fold in ("none", "all"):
            return None if config.fold == "none" else "all"
        return seed % len(FOLDS) if config.fold == "seed" else int(config.fold)

    seeds = range(config.first_seed, config.first_seed + config.seeds)
    return [Training(model, seed, fold(seed)) for seed in seeds for model in config.models]


def cells(config: Config) -> list[Cell]:
    """The clean cell, then every failure at every severity.

    Raises:
        ValueError: an unknown failure, or a severity that is not 1 to 5.
    """
    from fusion.detection.learning.training import FAILURES

    unknown = [kind for kind in config.kinds if kind not in FAILURES]
    if unknown:
        raise ValueError(f"kinds={unknown[0]!r}: expected of {', '.join(FAILURES)}")
    if not config.levels or not all(1 <= level <= 5 for level in config.levels):
        raise ValueError(f"levels={config.levels}: expected severities from 1 to 5")
    kinds = config.kinds or FAILURES
    return [Cell(), *(Cell(kind, level) for kind in kinds for level in config.levels)]


def _options(config: Config, training: Training) -> choices.Train:
    from fusion.detection.learning.training import SENSOR_FAILURES

    run = training.folder(config)
    seen = tuple(kind for kind in SENSOR_FAILURES if kind not in training.unseen)
    return choices.Train(
        config.data, training.model, config.size, config.cache, seed=training.seed,
        steps=config.steps, split=config.train_split, failures=training.fold != "all",
        failure_kinds=seen if training.unseen and seen else (),
        changes=config.changes, out=run, resume=(run / "config.json").exists(),
    )  # fmt: skip


def _variants(config: Config, training: Training) -> Iterator[tuple[str, dict[str, Any], Path]]:
    """Detectors that one training gives: name, changes of its settings, folder of cells."""
    folder = training.folder(config)
    yield training.model, {}, folder / f"cells_{config.split}"
    if training.model == BASELINE:
        for name, weights in SINGLE.items():
            yield name, {"fixed_weights": weights}, folder / f"cells_{config.split}_{name}"


def execute(config: Config) -> int:
    """Do what is missing; returns the number of cells measured."""
    from fusion.detection.learning.cache import open_cache
    from snn_fusion_failure.commands import train_detector as command

    prepared = choices.Prepare(config.data, config.size, config.cache, any_size=config.any_size)
    folder = runs.cache_folder(prepared)
    if not (folder / "cache.json").exists():
        command.prepare(prepared)
    for split in (config.train_split, config.split):
        if split not in open_cache(folder).splits:
            command.prepare(dataclasses.replace(prepared, splits=(split,), add=True))
    cache = open_cache(folder)
    frames = read_frames(config.data, cache, config.split)
    wanted, done = cells(config), 0
    for training in trainings(config):
        options = _options(config, training)
        setup, run = runs.build(options, cache), training.folder(config)
        runs.check_settings(run, setup)
        if not (run / "result.json").exists():
            print(f"train {run.name}", flush=True)
            command.train(options)
        state = runs.load_run(run, setup)
        for name, changes, kept in _variants(config, training):
            detector = dataclasses.replace(setup.config, **changes)
            measured = measure_cells(
                detector, state, frames, wanted, kept, overlap=config.overlap, seed=training.seed
            )
            done += measured
            if measured:
                found = read_cells(kept, [Cell()])
                assert found is not None
                print(f"{run.name}, {name}: clean {found[Cell()][METRIC]:.2f}", flush=True)
    return done


def _table(config: Config) -> Path:
    name = config.name if config.split == "test" else f"{config.name}_val"
    return config.results / f"{name}.json"


def scores(config: Config) -> dict[tuple[str, str], dict[int, dict[str, float]]]:
    """(row, model) -> seed -> metric -> value, of the trainings whose cells are complete.

    Where a seed was trained with several folds, its value is their mean.
    """
    from fusion.detection.sensors import MISALIGNMENTS

    wanted = cells(config)
    held: dict[tuple[str, str], dict[int, list[dict[str, float]]]] = {}
    seeds = range(config.first_seed, config.first_seed + config.seeds)
    folds: tuple[Fold, ...] = (None, *range(len(FOLDS)), "all")
    for seed, fold in itertools.product(seeds, folds):
        baseline = Training(BASELINE, seed, fold).folder(config) / f"cells_{config.split}"
        base = read_cells(baseline, wanted)
        if base is None and fold is None:
            base = recorded_cells(_table(config), BASELINE, seed, wanted)
        # Models of another command keep their rows and the command that made them.
        for model in config.models:
            training = Training(model, seed, fold)
            found = {n: read_cells(kept, wanted) for n, _, kept in _variants(config, training)}
            whole = {name: scores for name, scores in found.items() if scores}
            if model == BASELINE and len(whole) == len(found):
                whole[BOUND] = best_of(list(whole.values()))
            for name, measured in whole.items():
                for row, values in fold_rows(fold, measured, base, MISALIGNMENTS).items():
                    held.setdefault((row, name), {}).setdefault(seed, []).append(values)
    return {
        key: {
            seed: {m: sum(v[m] for v in parts) / len(parts) for m in parts[0]}
            for seed, parts in by_seed.items()
        }
        for key, by_seed in held.items()
    }


def collect(config: Config) -> list[dict[str, Any]]:
    """Rows of the table of record."""
    units = dict.fromkeys((*METRICS, "mra", "mce"), "1") | {METRIC: "%"}
    return [
        {"row": row, "model": model, "split": config.split} | cell
        for (row, model), by_seed in scores(config).items()
        for cell in column_cells(by_seed, units)
    ]


def main(config: Config) -> dict[str, Any]:
    """Do the trainings and cells that are missing, then write the tables."""
    done = 0 if config.collect_only else execute(config)
    rows = collect(config)
    if rows:
        title = f"Car detection by sensor failure and severity ({config.split} frames)"
        table = _table(config)
        record_table(
            table, table.stem, title, rows, preset=config.size,
            compared=[Compared(METRIC, PAIRS, rows=GROUPS)],
        )  # fmt: skip
    fields = {
        f"{row['model']}_{row['row'].replace(' ', '_')}": row["mean"]
        for row in rows
        if row["metric"] == METRIC and row["row"] in ("clean", "seen kinds", "unseen kinds")
    }
    print_result(cells=done, rows=len(rows), **fields)
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
