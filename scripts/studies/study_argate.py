"""The validation study behind the presets: one setting changed at a time, never on the test set.

    python scripts/studies/study_argate.py --data-dir DIR

Every variant is the preset with one setting changed, trained on the training rows without the
validation split (HAR: four held-out subjects) and scored on that split. 24 runs of about 15 s each
on one CPU core; each is kept as it comes, so the same command goes on after an interruption. Writes
`results/study_argate.json`; `python scripts/studies/render_results.py` makes a table of it. One
seed tells large effects only: use `--seeds 5` for small ones.
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

TITLE = "Settings of ARGate on validation rows: the preset with one setting changed, accuracy %"

# Equation 3.1 as printed: normalizer, loss weighting, no anchor; noise drawn once.
LITERAL: dict[str, Any] = {
    "normalizer": "softmax_sigmoid",
    "fixed_targets": "softmax_sigmoid",
    "uniform_floor": 0.0,
    "anchor": 0.0,
    "redraw": False,
}
_BOTH: tuple[dict[str, Any], ...] = (
    {},
    {"normalizer": "softmax_sigmoid", "fixed_targets": "softmax_sigmoid"},
    {"uniform_floor": 0.0},
    {"uniform_floor": 0.5},
    {"beta": 0.3},
    {"beta": 3.0},
    {"scale": "max"},
    LITERAL,
)
N_CLEAN = {"har": 1, "driver": 5, "simulated": 1}
GRID: dict[str, tuple[dict[str, Any], ...]] = {
    "baseline": ({}, {"redraw": False}),
    "argate_ws": ({},),
    "argate_plus": _BOTH,
    "argate_l": (
        *_BOTH,
        {"tau": 0.25},
        {"tau": 1.0},
        {"anchor": 0.0},
        {"redraw": False},
        {"weight_sharing": False},
    ),
}
"""Model -> changed settings; an empty change is the preset itself."""

# Where each setting lives.
_MODEL = ("normalizer", "scale", "weight_sharing")
_TERMS = ("uniform_floor", "fixed_targets")
_LOSS = ("beta", "tau", "anchor")


@dataclasses.dataclass(frozen=True)
class Config:
    """Compare settings of ARGate on validation rows."""

    datasets: tuple[str, ...] = ("har",)
    """har (one clean channel, uniform noise) and driver (five clean)."""
    models: tuple[str, ...] = ()
    """Only these models; all of the grid when left out."""
    preset: str = "paper"
    seeds: int = 1
    """Trainings per variant."""
    data_dir: Path | None = None
    """Folder of the data sets; $FUSION_DATA_DIR and the user cache are searched next."""
    out: Path = Path("runs/study_argate")
    """Folder of the single runs."""
    results: Path = repository.RESULTS
    """Where the table goes."""
    collect_only: bool = False
    """Train nothing; rebuild the table from the runs that are there."""


@dataclasses.dataclass(frozen=True)
class Variant:
    """One training: data set, model, changed settings, seed."""

    dataset: str
    model: str
    changes: tuple[tuple[str, Any], ...]
    seed: int

    @property
    def name(self) -> str:
        """The changes in words, as the table shows them."""
        if dict(self.changes) == LITERAL:
            return "as printed, noise drawn once"
        return ", ".join(f"{k}={v}" for k, v in self.changes) or "preset"

    def path(self, out: Path) -> Path:
        """Where its scores are kept."""
        folder = "_".join(f"{k}={v}" for k, v in self.changes) or "preset"
        return out / self.dataset / self.model / folder / f"{self.seed}.json"


def variants(config: Config) -> list[Variant]:
    """All trainings of the study, whole seeds first.

    Raises:
        ValueError: a model that is not in the grid.
    """
    unknown = [m for m in config.models if m not in GRID]
    if unknown:
        raise ValueError(
            f"models={unknown}: expected some of {', '.join(GRID)}; leave the others out"
        )
    return [
        Variant(dataset, model, tuple(changes.items()), seed)
        for seed in range(config.seeds)
        for dataset in config.datasets
        for model, grid in GRID.items()
        if not config.models or model in config.models
        for changes in grid
    ]


def change(settings: Any, corruption: Any, changes: dict[str, Any]) -> tuple[Any, Any]:
    """Preset and corruption with the changes of a variant applied.

    Raises:
        ValueError: a setting that the study does not know.
    """

    def chosen(names: tuple[str, ...]) -> dict[str, Any]:
        return {k: v for k, v in changes.items() if k in names}

    unknown = sorted(set(changes) - {*_MODEL, *_TERMS, *_LOSS, "redraw"})
    if unknown:
        known = ", ".join((*_MODEL, *_TERMS, *_LOSS, "redraw"))
        raise ValueError(f"changes={unknown}: expected some of {known}; leave the others out")
    hyper = settings.hyper
    loss = dataclasses.replace(settings.model.recipe.loss, **chosen(_TERMS))
    settings = settings._replace(
        model=dataclasses.replace(settings.model, loss=loss, **chosen(_MODEL)),
        hyper=hyper._replace(loss=hyper.loss._replace(**chosen(_LOSS))),
    )
    return settings, dataclasses.replace(corruption, **chosen(("redraw",)))


def options(variant: Variant, preset: str) -> Any:
    """The options of `train_argate` that a variant changes."""
    from snn_fusion_failure.commands.argate_runs import Config as RunConfig

    return RunConfig(
        dataset=variant.dataset,
        model=variant.model,
        preset=preset,
        protocol="random",
        n_clean=N_CLEAN[variant.dataset],
        seed=variant.seed,
    )


def execute(variant: Variant, dataset: Any, preset: str) -> dict[str, Any]:
    """Train one variant on the rows that are not held out and score it on those that are."""
    from fusion.sizes import count_parameters
    from snn_fusion_failure.commands.argate_runs import (
        build_cases,
        build_settings,
        scores,
        train_and_test,
    )

    base = options(variant, preset)
    (case,) = build_cases(base, dataset).values()
    settings, noise = change(build_settings(base, dataset), case.noise, dict(variant.changes))
    fitted, output = train_and_test(settings, dataset, noise, variant.seed)
    return scores(output, dataset.n_classes) | {
        "parameters": count_parameters(settings.model),
        "rows": "validation",
        "settings": dict(variant.changes),
        "train_loss": fitted.history[-1]["total"],
    }


def collect(config: Config) -> list[dict[str, Any]]:
    """Rows of the study in the schema of record, from the runs on disk."""
    from snn_fusion_failure.records.fusion_tables import METRICS

    held: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for variant in variants(config):
        path = variant.path(config.out)
        if path.exists():
            record = json.loads(path.read_text(encoding="utf-8"))
            held.setdefault((f"{variant.dataset}: {variant.name}", variant.model), []).append(
                record
            )
    rows = []
    for (row, model), records in held.items():
        for metric in METRICS:
            values = [record[metric] for record in records]
            if any(value is None for value in values):
                continue
            unit = "%" if metric.startswith("accuracy") else "1"
            cell = {"row": row, "model": model, "metric": metric, "unit": unit}
            rows.append(cell | summarize(values))
    return rows


def main(config: Config) -> dict[str, Any]:
    """Do the runs that are missing, then write the table."""
    todo = [v for v in variants(config) if not v.path(config.out).exists()]
    todo = [] if config.collect_only else todo
    if todo:
        enable_compilation_cache()
        from fusion.data import load, validation_split

        loaded = {name: load(name, config.data_dir) for name in config.datasets}
        held_out = {name: validation_split(dataset) for name, dataset in loaded.items()}
        with progress() as bar:
            task = bar.add_task("runs", total=len(todo), status="")
            for variant in todo:
                bar.update(task, status=f"{variant.model} {variant.name}")
                record = execute(variant, held_out[variant.dataset], config.preset)
                write_json(variant.path(config.out), record)
                bar.advance(task)
    rows = collect(config)
    if rows:
        path = config.results / "study_argate.json"
        record_table(path, "study_argate", TITLE, rows, preset=config.preset)
    accuracy = [row for row in rows if row["metric"] == "accuracy"]
    best = max(accuracy, key=lambda row: row["mean"], default=None)
    fields = {} if best is None else {"best": f"{best['model']}({best['row']})"}
    print_result(runs=len(todo), variants=len(accuracy), **fields)
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
