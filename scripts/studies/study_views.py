"""Does a trained detector use its camera? Cars against look-alikes, by stage, view and failure.

    python scripts/studies/study_views.py --data SIM --runs RUNS/avod_s0 RUNS/avod_argate_s0

SIM is a folder of simulated frames, RUNS/... are run folders of `scripts/train_detector.py train`
or of `scripts/studies/study_detector.py`; runs of one model are seeds. On the validation frames it
asks, given the true boxes, how often a car scores above a body that only its colour tells from a
car: the scores of both stages, with all sensors working and with each failure of `--kinds`, and a
linear reader of the image, of the camera's and of the lidar's features. 0.5 is chance. Prints a
table and writes `results/study_views.json`. Two minutes a run on one core, most of it compiling.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import enable_compilation_cache, fail, print_result, repository

TITLE = "Cars against look-alikes: what a trained detector and its views know"


@dataclasses.dataclass(frozen=True)
class Config:
    """Probe trained detectors."""

    data: Path
    """Folder of simulated frames."""
    runs: tuple[Path, ...]
    """Run folders, each the model of its own options."""
    cache: Path | None = None
    """Where the prepared examples are; DATA/cache_PRESET when left out."""
    split: str = "val"
    kinds: tuple[str, ...] = ("camera_blackout", "lidar_loss")
    """Sensor failures beside the clean frames."""
    results: Path = repository.RESULTS


def probe(config: Config, run: Path) -> tuple[str, dict[tuple[str, str], float]]:
    """The model of one run, and its values by (row, metric)."""
    import jax
    import numpy as np

    from fusion.detection.learning.cache import open_cache
    from fusion.detection.learning.examples import make_inputs
    from fusion.detection.learning.training import SENSOR_FAILURES, fail_sensor
    from fusion.detection.probes import probe_auroc, read_bodies, read_views
    from fusion.evaluate import auroc
    from snn_fusion_failure.commands import detector_runs as runs

    unknown = [kind for kind in config.kinds if kind not in SENSOR_FAILURES]
    if unknown:
        raise ValueError(f"failure {unknown[0]!r}, expected of {', '.join(SENSOR_FAILURES)}")
    trained = runs.run_config(run, runs.Eval(config.data, cache=config.cache))
    cache = open_cache(runs.cache_folder(trained))
    detector, training = runs.build(trained, cache)
    state = runs.load_run(run, detector, training)
    examples = cache.read(config.split)
    tables = config.data / "training" / "visibility"
    bodies = [read_bodies(tables / f"{n}.csv", detector) for n in cache.names(config.split)]
    look = jax.jit(lambda main, stats, x, b: read_views(main, stats, detector, x, b))
    car = np.concatenate([b.car[b.mask] for b in bodies])
    values = {("bodies", "cars"): float(car.sum()), ("bodies", "look_alikes"): float((~car).sum())}
    for kind in (None, *config.kinds):
        make = jax.jit(
            lambda key, e, kind=kind: (
                make_inputs(e, detector) if kind is None else fail_sensor(key, e, detector, kind)
            )
        )
        seen = []
        for i, (example, body) in enumerate(zip(examples, bodies, strict=True)):
            if body.mask.any():
                inputs = make(jax.random.fold_in(jax.random.key(0), i), example)
                reading = look(state.params["main"], state.stats, inputs, body.boxes)
                seen.append([np.asarray(part)[body.mask] for part in reading])
        first, second, pixels, camera, lidar = (
            np.concatenate(part) for part in zip(*seen, strict=True)
        )
        for metric, scores in (("first_stage", first), ("second_stage", second)):
            values[kind or "clean", metric] = auroc(scores[car], scores[~car])
        if kind is None:
            for metric, features in (("image", pixels), ("camera", camera), ("lidar", lidar)):
                values["linear reader", metric] = probe_auroc(features, car)
    return trained.config, values


def main(config: Config) -> dict[str, Any]:
    """Probe the runs, print the table, write the record."""
    from snn_fusion_failure.records import markdown

    enable_compilation_cache()
    held: dict[tuple[str, str, str], list[float]] = {}
    for run in config.runs:
        model, values = probe(config, run)
        for (row, metric), value in values.items():
            if value == value:  # NaN: too few bodies to say
                held.setdefault((row, model, metric), []).append(value)
    if not held:
        raise ValueError("expected --runs, folders of trained detectors")
    rows = [
        {"row": row, "model": model, "metric": metric, "unit": "1"} | summarize(found)
        for (row, model, metric), found in held.items()
    ]
    record_table(config.results / "study_views.json", "study_views", TITLE, rows, preset="all")
    print(markdown.measured(rows))
    fields = {
        f"{row['model']}_{row['row']}": row["mean"]
        for row in rows
        if row["metric"] == "second_stage"
    }
    print_result(rows=len(rows), **fields)
    return {"rows": rows}


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, description=__doc__))
    except (ValueError, FileNotFoundError) as error:
        fail(str(error))
