"""The simulation script: a KITTI folder that our readers and the evaluator accept."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from fusion.detection.geometry.planes import height_above
from fusion.detection.kitti.average_precision import average_precision_cap, evaluate
from fusion.detection.kitti.files import frame_names, read_frame, read_split, write_labels
from fusion.detection.kitti.objects import Objects
from fusion.detection.simulator.frames import VISIBILITY_COLUMNS
from snn_fusion_failure.commands import simulate_kitti

LAYOUTS = [(-3.0, 9.0), (2.0, 15.0), (4.0, 22.0), (-2.0, 30.0), (0.5, 12.0), (1.0, 45.0)]


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> simulate_kitti.Config:
    """Six label files of one car and one pedestrian each."""
    folder = tmp_path_factory.mktemp("simulated")
    for i, (x, z) in enumerate(LAYOUTS):
        one = Objects(
            np.array(["Car", "Pedestrian"]), np.zeros(2), np.zeros(2, np.int64), np.zeros(2),
            np.tile([10.0, 10, 20, 20], (2, 1)), np.array([[1.5, 1.6, 4.0], [1.8, 0.6, 0.8]]),
            np.array([[x, 1.7, z], [x + 4, 1.7, z + 2]]), np.array([1.5, 0.0]), np.full(2, np.nan),
        )  # fmt: skip
        write_labels(folder / "layouts" / f"{i:06d}.txt", one)
    return simulate_kitti.Config(
        out=folder / "out", layouts=folder / "layouts", frames=5, val=2, test=1, size="tiny",
        picture=folder / "picture.png",
    )  # fmt: skip


def test_folder_is_read_and_evaluated(config: simulate_kitti.Config) -> None:
    record = simulate_kitti.main(config)
    assert record["frames"] == record["new_frames"] == 8
    splits = [read_split(config.out / "ImageSets" / f"{s}.txt") for s in ("train", "val", "test")]
    assert [len(s) for s in splits] == [5, 2, 1]
    names = frame_names(config.out / "training" / "label_2")
    assert names == tuple(sorted(sum(splits, ())))
    truths, n_cars = [], 0
    for name in names:
        frame = read_frame(config.out, name, any_size=True)
        assert frame.image.shape == (58, 192, 3) and len(frame.points) > 500
        assert frame.labels is not None and frame.plane is not None
        np.testing.assert_allclose(height_above(frame.plane, frame.labels.location), 0.0, atol=0.02)
        n_cars += int((frame.labels.type == "Car").sum())
        truths.append(frame.labels)
        text = (config.out / "training" / "visibility" / f"{name}.csv").read_text()
        table = list(csv.DictReader(text.splitlines()))
        labelled = [row for row in table if row["label"] != "-1"]
        assert [row["kind"] for row in labelled] == frame.labels.type.tolist()
        assert {row["kind"] for row in table} <= {"Car", "Pedestrian", "bush", "container"}
        boxes = np.array([[float(r[c]) for c in VISIBILITY_COLUMNS[8:]] for r in labelled])
        labels = frame.labels
        truth = np.column_stack(
            [labels.location, labels.dimensions[:, [2, 1, 0]], labels.rotation_y]
        )
        np.testing.assert_allclose(boxes.reshape(-1, 7), truth, atol=0.011)  # labels have 0.01
    assert record["cars"] == n_cars >= 6 and record["look_alikes"] > 0
    # Labels given back as detections: as good as so few cars can be, at the heights of this image.
    found = [dataclasses.replace(t, score=np.ones(len(t))) for t in truths]
    result = evaluate(truths, found, classes=("Car",), min_height=record["min_height"])
    for d, n in enumerate(result.n_objects[0]):
        if n:
            cap = average_precision_cap(int(n), 40)
            np.testing.assert_allclose(result.average_precision(40)[0, [0, 2, 3], d], cap)
    assert result.n_objects[0, 2] >= 4
    assert json.loads((config.out / "simulation.json").read_text())["cars"] == n_cars
    assert config.picture is not None and config.picture.stat().st_size > 10_000


def test_resume_makes_the_same_frames(config: simulate_kitti.Config) -> None:
    if not (config.out / "simulation.json").exists():
        simulate_kitti.main(config)
    training = config.out / "training"
    before = {p: p.read_bytes() for p in sorted(training.rglob("00000[37].*"))}
    assert len(before) == 12
    for path in before:
        path.unlink()
    with pytest.raises(ValueError, match="already holds a run; pass --resume"):
        simulate_kitti.main(config)
    record = simulate_kitti.main(dataclasses.replace(config, resume=True, picture=None))
    assert record["new_frames"] == 2 and record["frames"] == 8
    assert {p: p.read_bytes() for p in before} == before
    with pytest.raises(ValueError, match=r"other settings \(night"):
        simulate_kitti.main(dataclasses.replace(config, resume=True, night=0.5))


def test_bad_input_leaves_nothing_behind(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(ValueError, match="frames=0"):
        simulate_kitti.main(simulate_kitti.Config(out=out, frames=0))
    with pytest.raises(FileNotFoundError, match="expected a folder"):
        simulate_kitti.main(simulate_kitti.Config(out=out, layouts=tmp_path / "none"))
    assert not out.exists()
