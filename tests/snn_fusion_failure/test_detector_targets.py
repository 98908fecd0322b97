"""Detectors of pedestrians, and the moving picture of a drive."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fusion.detection.config import TARGET_SIZES
from fusion.detection.kitti.files import read_labels, read_results, write_labels
from fusion.detection.kitti.objects import Objects, concatenate
from fusion.detection.learning.cache import open_cache, prepare_cache
from fusion.detection.learning.scoring import class_precision
from fusion.detection.simulator.drive import drive_frames
from fusion.detection.simulator.rendering import SIZES
from fusion.detection.simulator.scene import SceneConfig
from snn_fusion_failure.commands import detector_options as choices
from snn_fusion_failure.commands import train_detector as command
from snn_fusion_failure.commands.detector_drive import severities
from tests.snn_fusion_failure.test_train_detector import write_frame


def _pedestrian(x: float, z: float) -> Objects:
    one = np.zeros(1)
    return Objects(
        np.array(["Pedestrian"], "<U14"), one, np.zeros(1, np.int64), one,
        np.array([[10.0, 2, 20, 28]]), np.array([[1.8, 0.6, 0.9]]), np.array([[x, 1.6, z]]),
        one, np.full(1, np.nan),
    )  # fmt: skip


@pytest.fixture()
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "kitti"
    for i in range(3):
        name = f"{i:06d}"
        write_frame(folder, name, i)
        path = folder / "training" / "label_2" / f"{name}.txt"
        write_labels(path, concatenate([read_labels(path), _pedestrian(2.0 + i, 9.0)]))
    (folder / "ImageSets").mkdir()
    (folder / "ImageSets" / "train.txt").write_text("000000\n000001\n")
    (folder / "ImageSets" / "val.txt").write_text("000002\n")
    return folder


def test_a_cache_has_one_class(root: Path, tmp_path: Path) -> None:
    walkers = prepare_cache(root, tmp_path / "p", "tiny", target="Pedestrian", any_size=True)
    config = walkers.config("dense")
    assert config.target == "Pedestrian" and config.rpn_iou == (0.3, 0.45)
    assert config.anchors.sizes == TARGET_SIZES["Pedestrian"][1:]
    (example,) = walkers.read("val")
    np.testing.assert_allclose(example.truth[example.truth_mask, :6], [[4, 1.6, 9, 0.9, 0.6, 1.8]],
                               rtol=1e-5)  # fmt: skip
    assert open_cache(tmp_path / "p") == walkers
    # What is like it has its class, and so has what is added to it.
    like = prepare_cache(root, tmp_path / "l", "tiny", splits=("val",), like=walkers, any_size=True)
    assert like.target == "Pedestrian"
    cars = prepare_cache(root, tmp_path / "c", "tiny", any_size=True)
    assert cars.target == "Car" and cars.config("dense").rpn_iou == (0.3, 0.5)
    old = json.loads((tmp_path / "c" / "cache.json").read_text())
    del old["target"]  # caches of before knew cars alone
    (tmp_path / "c" / "cache.json").write_text(json.dumps(old))
    assert open_cache(tmp_path / "c") == cars
    with pytest.raises(ValueError, match="target='Tram': expected one of Car, Ped"):
        prepare_cache(root, tmp_path / "t", "tiny", target="Tram")


def test_the_class_has_its_overlap() -> None:
    labels = [_pedestrian(2.0, 9.0)] * 50
    score = np.array([0.9])
    beside = dataclasses.replace(labels[0], score=score, location=np.array([[2.25, 1.6, 9.0]]))
    # A quarter of a metre off, 0.65 of 1.15 m2 overlap: a hit at 0.5, none at 0.7.
    for overlap, hit in ((None, True), (0.7, False)):
        found = class_precision(labels, [beside] * 50, [1242.0] * 50, target="Pedestrian",
                                min_overlap=overlap)  # fmt: skip
        assert found.n_objects[0, 1] == 50
        assert (found.average_precision(40)[0, 3, 1] > 99) == hit


def test_severity_rises_in_the_middle() -> None:
    assert severities(1) == [0.0] and severities(4) == [0.0, 0.0, 1.0, 1.0]


@pytest.mark.slow
def test_a_drive_comes_nearer() -> None:
    frames = list(drive_frames(SceneConfig(night=0.0), SIZES["tiny"], 3, seed=1, speed=20.0))
    places = [f.scene.place for f in frames]
    way = (places[0] - places[2])[:, [0, 2]]
    np.testing.assert_allclose(way, np.tile([0.0, 4.0], (len(way), 1)), atol=1e-3)
    # Everything still stands on the ground.
    plane = frames[0].scene.plane
    np.testing.assert_allclose(places[2] @ plane[:3] + plane[3], 0.0, atol=2e-3)
    near = [np.asarray(f.readings.depth)[40:].mean() for f in frames]
    assert near[0] != near[2]
    with pytest.raises(ValueError, match=r"a way of 0 to 30 m, not 49\.0"):
        next(drive_frames(SceneConfig(), SIZES["tiny"], 50, seed=0, speed=10.0))


@pytest.mark.slow
@pytest.mark.relaxed
def test_pedestrians_are_trained_and_a_drive_is_drawn(root: Path, tmp_path: Path) -> None:
    command.main(choices.Prepare(root, "tiny", target="Pedestrian", any_size=True))
    run = tmp_path / "run"
    command.main(choices.Train(root, "dense_argate", "tiny", steps=2, failures=True, out=run))
    result = command.main(choices.Eval(root, "dense_argate", "tiny", run=run, pictures=1))
    assert "3d_moderate_r40_iou25" in result and "objects" in result
    names = read_results(run / "eval_val" / "data" / "000002.txt").type
    assert len(names) and (names == "Pedestrian").all()
    with pytest.raises(ValueError, match="failure='rain': expected one of camera_noise"):
        command.main(choices.Drive(root, size="tiny", run=run, failure="rain"))
    drawn = command.main(
        choices.Drive(root, size="tiny", run=run, failure="lidar_loss", frames=4, threshold=0.0)
    )
    assert drawn["frames"] == 4 and 0 < drawn["weight_lidar_last"] < 1
    with Image.open(run / "drive_lidar_loss.gif") as picture:
        assert picture.n_frames == 4
        # The map of the lidar is empty in the end: fewer dark pixels in the lower left.
        dark = []
        for i in (0, 3):
            picture.seek(i)
            grey = np.asarray(picture.convert("L"))
            dark.append((grey[grey.shape[0] // 2 :, : grey.shape[1] // 2] < 120).sum())
    assert dark[1] < dark[0]
