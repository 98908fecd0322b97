"""Does a trained detector use its camera? Cars against look-alikes, by stage, view and failure.

    python scripts/studies/study_views.py --data SIM --runs RUNS/avod_s0 RUNS/avod_argate_s0

SIM is a folder of simulated frames, RUNS/... are run folders of `scripts/train_detector.py train`
or of `scripts/studies/study_detector.py`; runs of one model are seeds. On the validation frames it
asks, given the true boxes, how often a car scores above a body that only its colour tells from a
car: the scores of both stages, with all sensors working and with each failure of `--kinds`, and a
linear reader of the image, of the camera's and of the lidar's features. 0.5 is chance. Prints a
table and writes `results/study_views.json`. Two minutes a run on one core, most of it compiling.

Simulated frames hold bodies that have a car's shape and places and another colour. A detector
without the camera cannot tell them from cars, so how well it does tells whether the camera is used,
which average precision alone does not: the area under the ROC curve of the class scores of a stage,
given the true boxes, and of a ridge regression on a view's crop, fitted on half of the frames and
scored on the other, which says what is there to be used.

Source: linear probes as in Alain, Bengio (2016), Understanding intermediate layers using linear
classifier probes.
"""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from fusion.detection.config import DetectorConfig
from fusion.detection.geometry.encodings import box3d_to_anchor
from fusion.detection.network.crop import crop_and_resize
from fusion.detection.network.forward import encode, score_anchors, score_proposals
from fusion.detection.network.inputs import Inputs
from fusion.detection.network.proposals import view_boxes
from fusion.evaluate import auroc
from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import enable_compilation_cache, print_result, repository, run_command

LOOK_ALIKES = ("bush", "container")
_BOX = ("x", "y", "z", "length", "width", "height", "rotation_y")
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


class Bodies(NamedTuple):
    """Cars and look-alikes of one frame, padded.

    Attributes:
        boxes: `[n, 7]` as in labels.
        car: `[n]` car or look-alike.
        mask: `[n]` which rows are bodies.
    """

    boxes: np.ndarray
    car: np.ndarray
    mask: np.ndarray


class Reading(NamedTuple):
    """What the detector makes of the true boxes of one frame.

    Attributes:
        first, second: `[n]` score of car against background in each stage.
        pixels, camera, lidar: `[n, d]` crops of the image and of both views' feature maps.
    """

    first: Array
    second: Array
    pixels: Array
    camera: Array
    lidar: Array


def read_bodies(
    path: Path,
    config: DetectorConfig,
    *,
    min_points: int = 5,
    min_pixels: float = 20.0,
    min_share: float = 0.5,
) -> Bodies:
    """Bodies of a frame that both sensors see well, from its `visibility` table.

    Args:
        path: `training/visibility/000000.csv` of simulated frames.
        config: gives the area and `max_objects`, beyond which bodies are left out.
        min_points, min_pixels, min_share: fewer lidar points, pixels, or less of it visible: left
            out.

    Raises:
        ValueError: the table has no boxes (simulated by an older version).
    """
    with path.open(encoding="ascii", newline="") as file:
        rows = list(csv.DictReader(file))
    if rows and "rotation_y" not in rows[0]:
        raise ValueError(
            f"{path}: no column rotation_y; simulate the frames again with scripts/"
            "simulate_kitti.py, which writes the boxes since"
        )
    x_range, z_range = config.bev.x_range, config.bev.z_range
    boxes, car = [], []
    for row in rows:
        box = [float(row[name]) for name in _BOX]
        inside = x_range[0] < box[0] < x_range[1] and z_range[0] < box[2] < z_range[1]
        seen = int(row["points"]) >= min_points and float(row["pixels"]) >= min_pixels
        seen &= float(row["share"]) >= min_share
        if inside and seen and row["kind"] in ("Car", *LOOK_ALIKES):
            boxes.append(box)
            car.append(row["kind"] == "Car")
    n, size = min(len(boxes), config.max_objects), config.max_objects
    padded = np.tile(np.array([0, 1.6, 20, 4, 1.6, 1.5, 0], np.float32), (size, 1))
    padded[:n] = np.array(boxes, np.float32).reshape(-1, 7)[:n]
    flags = np.zeros(size, bool)
    flags[:n] = car[:n]
    return Bodies(padded, flags, np.arange(size) < n)


