r"""Average precision of one trained detector in many cells of failure and severity, in one process.

`train_detector.py eval` writes result files and pictures of one failure; a study of robustness has
some fifty cells for every training and needs a number and the gate's outputs of each. Frames and
labels are read once, the network is compiled once and each failure once, since severities are
traced.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from snn_fusion_failure.records.rows import recorded, values_by_seed
from snn_fusion_failure.runs import write_json

METRIC = "3d_moderate_r40"


class Frames(NamedTuple):
    """What is read once: examples, their cameras, their labels."""

    examples: list[Any]
    cameras: list[Any]
    labels: list[Any]


class Cell(NamedTuple):
    """One failure at one severity in fifths; no failure in the cell `clean`.

    Example:
        >>> Cell("camera_fog", 3).name
        'camera_fog 3'
    """

    failure: str | None = None
    level: int = 0

    @property
    def name(self) -> str:
        """As rows of tables are called."""
        return f"{self.failure} {self.level}" if self.failure else "clean"


def read_frames(root: Path, cache: Any, split: str) -> Frames:
    """Examples and labels of a list of a KITTI folder, in memory (0.5 MB a frame at `small`)."""
    import numpy as np

    from fusion.detection.kitti.files import read_labels
    from fusion.detection.learning.scoring import Camera

    examples = cache.read(split)
    cameras = [Camera(np.asarray(e.p2), np.asarray(e.image_size)) for e in examples]
    folder = root / "training" / "label_2"
    labels = [read_labels(folder / f"{name}.txt") for name in cache.names(split)]
    return Frames(examples, cameras, labels)


def measure_cells(
    config: Any,
    state: Any,
    frames: Frames,
    cells: Sequence[Cell],
    folder: Path,
    *,
    overlap: float | None = None,
    seed: int = 0,
) -> int:
    """Measure the cells that `folder` does not hold, one file each; returns how many were missing.

    Args:
        config, state: of a trained detector.
        frames: as from `read_frames`.
        cells: what to measure, the clean cell first.
        folder: of `clean.json`, `camera_fog_3.json` and so on.
        overlap: least overlap of a hit; the benchmark's when left out.
        seed: of the failures' noise, the same for all detectors that are to be compared.
    """
    import numpy as np

    from fusion.detection.learning.fitting import run_detector
    from fusion.detection.learning.scoring import class_precision, frame_objects, precision_fields

    widths = [float(camera.image_size[1]) for camera in frames.cameras]
    missing = [cell for cell in cells if not _path(folder, cell).exists()]
    for cell in missing:
        if cell.failure and _unread(config, cell.failure):
            # What a detector does not read cannot change what it finds.
            write_json(_path(folder, cell), json.loads(_path(folder, Cell()).read_text("utf-8")))
            continue
        found = run_detector(
            config,
            state,
            frames.examples,
            failure=cell.failure,
            severity=cell.level / 5,
            seed=seed,
        )
        objects = frame_objects(found, frames.cameras, config.target)
        scored = class_precision(
            frames.labels, objects, widths, target=config.target, min_overlap=overlap
        )
        failed = np.stack([d.failed for d in found])
        record = {
            METRIC: precision_fields(scored)[METRIC],
            "weights": np.stack([d.weights for d in found]).tolist(),
            "failed": failed.tolist() if np.isfinite(failed).all() else None,
        }
        write_json(_path(folder, cell), record)
    return len(missing)


def _unread(config: Any, failure: str) -> bool:
    """Does the failure concern a sensor whose weight is fixed at 0?"""
    sensor = 0 if failure.startswith("camera") else 1
    return config.fixed_weights is not None and config.fixed_weights[sensor] == 0.0


def _path(folder: Path, cell: Cell) -> Path:
    return folder / f"{cell.name.replace(' ', '_')}.json"


def read_cells(folder: Path, cells: Sequence[Cell]) -> dict[Cell, dict[str, float]] | None:
    """Scores of each cell: average precision, and how well the gate tells the failure.

    Returns:
        Of each cell `3d_moderate_r40` and, but for the clean one, where the network weighs or tells
        anything `weight_auroc` (the failed sensor's weight is lower than in clean frames) and
        `failed_auroc` (its told probability is higher). None while a cell is missing.
    """
    import numpy as np

    from fusion.evaluate import auroc

    if not all(_path(folder, cell).exists() for cell in cells):
        return None
    held = {c: json.loads(_path(folder, c).read_text(encoding="utf-8")) for c in cells}
    clean = held[Cell()]
    found = {}
    for cell, record in held.items():
        scores = {METRIC: float(record[METRIC])}
        for sensor, name in enumerate(("camera", "lidar")):
            if cell.failure is None or not cell.failure.startswith(name):
                continue
            before = np.asarray(clean["weights"])[:, sensor]
            after = np.asarray(record["weights"])[:, sensor]
            if np.ptp(np.concatenate([before, after])) > 0:
                scores["weight_auroc"] = auroc(before, after)
            if record["failed"] is not None:
                told = np.asarray(record["failed"])[:, sensor]
                scores["failed_auroc"] = auroc(told, np.asarray(clean["failed"])[:, sensor])
        found[cell] = scores
    return found


def recorded_cells(
    table: Path, model: str, seed: int, cells: Sequence[Cell]
) -> dict[Cell, dict[str, float]] | None:
    """Average precision of each cell by a table of record; None where one lacks this seed.

    Models are measured months apart, on machines that hold no runs of each other.
    """
    rows = {
        row["row"]: values_by_seed(row)
        for row in recorded(table)
        if row["model"] == model and row["metric"] == METRIC
    }
    if any(seed not in rows.get(cell.name, {}) for cell in cells):
        return None
    return {cell: {METRIC: rows[cell.name][seed]} for cell in cells}
