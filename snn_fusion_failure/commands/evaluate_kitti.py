"""Average precision of KITTI detections: 2D, orientation, bird's eye and 3D; R11 and R40.

    python scripts/evaluate_kitti.py --labels ROOT/training/label_2 --detections RESULTS \
        --split ROOT/ImageSets/val.txt

`RESULTS` holds one file of detections (000001.txt, ...) for every frame; without `--split` the
frames are those that have one. Prints one table for each number of recall points and, last, a line
`result: ...` with the moderate values of the first class. `--ranges 0 20 40` adds tables of objects
and false alarms 0 to 20, 20 to 40 and over 40 m away. Data without 2D boxes has no easy, moderate
and hard by the benchmark's rules: `--difficulty distance` (up to 20, 40 m, any) or `--difficulty
points` (at least 100, 20, 5 lidar points in the box) are ours. 3,769 frames take seconds on one
core.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.runs import write_json
from snn_fusion_failure.runs.command import run_command


@dataclass(frozen=True)
class Config:
    """Options of the evaluation."""

    labels: Path
    """Folder of the label files (`label_2`)."""
    detections: Path
    """Folder of the detection files, with a score as 16th field."""
    split: Path | None = None
    """List of the frames to evaluate (`ImageSets/val.txt`)."""
    classes: tuple[str, ...] = ("Car", "Pedestrian", "Cyclist")
    min_height: tuple[float, float, float] = (40.0, 25.0, 25.0)
    """Smallest 2D height at each difficulty [pixel]; see `simulation.json` of a simulated set."""
    overlap: float | None = None
    """Least overlap of a hit, for all classes; the benchmark's (0.7, 0.5, 0.5) when left out."""
    ranges: tuple[float, ...] = ()
    """Bounds of range bins [m], `0 20 40`; the last bin has no end."""
    difficulty: Literal["image", "distance", "points"] = "image"
    """What tells easy, moderate and hard apart; `image` is the benchmark's."""
    out: Path | None = None
    """Write the numbers to this JSON file as well."""


def _rows(result: Any, points: int) -> list[dict[str, Any]]:
    from fusion.detection.kitti.average_precision import DIFFICULTIES, METRICS

    ap = result.average_precision(points)
    return [
        {
            "class": name,
            "metric": metric,
            "points": points,
            **{level: float(ap[c, m, d]) for d, level in enumerate(DIFFICULTIES)},
        }
        for c, name in enumerate(result.classes)
        for m, metric in enumerate(METRICS)
    ]


def _table(result: Any, points: int, title: str) -> list[dict[str, Any]]:
    """Print one table; returns its rows."""
    rows = _rows(result, points)
    print(f"{title:<24}{'easy':>8}{'moderate':>10}{'hard':>8}")
    for row in rows:
        label = f"{row['class']} {row['metric']}"
        values = f"{row['easy']:8.2f}{row['moderate']:10.2f}{row['hard']:8.2f}"
        print(f"{label:<24}{values}")
    return rows


def _hardness(config: Config, names: Sequence[str], labels: list[Any]) -> list[Any] | None:
    """Difficulty of each label that does not rest on the image; None for the benchmark's."""
    if config.difficulty == "image":
        return None
    from fusion.detection.kitti.average_precision import hardness_by_distance, hardness_by_points

    if config.difficulty == "distance":
        return hardness_by_distance(labels)
    from fusion.detection.kitti.calibration import lidar_to_camera
    from fusion.detection.kitti.files import read_calibration, read_points
    from fusion.detection.kitti.objects import points_inside

    folder, counts = config.labels.parent, []
    for name, objects in zip(names, labels, strict=True):
        scan = read_points(folder / "velodyne" / f"{name}.bin")[:, :3]
        camera = lidar_to_camera(read_calibration(folder / "calib" / f"{name}.txt"), scan)
        counts.append(points_inside(camera, objects).sum(axis=0))
    return hardness_by_points(counts)


def main(config: Config) -> dict[str, Any]:
    """Evaluate and return `{"frames": ..., "objects": ..., "rows": [...]}`."""
    from fusion.detection.kitti.average_precision import (
        MIN_OVERLAP,
        average_precision_cap,
        evaluate,
    )
    from fusion.detection.kitti.files import frame_names, read_labels, read_results, read_split

    names = read_split(config.split) if config.split else frame_names(config.detections)
    if not names:
        raise ValueError(f"{config.detections} holds no detection file such as 000001.txt")
    if config.overlap is not None and not 0 < config.overlap < 1:
        raise ValueError(f"overlap={config.overlap}: expected a share in (0, 1)")
    labels = [read_labels(config.labels / f"{name}.txt") for name in names]
    detections = [read_results(config.detections / f"{name}.txt") for name in names]
    limits = dict.fromkeys(config.classes, config.overlap) if config.overlap else MIN_OVERLAP
    score = functools.partial(
        evaluate,
        labels,
        detections,
        classes=config.classes,
        min_overlap=limits,
        min_height=config.min_height,
        hardness=_hardness(config, names, labels),
    )
    result = score()
    rows = []
    for points in (11, 40):
        rows += _table(result, points, f"AP R{points} [%]")
    for low, high in zip(config.ranges, (*config.ranges[1:], math.inf), strict=False):
        bin_ = f"{low:g} to {high:g} m" if math.isfinite(high) else f"over {low:g} m"
        part = _table(score(distance=(low, high)), 40, f"AP R40 [%], {bin_}")
        rows += [row | {"range": [low, high if math.isfinite(high) else None]} for row in part]
    for c, name in enumerate(result.classes):
        counts = result.n_objects[c]
        print(
            f"{name}: {result.n_detections[c]} detections; objects " + " / ".join(map(str, counts))
        )
        if 0 < counts.min() < 41:
            caps = " / ".join(f"{average_precision_cap(int(n), 40):.1f}" for n in counts)
            print(f"{name}: fewer than 41 objects; R40 cannot exceed {caps}")
    record = {
        "frames": len(names),
        "objects": dict(zip(result.classes, result.n_objects.tolist(), strict=True)),
        "detections": dict(zip(result.classes, result.n_detections.tolist(), strict=True)),
        "rows": rows,
    }
    if config.out:
        write_json(config.out, record)
    return record


def _fields(done: dict[str, Any]) -> dict[str, Any]:
    first = done["rows"][0]["class"]
    moderate = {
        f"{first.lower()}_{row['metric']}_r{row['points']}": row["moderate"]
        for row in done["rows"]
        if row["class"] == first and "range" not in row
    }
    return {"frames": done["frames"], **moderate}


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, fields=_fields, argv=argv, prog=prog)