def read_views(
    config: DetectorConfig, main: Any, stats: Any, inputs: Inputs, boxes: Float[Array, "n 7"]
) -> Reading:
    """Scores and crops of boxes in one frame, inside jit.

    Args:
        config: static.
        main: `params["main"]`.
        stats: of batch norm.
        inputs: of one frame, without a leading axis.
        boxes: 3D boxes, taken as proposals.
    """
    import jax

    batch = jax.tree.map(lambda a: a[None], inputs)
    encoded, _ = encode(config, main, stats, batch, train=False)
    anchors, scale = box3d_to_anchor(boxes, square=True)[None], 2.0 * encoded.weights
    first = score_anchors(config, main, encoded, scale, batch, anchors).outputs[0][0]
    crops, outputs = score_proposals(config, main, encoded, scale, batch, anchors)
    second = outputs[0][0]
    places, _ = view_boxes(config, anchors[0], inputs.p2, inputs.image_size)
    size = (config.rpn_crop, config.rpn_crop)
    n = boxes.shape[0]
    return Reading(
        first[:, 1] - first[:, 0],
        second[:, 1] - second[:, 0],
        crop_and_resize(inputs.image, places, size).reshape(n, -1),
        crops[0][0].reshape(n, -1),
        crops[1][0].reshape(n, -1),
    )


def probe_auroc(features: np.ndarray, car: np.ndarray, ridge: float = 1.0) -> float:
    """How well a linear reader of the features tells cars from look-alikes.

    Args:
        features: `[n, d]`; the first half is fitted, the second scored.
        car: `[n]`.
        ridge: penalty, in units of the features' mean variance times the number of rows.

    Returns:
        Area under the ROC curve; NaN where a half lacks cars or look-alikes.
    """
    half = len(car) // 2
    if any(part.all() or not part.any() for part in (car[:half], car[half:])):
        return float("nan")
    x = features.astype(np.float64)
    x = (x - x[:half].mean(0)) / (x[:half].std(0) + 1e-6)
    gram = x[:half] @ x[:half].T
    penalty = ridge * np.trace(gram) / half
    weights = np.linalg.solve(gram + penalty * np.eye(half), car[:half] - car[:half].mean())
    scores = x[half:] @ (x[:half].T @ weights)
    return auroc(scores[car[half:]], scores[~car[half:]])


def probe(config: Config, run: Path) -> tuple[str, dict[tuple[str, str], float]]:
    """The model of one run, and its values by (row, metric)."""
    import jax

    from fusion.detection.learning.cache import open_cache
    from fusion.detection.learning.examples import make_inputs
    from fusion.detection.learning.training import SENSOR_FAILURES, fail_sensor
    from snn_fusion_failure.commands import detector_options as options
    from snn_fusion_failure.commands import detector_runs as runs

    unknown = [kind for kind in config.kinds if kind not in SENSOR_FAILURES]
    if unknown:
        raise ValueError(f"kinds={unknown[0]!r}: expected of {', '.join(SENSOR_FAILURES)}")
    trained = runs.run_config(run, options.Eval(config.data, cache=config.cache))
    cache = open_cache(runs.cache_folder(trained))
    setup = runs.build(trained, cache)
    detector, state = setup.config, runs.load_run(run, setup)
    examples = cache.read(config.split)
    tables = config.data / "training" / "visibility"
    bodies = [read_bodies(tables / f"{n}.csv", detector) for n in cache.names(config.split)]
    look = jax.jit(lambda main, stats, x, b: read_views(detector, main, stats, x, b))
    car = np.concatenate([b.car[b.mask] for b in bodies])
    values = {("bodies", "cars"): float(car.sum()), ("bodies", "look_alikes"): float((~car).sum())}
    for kind in (None, *config.kinds):
        make = jax.jit(
            lambda key, e, kind=kind: (
                make_inputs(detector, e)
                if kind is None
                else fail_sensor(detector, e, kind, key=key)
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
    return trained.model, values


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
    run_command(Config, main, description=__doc__)
