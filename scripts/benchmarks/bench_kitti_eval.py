"""Time of the KITTI evaluation on the benchmark's validation list with randomised detections.

    python scripts/benchmarks/bench_kitti_eval.py --data-dir $FUSION_DATA_DIR --record

Needs the label files (`kitti/training/label_2`) and the list (`kitti/ImageSets/val.txt`) below
`--data-dir`; images and scans are not used. Detections are the labels with jitter, misses, doubles
and false alarms, some 17 a frame, as result files. Prints CPU-seconds (of the process, all of its
threads) for reading the files and for evaluating three classes, four metrics and three
difficulties. Half a minute in all; last line `result: frames=... evaluate_s=... read_s=...`.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.rows import summarize
from snn_fusion_failure.runs import provenance, repository, run_command, write_json

TARGET_S = 60.0
"""Reading and evaluating 3,769 frames must not take longer, on two cores."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Options of the benchmark."""

    data_dir: Path
    """Folder that holds `kitti/training/label_2` and `kitti/ImageSets/val.txt`."""
    frames: int | None = None
    """The first so many frames of the list only."""
    false_alarms: int = 12
    """At most so many detections of nothing in a frame."""
    repeats: int = 3
    seed: int = 0
    record: bool = False
    """Write results/bench_kitti_eval.json."""


def _randomised(labels: Any, rng: Any, false_alarms: int) -> Any:
    """Detections near the labels of one frame, and elsewhere."""
    import numpy as np

    from fusion.detection.kitti.objects import DONT_CARE, concatenate, select

    solid = np.flatnonzero(labels.type != DONT_CARE)
    rows = np.repeat(solid, rng.choice([0, 1, 1, 1, 2], len(solid)))
    found = select(labels, rows)
    if len(solid):
        n = int(rng.integers(false_alarms + 1))
        elsewhere = select(labels, rng.choice(solid, n))
        elsewhere = dataclasses.replace(
            elsewhere,
            location=elsewhere.location + rng.uniform(-15, 15, (n, 1)) * [1.0, 0.0, 1.0],
            bbox=elsewhere.bbox + rng.uniform(-300, 300, (n, 1)) * [1.0, 0.0, 1.0, 0.0],
        )
        found = concatenate([found, elsewhere])
    n, spread = len(found), rng.uniform(0.1, 1.5, len(found))
    extent = np.maximum(found.bbox[:, 2:] - found.bbox[:, :2], 2.0)
    box = found.bbox + 0.05 * (spread * rng.normal(size=(4, n))).T * np.tile(extent, 2)
    size = found.dimensions * (1 + 0.04 * (spread * rng.normal(size=(3, n))).T)
    classes = np.array(["Car", "Pedestrian", "Cyclist"])
    known = np.isin(found.type, classes) & (rng.uniform(size=n) > 0.05)
    return dataclasses.replace(
        found,
        type=np.where(known, found.type, rng.choice(classes, n)).astype("<U14"),
        truncated=np.full(n, -1.0),
        occluded=np.full(n, -1),
        alpha=found.alpha + 0.2 * rng.normal(size=n),
        bbox=np.concatenate([box[:, :2], np.maximum(box[:, 2:], box[:, :2] + 1)], axis=1),
        dimensions=np.maximum(size, 0.1),
        location=found.location + 0.12 * (spread * rng.normal(size=(3, n))).T,
        rotation_y=found.rotation_y + 0.1 * rng.normal(size=n),
        score=np.clip(1.0 - 0.5 * spread + 0.1 * rng.normal(size=n), 0.0, 1.0),
    )


def main(config: Config) -> dict[str, Any]:
    """Make the detections, time reading and evaluating them; returns the record."""
    import numpy as np

    from fusion.detection.kitti.average_precision import evaluate
    from fusion.detection.kitti.files import read_labels, read_results, read_split, write_results

    root = config.data_dir / "kitti"
    names = read_split(root / "ImageSets" / "val.txt")[: config.frames]
    files = [root / "training" / "label_2" / f"{name}.txt" for name in names]
    rng = np.random.default_rng(config.seed)
    with tempfile.TemporaryDirectory() as folder:
        for name, file in zip(names, files, strict=True):
            detections = _randomised(read_labels(file), rng, config.false_alarms)
            write_results(Path(folder) / f"{name}.txt", detections)
        start = time.process_time()
        labels = [read_labels(file) for file in files]
        found = [read_results(Path(folder) / f"{name}.txt") for name in names]
        read_s = time.process_time() - start
    times = []
    for _ in range(config.repeats):
        start = time.process_time()
        result = evaluate(labels, found)
        times.append(time.process_time() - start)
    ap = result.average_precision(40)
    objects = sum(len(frame) for frame in labels)
    n_found = sum(len(frame) for frame in found)
    print(f"{len(names)} frames, {objects} labels, {n_found} detections")
    print(f"read {read_s:.2f} s, evaluate " + ", ".join(f"{t:.2f}" for t in times) + " s (CPU)")
    record = {
        "table": "bench_kitti_eval",
        "title": "CPU time of the KITTI evaluation on the validation list",
        **provenance(),
        "frames": len(names),
        "labels": objects,
        "detections": n_found,
        "target_s": TARGET_S,
        "car_moderate_r40": dict(
            zip(("2d", "orientation", "bev", "3d"), ap[0, :, 1].tolist(), strict=True)
        ),
        "read_s": read_s,
        "evaluate_s": summarize(times),
        "frames_per_cpu_second": len(names) / (read_s + float(np.mean(times))),
    }
    if config.record:
        write_json(repository.RESULTS / "bench_kitti_eval.json", record)
    return record


def fields(done: dict[str, Any]) -> dict[str, Any]:
    """What the result line says."""
    shown = ("frames", "detections", "read_s", "target_s")
    return {**{name: done[name] for name in shown}, "evaluate_s": done["evaluate_s"]["mean"]}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=fields)
