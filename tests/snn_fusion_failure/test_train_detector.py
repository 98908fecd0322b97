"""The detector's commands on tiny frames: prepare with bad frames, train, eval, study."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fusion.detection.config import CAR_SIZES
from fusion.detection.kitti.calibration import Calibration
from fusion.detection.kitti.files import (
    read_labels,
    read_results,
    write_calibration,
    write_labels,
    write_plane,
    write_points,
    write_results,
)
from fusion.detection.kitti.objects import Objects
from fusion.detection.learning.cache import open_cache, prepare_cache, read_example, split_frames
from snn_fusion_failure.commands import detector_options as choices
from snn_fusion_failure.commands import detector_runs as runs
from snn_fusion_failure.commands import draw_detections
from snn_fusion_failure.commands import train_detector as command
from snn_fusion_failure.commands.detector_robustness import robustness, summarize_cells
from tests._scripts import load_script

study_detector = load_script("studies/study_detector")
study_geometry = load_script("studies/study_geometry")


def write_frame(root: Path, name: str, seed: int) -> None:
    """A car of points on flat ground in front of a 96 x 32 camera."""
    rng = np.random.default_rng(seed)
    x, z = rng.uniform(-3, 3), rng.uniform(8, 14)
    body = rng.uniform(-0.5, 0.5, (200, 3)) * [4.2, 1.5, 1.7] + [x, 0.85, z]
    ground = np.stack([rng.uniform(-7, 7, 300), np.full(300, 1.6), rng.uniform(4, 20, 300)], 1)
    camera = np.concatenate([body, ground])
    lidar = np.stack([camera[:, 2], -camera[:, 0], -camera[:, 1]], axis=1)
    points = np.concatenate([lidar, np.full((500, 1), 0.5)], axis=1)
    p2 = np.array([[70.0, 0, 48, 0], [0, 70.0, 16, 0], [0, 0, 1, 0]])
    velo = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
    folder = root / "training"
    write_calibration(
        folder / "calib" / f"{name}.txt", Calibration(np.stack([p2] * 4), np.eye(3), velo, velo)
    )
    write_points(folder / "velodyne" / f"{name}.bin", points)
    write_plane(folder / "planes" / f"{name}.txt", np.array([0.0, -1, 0, 1.6]))
    image = rng.integers(0, 255, (32, 96, 3)).astype(np.uint8)
    (folder / "image_2").mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(folder / "image_2" / f"{name}.png")
    one = np.zeros(1)
    labels = Objects(
        np.array(["Car"], "<U14"), one, np.zeros(1, np.int64), one,
        np.array([[30.0, 8, 60, 24]]), np.array([[1.5, 1.7, 4.2]]), np.array([[x, 1.6, z]]),
        one, np.full(1, np.nan),
    )  # fmt: skip
    write_labels(folder / "label_2" / f"{name}.txt", labels)


@pytest.fixture()
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "kitti"
    for i in range(4):
        write_frame(folder, f"{i:06d}", i)
    (folder / "ImageSets").mkdir()
    (folder / "ImageSets" / "train.txt").write_text("000000\n000001\n000002\n000777\n")
    (folder / "ImageSets" / "val.txt").write_text("000003\n")
    return folder


def test_prepare_counts_what_it_leaves_out(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calibration = root / "training" / "calib" / "000001.txt"
    calibration.unlink()
    options = choices.Prepare(root, "tiny", any_size=True)
    with pytest.raises(FileNotFoundError, match=r"000001\.txt does not exist"):
        command.main(options)
    result = command.main(choices.Prepare(root, "tiny", any_size=True, skip_bad=True))
    text = capsys.readouterr().out
    assert "skipped 000001" in text and "1 listed frames have no image" in text
    assert text.splitlines()[-1].startswith("result: frames_train=2 frames_val=1 skipped=1")
    assert result["missing"] == 1 and result["plane_fitted"] == 0
    cache = open_cache(root / "cache_tiny")
    assert cache.splits == {"train": ("000000", "000002"), "val": ("000003",)}
    assert cache.sizes == CAR_SIZES[1:]  # too few cars for clusters
    assert cache.config("avod").anchors.sizes == CAR_SIZES[1:]
    assert read_example(cache.folder, "000003").truth_mask.sum() == 1
    assert len(cache.read("train")) == 2


def move_to_testing(root: Path, name: str) -> None:
    """Make a frame one of the testing part: no labels, no plane."""
    for part in ("image_2", "velodyne", "calib"):
        (file,) = (root / "training" / part).glob(f"{name}.*")
        (root / "testing" / part).mkdir(parents=True, exist_ok=True)
        file.rename(root / "testing" / part / file.name)


def test_lists_are_added_to_a_cache(root: Path) -> None:
    folder = root / "cache_tiny"
    lists = root / "ImageSets"
    for name in ("000000", "000004"):
        write_frame(root, name, 5)
        move_to_testing(root, name)
    write_frame(root, "000000", 0)
    with pytest.raises(ValueError, match="testing frames have no labels to take anchor sizes"):
        prepare_cache(root, folder, "tiny", splits=("testing", "train"))
    with pytest.raises(FileNotFoundError, match="run `prepare` first"):
        command.main(choices.Prepare(root, "tiny", splits=("testing",)))
    before = prepare_cache(root, folder, "tiny", splits=("train",), any_size=True)
    with pytest.raises(ValueError, match=r"the splits train, not 'val': run `prepare --add"):
        before.read("val")
    command.main(choices.Prepare(root, "tiny", splits=("val",), add=True, any_size=True))
    result = command.main(choices.Prepare(root, "tiny", splits=("testing",), any_size=True))
    assert result["frames_testing"] == 2 and result["frames_train"] == 3
    assert result["plane_fitted"] == 2 and result["missing"] == 1
    cache = open_cache(folder)
    assert cache.sizes == before.sizes
    assert cache.splits["testing"] == ("000000", "000004")
    # Two frames are called 000000.
    train, testing = cache.read("train")[0], cache.read("testing")[0]
    assert train.truth_mask.sum() == 1 and not testing.truth_mask.any()
    assert not np.array_equal(train.image, testing.image)
    assert abs(testing.plane[3] - 1.6) < 0.05
    with pytest.raises(ValueError, match="the splits train, val, testing: cannot add val"):
        prepare_cache(root, folder, "tiny", splits=("val",), add=True)
    with pytest.raises(ValueError, match="split 'testing' has no labels to train on"):
        command.main(choices.Train(root, size="tiny", split="testing"))
    # The benchmark's list of test frames is not a list of labelled ones.
    (lists / "test.txt").write_text("000000\n000003\n")
    with pytest.raises(ValueError, match=r"1 frames of ImageSets/test\.txt are in train\.txt too"):
        split_frames(root, ("test",))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("size", "96x32 pixels, expected 1224x370"),
        ("points", "0 bytes"),
        ("nan", "1 of 500 points hold NaN"),
        ("colour", "an empty image"),
        ("class", "class 'Bus'"),
    ],
)
def test_bad_frames_are_named(root: Path, damage: str, message: str) -> None:
    folder = root / "training"
    if damage == "points":
        (folder / "velodyne" / "000002.bin").write_bytes(b"")
    elif damage == "nan":
        data = np.fromfile(folder / "velodyne" / "000002.bin", "<f4")
        data[5] = np.nan
        data.tofile(folder / "velodyne" / "000002.bin")
    elif damage == "colour":
        Image.fromarray(np.full((32, 96, 3), 7, np.uint8)).save(folder / "image_2" / "000002.png")
    elif damage == "class":
        path = folder / "label_2" / "000002.txt"
        path.write_text(path.read_text().replace("Car", "Bus"))
    with pytest.raises(ValueError, match=message):
        command.main(choices.Prepare(root, "tiny", any_size=damage != "size"))


def test_missing_steps_are_named(root: Path) -> None:
    with pytest.raises(FileNotFoundError, match="run `prepare` first"):
        command.main(choices.Train(root, size="tiny"))
    (root / "ImageSets" / "val.txt").write_text("000900\n")
    with pytest.raises(ValueError, match=r"none of the 1 frames of ImageSets/val\.txt"):
        split_frames(root, ("train", "val"))
    with pytest.raises(ValueError, match="failure='camera_theft'"):
        command.main(choices.Eval(root, size="tiny", failure="camera_theft"))
    with pytest.raises(ValueError, match="kinds='rain': expected of camera_noise"):
        study_detector.evaluations(study_detector.Config(root, kinds=("rain",)))


def test_geometry_is_recorded(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ValueError, match="expected --real or --simulated"):
        study_geometry.main(study_geometry.Config(results=tmp_path))
    with pytest.raises(ValueError, match="96x32 pixels, expected 1224x370"):
        study_geometry.main(study_geometry.Config(real=root, results=tmp_path))
    study_geometry.main(study_geometry.Config(simulated=root, frames=3, results=tmp_path))
    assert capsys.readouterr().out.splitlines()[-1] == "result: simulated=3 rows=15"
    table = json.loads((tmp_path / "study_kitti_geometry.json").read_text())
    values = {row["row"]: row["mean"] for row in table["rows"]}
    assert values["labelled cars"] == 3 and "git" in table
    # The made labels name one and the same image box, wherever the car is.
    share = values["lidar points in a car's 3D box that project into its image box"]
    assert 5 < share < 95
    assert values["fitted against given plane, height, largest"] < 0.02
    assert values["height of a car's bottom above the fitted plane, mean size"] < 0.02


def test_detections_are_drawn(root: Path, tmp_path: Path) -> None:
    for name in ("000001", "000002"):
        labels = read_labels(root / "training" / "label_2" / f"{name}.txt")
        found = dataclasses.replace(
            labels, score=np.full(len(labels), 0.1 if name[-1] == "1" else 1.0)
        )
        write_results(tmp_path / "found" / f"{name}.txt", found)
    options = draw_detections.Config(
        root, tmp_path / "found", tmp_path / "a" / "picture.png", min_cars=1
    )
    assert draw_detections.main(options) == {"frames": ["000001", "000002"], "detections": 1}
    with Image.open(options.out) as picture:
        assert picture.size == (700, 378)
    with pytest.raises(ValueError, match="no frame with a result file has 2 labelled cars"):
        draw_detections.main(dataclasses.replace(options, min_cars=2))


def test_runs_of_other_settings_are_not_mixed(root: Path, tmp_path: Path) -> None:
    cache = prepare_cache(root, root / "cache_tiny", "tiny", splits=("train",), any_size=True)
    options = choices.Train(root, size="tiny", steps=4)
    setup = runs.build(options, cache)
    held = {"settings": runs.resolved(setup)}
    (tmp_path / "result.json").write_text(json.dumps(held))
    runs.check_settings(tmp_path, setup)
    for changed, name in (
        (dataclasses.replace(options, steps=5), "steps=4, not 5"),
        (dataclasses.replace(options, changes=("params.gate.tau=0.7",)), "gate_params.tau="),
        (dataclasses.replace(options, changes=("detector.path_drop=0.3",)), "path_drop="),
    ):
        with pytest.raises(ValueError, match=f"was trained with {name}"):
            runs.check_settings(tmp_path, runs.build(changed, cache))
    # The gate's settings do not concern a model without one.
    plain = dataclasses.replace(options, model="avod")
    held = {"settings": runs.resolved(runs.build(plain, cache))}
    (tmp_path / "result.json").write_text(json.dumps(held))
    for same in (plain, dataclasses.replace(plain, changes=("params.gate.tau=0.7",))):
        runs.check_settings(tmp_path, runs.build(same, cache))
    with pytest.raises(ValueError, match="was trained with path_drop="):
        runs.check_settings(
            tmp_path,
            runs.build(dataclasses.replace(plain, changes=("detector.path_drop=0.3",)), cache),
        )
    # A setting that is new since the run, at any depth, has its default.
    del held["settings"]["detector"]["bev"]["density_points"]
    (tmp_path / "result.json").write_text(json.dumps(held))
    runs.check_settings(tmp_path, runs.build(plain, cache))
    (tmp_path / "result.json").write_text("{}")  # from before settings were written
    runs.check_settings(tmp_path, setup)


def test_a_corrupted_copy_takes_the_anchor_sizes_of_the_detector(root: Path) -> None:
    """Only its validation frames are there; anchor sizes used to be clustered from them anew."""
    cache = prepare_cache(root, root / "cache_tiny", "tiny", splits=("train",), any_size=True)
    path = root / "cache_tiny" / "cache.json"
    path.write_text(path.read_text().replace(str(cache.sizes[0][0]), "4.5"))
    like = open_cache(root / "cache_tiny")
    assert like.sizes != cache.sizes and like.sizes[0][0] == 4.5
    folder, only = root / "corrupted", ("val",)
    made = prepare_cache(root, folder, "tiny", splits=only, like=like, any_size=True)
    assert made.sizes == like.sizes == open_cache(folder).sizes
    again = runs.build(choices.Train(root, size="tiny"), made).config.anchors
    assert again == runs.build(choices.Train(root, size="tiny"), like).config.anchors
    with pytest.raises(ValueError, match="the cache to be like has size 'tiny', not 'small'"):
        prepare_cache(root, root / "other", "small", splits=only, like=like, any_size=True)


def test_robustness_is_summarized_by_kind() -> None:
    cells = {"a": {"1": 40.0, "5": 20.0}, "b": {"all": 10.0}}
    found = summarize_cells(50.0, cells)
    assert found["mean"] == pytest.approx((30 + 10) / 2)
    assert found["mra"] == pytest.approx((0.6 + 0.2) / 2) and "mce" not in found
    base = {"a": {"1": 20.0, "5": 20.0}, "b": {"all": 10.0}}
    assert summarize_cells(50.0, cells, base)["mce"] == pytest.approx((140 / 160 + 1) / 2)
    with pytest.raises(ValueError, match="baseline: no b at severities all"):
        summarize_cells(50.0, cells, {"a": base["a"]})
    with pytest.raises(ValueError, match=r"levels=\(0,\): expected severities from 1 to 5"):
        robustness(choices.Robustness(Path("none"), levels=(0,)))
    with pytest.raises(ValueError, match="kinds='camera_theft': expected of camera_noise"):
        robustness(choices.Robustness(Path("none"), kinds=("camera_theft",)))


@pytest.mark.slow
@pytest.mark.relaxed
def test_study_trains_and_evaluates_both_models(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = study_detector.Config(
        root, seeds=1, size="tiny", steps=4, kinds=("camera_blackout", "lidar_loss"),
        any_size=True, out=tmp_path / "runs", results=tmp_path / "results",
    )  # fmt: skip
    study_detector.main(options)
    table = json.loads((tmp_path / "results" / "study_detector.json").read_text())
    cells = {(row["row"], row["model"], row["metric"]) for row in table["rows"]}
    for model in ("avod", "avod_argate"):
        assert ("clean", model, "3d_moderate_r40") in cells
        assert ("lidar_loss", model, "3d_moderate_r40") in cells
        assert ("mean of failures", model, "3d_moderate_r40") in cells
    assert ("camera_blackout", "avod_argate", "weight_auroc") in cells
    assert ("camera_blackout", "avod", "weight_auroc") not in cells
    run = tmp_path / "runs" / "study_detector_tiny" / "avod_argate_s0"
    assert len(read_results(run / "eval_clean" / "data" / "000003.txt").score) > 0
    assert (run / "eval_clean" / "000003_bird.png").stat().st_size > 1000
    assert (run / "training.png").exists()
    before = (run / "result.json").read_text()
    study_detector.main(options)
    assert (run / "result.json").read_text() == before
    assert "result: evaluations=0" in capsys.readouterr().out.splitlines()[-1]
    result = json.loads((run / "eval_clean" / "result.json").read_text())
    for name in ("3d", "bev"):
        tight, loose = (result[f"{name}_moderate_r40{end}"] for end in ("", "_iou50"))
        assert tight <= loose
    assert "2d_moderate_r40_iou50" not in result and result["split"] == "val"

    # The same runs on test frames go beside them, into a table of their own.
    write_frame(root, "000004", 4)
    (root / "ImageSets" / "test.txt").write_text("000004\n")
    held = (run / "eval_clean" / "result.json").read_text()
    study_detector.main(dataclasses.replace(options, split="test", kinds=("lidar_loss",)))
    assert "result: evaluations=4" in capsys.readouterr().out.splitlines()[-1]
    assert (run / "eval_clean" / "result.json").read_text() == held
    assert (run / "eval_test_lidar_loss" / "data" / "000004.txt").exists()
    table = json.loads((tmp_path / "results" / "study_detector_test.json").read_text())
    assert table["table"] == "study_detector_test" and table["title"].endswith("test frames")
    kinds = {(row["row"], row["split"]) for row in table["rows"]}
    assert {("clean", "test"), ("mean of failures", "test"), ("training", "train")} <= kinds

    # Severities, and a corrupted copy of the list.
    shutil.copytree(root / "training", tmp_path / "rain" / "training")
    shutil.copytree(root / "ImageSets", tmp_path / "rain" / "ImageSets")
    options = choices.Robustness(
        root, size="tiny", run=run, kinds=("camera_blackout",), levels=(1, 5),
        corrupted=(tmp_path / "rain",),
    )  # fmt: skip
    command.main(options)
    text = capsys.readouterr().out
    assert "camera_blackout" in text and "result: model=avod_argate clean=" in text
    held = json.loads((run / "robustness_val" / "robustness.json").read_text())
    assert set(held["cells"]) == {"camera_blackout", "rain"}
    assert held["cells"]["rain"]["all"] == held["clean"]  # nothing was corrupted

    # Frames without labels: result files and no score.
    move_to_testing(root, "000003")
    command.main(choices.Prepare(root, "tiny", splits=("testing",), any_size=True))
    found = command.main(choices.Eval(root, size="tiny", split="testing", run=run, pictures=1))
    assert len(read_results(run / "eval_testing" / "data" / "000003.txt").score) > 0
    assert not any(key.startswith(("3d", "bev", "cars")) for key in found)
    assert (run / "eval_testing" / "000003_image.png").exists()
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("result: model=avod_argate split=testing frames=1 detections=")
