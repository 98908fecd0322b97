"""Label and detection sets from a seed, and the official program's answer to them.

    python tests/golden/kitti_make.py --program ./evaluate --labels LABEL_DIR

`--program` is the benchmark's offline evaluation program (`evaluate_object_3d_offline.cpp`, as
shipped with AVOD, github.com/kujason/avod, commit 56c3710, folder
`scripts/offline_eval/kitti_native_eval`), compiled with g++ 12 at -O1. Its sources are not part of
this project. Three changes were made for the recorded numbers: mail and gnuplot are left out; the
polygons of Boost (which take minutes to compile) are replaced by 30 lines of Sutherland-Hodgman
clipping, so that its reading, filtering, matching and counting are as published while the area of
an overlap is not Boost's; and each precision curve (41 values) is printed as

    curve car_detection 0 <41 numbers>        (0, 1, 2: easy, moderate, hard)

with names `<class>_detection`, `_orientation`, `_detection_BEV`, `_detection_3D`. `--labels` holds
the benchmark's label files; without it only the sets on generated labels are made. Writes
`kitti_ap.json`: for each set the average precision [%] under R11 and R40.

The generator draws from `numpy.random.RandomState`, whose stream is frozen, and rounds what it
draws as the files do, so that the test can make the same sets again from the seed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from fusion.detection.kitti.files import read_labels, write_labels, write_results
from fusion.detection.kitti.objects import DONT_CARE, Objects, concatenate, select

HERE = Path(__file__).resolve().parent
CLASSES = ("Car", "Pedestrian", "Cyclist")
CURVES = ("detection", "orientation", "detection_BEV", "detection_3D")
# name, generated frames (0: real labels), seed of labels, seed of detections, kind
SETS = (
    ("generated_a", 120, 0, 10, "full"),
    ("generated_b", 60, 1, 11, "full"),
    ("generated_small", 3, 2, 12, "full"),
    ("generated_no_angle", 60, 3, 13, "no_angle"),
    ("generated_image_only", 60, 4, 14, "image_only"),
    ("real_a", 0, 0, 20, "full"),
    ("real_b", 0, 1, 21, "full"),
)
N_REAL = 300
_SIZES = {  # mean height, width, length [m]
    "Car": (1.5, 1.6, 3.9),
    "Van": (2.2, 1.9, 5.1),
    "Truck": (3.2, 2.6, 10.0),
    "Pedestrian": (1.8, 0.65, 0.85),
    "Person_sitting": (1.3, 0.6, 0.8),
    "Cyclist": (1.7, 0.6, 1.75),
}


def _objects(rows: list[tuple], scores: list[float] | None = None) -> Objects:
    table = np.array([r[1:] for r in rows], dtype=np.float64).reshape(-1, 14)
    return Objects(
        type=np.array([r[0] for r in rows], "<U14"),
        truncated=table[:, 0],
        occluded=table[:, 1].astype(np.int64),
        alpha=table[:, 2],
        bbox=table[:, 3:7],
        dimensions=table[:, 7:10],
        location=table[:, 10:13],
        rotation_y=table[:, 13],
        score=np.array(scores) if scores is not None else np.full(len(rows), np.nan),
    )


def make_labels(seed: int, n_frames: int) -> list[Objects]:
    """Street-like label sets in which every rule of the benchmark applies to some object."""
    rng = np.random.RandomState(seed)
    kinds = list(_SIZES)
    frames = []
    for _ in range(n_frames):
        rows = []
        for _ in range(rng.randint(1, 9)):
            kind = kinds[rng.choice(len(kinds), p=[0.45, 0.1, 0.05, 0.2, 0.05, 0.15])]
            size = np.round(np.array(_SIZES[kind]) * rng.uniform(0.85, 1.15, 3), 2)
            z = rng.uniform(6, 45)
            x = rng.uniform(-0.5, 0.5) * z
            # An image box of the right order: the evaluator never projects.
            height, half = 720 * size[0] / z, 300 * size[2] / z
            u = 610 + 720 * x / z
            left, right = np.clip([u - half, u + half], 0, 1241)
            top, bottom = np.clip([180 + 900 / z - height, 180 + 900 / z], 0, 374)
            truncated = rng.choice([0.0, 0.0, 0.0, 0.1, 0.25, 0.4, 0.7])
            occluded = rng.choice([0, 0, 0, 1, 1, 2, 3])
            yaw, alpha = rng.uniform(-3.14, 3.14, 2)
            values = np.round([alpha, left, top, right, bottom, *size, x, 1.7, z, yaw], 2)
            if right - left > 2 and bottom - top > 2:
                rows.append((kind, truncated, occluded, *values))
        for _ in range(rng.randint(0, 4)):
            left, top = rng.uniform(0, 1000), rng.uniform(120, 200)
            box = np.round([left, top, left + rng.uniform(20, 200), top + rng.uniform(20, 90)], 2)
            rows.append((DONT_CARE, -1, -1, -10, *box, -1, -1, -1, -1000, -1000, -1000, -10))
        frames.append(_objects(rows))
    return frames


def make_detections(labels: list[Objects], seed: int, kind: str = "full") -> list[Objects]:
    """Detections near the labels: jitter, misses, doubles, wrong classes, false alarms, scores."""
    rng = np.random.RandomState(seed)
    frames = []
    for objects in labels:
        rows, scores = [], []
        for i in range(len(objects)):
            name = str(objects.type[i])
            copies = rng.choice([0, 1, 1, 1, 1, 2, 3])
            # Every number is drawn for every object, so that one case does not shift the next.
            for _ in range(copies):
                noise, wrong, spread = rng.normal(size=14), rng.uniform(), rng.uniform(0.1, 1.6)
                score = np.round(rng.uniform(0, 1) - 0.25 * spread, 2)
                turned = rng.uniform() < 0.1
                box = objects.bbox[i]
                extent = np.maximum(box[2:] - box[:2], 4.0)
                box = box + 0.07 * spread * noise[:4] * np.concatenate([extent, extent])
                box = np.concatenate([np.minimum(box[:2], box[2:] - 1), box[2:]])
                if name == DONT_CARE:
                    if wrong < 0.3:
                        continue
                    target = CLASSES[int(wrong * 100) % 3]
                    size = np.array(_SIZES[target])
                    place = np.array([noise[4] * 10, 1.7, 25 + 5 * noise[5]])
                    yaw, alpha = noise[6], noise[7]
                else:
                    close = {"Van": "Car", "Truck": "Car", "Person_sitting": "Pedestrian"}
                    target = close.get(name, name)
                    if wrong < 0.08 or target not in CLASSES:
                        target = CLASSES[int(wrong * 1000) % 3]
                    size = objects.dimensions[i] * (1 + 0.05 * spread * noise[4:7])
                    place = objects.location[i] + 0.18 * spread * noise[7:10]
                    yaw = objects.rotation_y[i] + 0.12 * spread * noise[10]
                    alpha = objects.alpha[i] + 0.3 * spread * noise[11]
                    if turned:
                        yaw, alpha = yaw + 3.14, alpha + 3.14
                values = np.round([alpha, *box, *np.maximum(size, 0.1), *place, yaw], 2)
                rows.append((target, -1, -1, *values))
                scores.append(score)
        order = rng.permutation(len(rows))
        rows, scores = [rows[j] for j in order], [scores[j] for j in order]
        frame = _objects(rows, scores)
        if kind == "no_angle":
            frame.alpha[:] = -10
        if kind == "image_only":
            frame.dimensions[:], frame.location[:], frame.rotation_y[:] = -1, -1000, -10
        frames.append(frame)
    return frames


def real_labels(folder: Path, seed: int) -> tuple[list[str], list[Objects]]:
    """Some frames of the benchmark, chosen by the seed, and their labels."""
    names = sorted(p.stem for p in folder.glob("*.txt"))
    chosen = np.random.RandomState(seed).permutation(len(names))[:N_REAL]
    picked = [names[i] for i in sorted(chosen)]
    return picked, [read_labels(folder / f"{name}.txt") for name in picked]


def official(
    program: Path, labels: list[Objects], detections: list[Objects]
) -> dict[str, dict[str, list[list[float]]]]:
    """`{class: {curve: [easy, moderate, hard]}}` as printed by the program."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for i, (truth, found) in enumerate(zip(labels, detections, strict=True)):
            write_labels(root / "label_2" / f"{i:06d}.txt", truth)
            write_results(root / "results" / "data" / f"{i:06d}.txt", found)
        command = [str(program.resolve()), str(root / "label_2"), str(root / "results")]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    curves: dict[str, dict[str, list[list[float]]]] = {}
    for line in text.splitlines():
        if line.startswith("curve "):
            _, key, _, *numbers = line.split()
            name, _, curve = key.partition("_")
            values = curves.setdefault(name.capitalize(), {}).setdefault(curve, [])
            values.append([float(v) for v in numbers])
    return curves


def main() -> None:
    """Make all sets, run the program, write `kitti_ap.json`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--program", type=Path, required=True)
    parser.add_argument("--labels", type=Path)
    options = parser.parse_args()
    record = {}
    for name, n_frames, label_seed, detection_seed, kind in SETS:
        if n_frames:
            labels = make_labels(label_seed, n_frames)
        elif options.labels:
            labels = real_labels(options.labels, label_seed)[1]
        else:
            continue
        detections = make_detections(labels, detection_seed, kind)
        curves = official(options.program, labels, detections)
        found = concatenate(detections)
        entry: dict = {"n_frames": len(labels), "n_detections": len(found), "ap": {}}
        for kept in CLASSES:
            entry[f"n_{kept.lower()}"] = len(select(found, found.type == kept))
        for kept, by_curve in curves.items():
            for curve, values in by_curve.items():
                table = 100 * np.array(values)
                entry["ap"].setdefault(kept, {})[curve] = {
                    "r11": table[:, ::4].mean(1).round(6).tolist(),
                    "r40": table[:, 1:].mean(1).round(6).tolist(),
                }
        record[name] = entry
        print(name, len(found), entry["ap"].get("Car", {}).get("detection"), flush=True)
    (HERE / "kitti_ap.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
