"""Average precision of KITTI detections: 2D, orientation, bird's eye and 3D; R11 and R40.

    python scripts/evaluate_kitti.py --labels ROOT/training/label_2 --detections RESULTS \
        --split ROOT/ImageSets/val.txt

`RESULTS` holds one file of detections (000001.txt, ...) for every frame; without `--split` the
frames are those that have one. Prints one table for each number of recall points and, last, a line
`result: ...` with the moderate values of the first class. 3,769 frames take seconds on one core.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


def main(config: Config) -> dict[str, Any]:
    """Evaluate and return `{"frames": ..., "objects": ..., "rows": [...]}`."""
    from fusion.detection.kitti.average_precision import average_precision_cap, evaluate
    from fusion.detection.kitti.files import frame_names, read_labels, read_results, read_split

    names = read_split(config.split) if config.split else frame_names(config.detections)
    if not names:
        raise ValueError(f"{config.detections} holds no detection file such as 000001.txt")
    labels = [read_labels(config.labels / f"{name}.txt") for name in names]
    detections = [read_results(config.detections / f"{name}.txt") for name in names]
    result = evaluate(labels, detections, classes=config.classes, min_height=config.min_height)
    rows = []
    for points in (11, 40):
        print(f"{'AP R' + str(points) + ' [%]':<24}{'easy':>8}{'moderate':>10}{'hard':>8}")
        for row in _rows(result, points):
            rows.append(row)
            label = f"{row['class']} {row['metric']}"
            values = f"{row['easy']:8.2f}{row['moderate']:10.2f}{row['hard']:8.2f}"
            print(f"{label:<24}{values}")
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
        if row["class"] == first
    }
    return {"frames": done["frames"], **moderate}


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, fields=_fields, argv=argv, prog=prog)
