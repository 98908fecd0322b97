"""Corrupted copies of frames that the user brings, and results that must not be mixed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fusion.detection.kitti.files import write_plane, write_points
from fusion.detection.learning.cache import open_cache, prepare_cache
from snn_fusion_failure.commands import detector_options as choices
from snn_fusion_failure.commands.detector_robustness import (
    _prepare,
    check_names,
    check_results,
)
from tests.snn_fusion_failure.test_train_detector import write_frame


@pytest.fixture()
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "kitti"
    for i in range(4):
        write_frame(folder, f"{i:06d}", i)
    (folder / "ImageSets").mkdir()
    (folder / "ImageSets" / "train.txt").write_text("000000\n")
    (folder / "ImageSets" / "val.txt").write_text("000001\n000002\n000003\n")
    # A camera at 1.1 m, whose height a scan of nothing cannot tell again.
    write_plane(folder / "training" / "planes" / "000002.txt", np.array([0.0, -1, 0, 1.1]))
    prepare_cache(folder, folder / "cache_tiny", "tiny", any_size=True)
    return folder


def corrupt(root: Path, folder: Path) -> Path:
    """A copy with a black image, a scan without a point, one with lost points; no planes."""
    shutil.copytree(root / "training", folder / "training")
    shutil.copytree(root / "ImageSets", folder / "ImageSets")
    shutil.rmtree(folder / "training" / "planes")
    black = Image.fromarray(np.zeros((32, 96, 3), np.uint8))
    black.save(folder / "training" / "image_2" / "000001.png")
    scan = folder / "training" / "velodyne"
    (scan / "000002.bin").write_bytes(b"")
    lost = np.fromfile(scan / "000003.bin", "<f4").reshape(-1, 4)
    lost[::2] = np.nan
    write_points(scan / "000003.bin", lost)
    return folder


def test_copies_with_dead_sensors_are_read_with_the_ground_of_the_frames(
    root: Path, tmp_path: Path
) -> None:
    folder = corrupt(root, tmp_path / "dead")
    options = choices.Robustness(root, size="tiny", corrupted=(folder,))
    made = open_cache(_prepare(options, folder, tmp_path / "out"))
    clean = open_cache(root / "cache_tiny").read("val")
    black, empty, thin = made.read("val")
    assert black.image.max() == 0 and black.point_mask.sum() == clean[0].point_mask.sum() > 0
    assert not empty.point_mask.any()
    assert 0 < thin.point_mask.sum() < clean[2].point_mask.sum() and np.isfinite(thin.points).all()
    for copy, frame in zip((black, empty, thin), clean, strict=True):
        np.testing.assert_array_equal(copy.plane, frame.plane)
        np.testing.assert_array_equal(copy.truth, frame.truth)
    assert made.counts["plane_fitted"] == 0
    # Frames that are no copies stay strictly read.
    like = open_cache(root / "cache_tiny")
    with pytest.raises(ValueError, match="every pixel is 0: an empty image"):
        prepare_cache(folder, tmp_path / "c", "tiny", splits=("val",), like=like, any_size=True)
    with pytest.raises(ValueError, match="copies=True: expected the cache of the frames"):
        prepare_cache(folder, tmp_path / "c", "tiny", splits=("val",), copies=True)


def test_folders_of_one_name_are_refused(root: Path, tmp_path: Path) -> None:
    for names in (("a/rain", "b/rain"), ("clean",), ("camera_fog_3",), ("time_lag",)):
        with pytest.raises(ValueError, match=r"corrupted=.*: name the folder otherwise|; name the"):
            check_names([tmp_path / name for name in names])
    check_names([tmp_path / "rain", tmp_path / "snow"])
    options = choices.Robustness(root, size="tiny")
    _prepare(options, corrupt(root, tmp_path / "a" / "rain"), tmp_path / "out")
    other = corrupt(root, tmp_path / "b" / "rain")
    with pytest.raises(ValueError, match=r"holds results of .*a.rain under this name"):
        _prepare(options, other, tmp_path / "out")


def test_results_of_other_options_or_another_training_are_not_taken_up(tmp_path: Path) -> None:
    run, out = tmp_path / "run", tmp_path / "out"
    (run / "checkpoints" / "20").mkdir(parents=True)
    (run / "config.json").write_text(json.dumps({"settings": {"model": "dense", "seed": 0}}))
    options = choices.Eval(tmp_path, overlap=None)
    check_results(out, run, options)
    check_results(out, run, options)
    with pytest.raises(ValueError, match=r"was measured with overlap=None, not 0\.5: give another"):
        check_results(out, run, choices.Eval(tmp_path, overlap=0.5))
    (run / "checkpoints" / "40").mkdir()
    with pytest.raises(ValueError, match="was measured with trained_steps=20, not 40"):
        check_results(out, run, options)
    (run / "checkpoints" / "40").rmdir()
    (run / "config.json").write_text(json.dumps({"settings": {"model": "dense", "seed": 1}}))
    with pytest.raises(ValueError, match="was measured with trained="):
        check_results(out, run, options)
