"""`train_detector.py calibrate`, and what eval, robustness, drive and export make of it."""

from __future__ import annotations

import dataclasses
import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from fusion.detection.drive_plots import Moment, plot_moments
from fusion.detection.learning.cache import prepare_cache
from fusion.detection.learning.checkpoints import Checkpoints
from fusion.detection.learning.training import init_training
from fusion.detection.presets import preset
from fusion.detection.sensors.platt import Calibration
from snn_fusion_failure.commands import detector_calibration as calibration
from snn_fusion_failure.commands import detector_options as choices
from snn_fusion_failure.commands import train_detector as command
from snn_fusion_failure.commands.detector_drive import drive
from snn_fusion_failure.commands.detector_robustness import check_results
from snn_fusion_failure.commands.detector_runs import NOT_SETTINGS, build
from snn_fusion_failure.commands.detector_told import read_told, score_told, told_fields
from snn_fusion_failure.runs import open_run
from tests.snn_fusion_failure.test_train_detector import write_frame

HELD = {
    "split": "val", "trained_steps": 4, "slope_camera": 0.5, "slope_lidar": 2.0,
    "offset_camera": 1.0, "offset_lidar": 0.0, "threshold_camera": 0.9, "threshold_lidar": 0.2,
}  # fmt: skip


def test_a_calibration_belongs_to_a_length_of_training(tmp_path: Path) -> None:
    assert calibration.read_calibration(tmp_path, SimpleNamespace(step=4)) is None
    (tmp_path / "calibration.json").write_text(json.dumps(HELD | {"provenance": {}}))
    found = calibration.read_calibration(tmp_path, SimpleNamespace(step=np.int32(4)))
    np.testing.assert_allclose(found, [[0.5, 2.0], [1.0, 0.0], [0.9, 0.2]], rtol=1e-6)
    with pytest.raises(ValueError, match="made after 4 steps, the run has 5; run `calibrate`"):
        calibration.read_calibration(tmp_path, SimpleNamespace(step=5))


def test_results_of_before_the_calibration_are_not_mixed(tmp_path: Path) -> None:
    run, out = tmp_path / "run", tmp_path / "out"
    run.mkdir()
    out.mkdir()
    (run / "config.json").write_text(json.dumps({"settings": {}}))
    options = choices.Eval(tmp_path)
    check_results(out, run, options)
    measured = json.loads((out / "measured.json").read_text())
    del measured["calibration"]  # as such folders were
    (out / "measured.json").write_text(json.dumps(measured))
    check_results(out, run, options)
    (run / "calibration.json").write_text(json.dumps(HELD))
    with pytest.raises(ValueError, match=r"was measured with calibration=None, not \{'split'"):
        check_results(out, run, options)


def test_told_failures_are_scored_by_hand(tmp_path: Path) -> None:
    cells = {
        "clean": [[0.1, 0.1], [0.3, 0.1]],
        "camera_fog_5": [[0.8, 0.1], [0.2, 0.1]],
        "lidar_loss_5": [[0.1, 0.9], [0.1, 0.9]],
        "lidar_noise_5": [[0.1, 0.9], [0.1, 0.1]],
    }
    kinds = ("camera_fog", "lidar_loss", "lidar_noise")
    assert read_told(tmp_path, kinds, (5,)) is None
    for name, rows in cells.items():
        (tmp_path / name).mkdir()
        np.savetxt(tmp_path / name / "failed.txt", rows, header="camera lidar")
    told = read_told(tmp_path, kinds, (5,))
    assert told is not None
    found = score_told(told)
    assert found["auroc"]["camera_fog"] == {"5": 0.75}
    assert found["auroc"]["lidar_noise"] == {"5": 0.75} and "called" not in found["camera"]
    # A third each: clean, camera, lidar, whose two kinds weigh half as much.
    clean, camera, lidar = (0.01 + 0.09) / 2, (0.04 + 0.64) / 2, 0.01
    assert found["camera"]["brier"] == pytest.approx((clean + camera + lidar) / 3)
    noise = (0.01 + 0.81) / 2
    assert found["lidar"]["brier"] == pytest.approx((0.01 + 0.01 + (0.01 + noise) / 2) / 3)
    fields = told_fields(found)
    assert fields["failed_auroc"] == pytest.approx((0.75 + 1.0 + 0.75) / 3)
    # Calibrated ones are scored as they were, too.
    plain = Calibration(np.array([2.0, 1.0]), np.zeros(2), np.array([0.25, 0.5]))
    again = score_told(told, plain)
    assert again["camera"]["false_alarms"] == 0.5 and again["camera"]["called"] == 0.5
    assert again["lidar"]["false_alarms"] == 0.0 and again["lidar"]["called"] == 0.75
    assert again["lidar"]["brier_before"] == pytest.approx(again["lidar"]["brier"])
    before = [1 / (1 + np.sqrt((1 - p) / p)) for p in (0.1, 0.3, 0.8, 0.2)]
    clean = (before[0] ** 2 + before[1] ** 2) / 2
    camera = ((1 - before[2]) ** 2 + (1 - before[3]) ** 2) / 2
    expected = (clean + camera + before[0] ** 2) / 3
    assert again["camera"]["brier_before"] == pytest.approx(expected)
    # Kinds of one sensor alone are another mix than that of the calibration: no such score.
    lone = {cell: p for cell, p in told.items() if not cell[0].startswith("lidar")}
    assert "brier" not in score_told(lone, plain)["camera"]


def test_a_picture_of_a_drive_has_a_suffix_that_can_be_written(tmp_path: Path) -> None:
    options = choices.Drive(tmp_path, out=tmp_path / "drive.mp4")
    with pytest.raises(ValueError, match=r"drive\.mp4: expected a \.gif, which moves, or a \.png"):
        drive(options)


def test_a_drive_on_paper_shows_moments_and_thresholds() -> None:
    rng = np.random.default_rng(0)
    moments = [
        Moment(
            rng.uniform(size=(8, 24, 3)), rng.uniform(size=(8, 8)) - 0.5, np.zeros((0, 7)),
            np.array([[0.0, 1, 9, 4, 2, 1.5, 0.3]]), np.array([0.4, 0.6]),
            np.array([0.1, 0.1 * i]), i / 5,
        )
        for i in range(6)
    ]  # fmt: skip
    area = preset("tiny", "dense").config.bev
    figure = plot_moments(moments, area, "lidar_loss", np.array([0.3, 0.7]), n_shown=3)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == [f"frame {i}: lidar loss, severity {i / 5:.1f}" for i in (0, 2, 5)]
    dashed = [
        line.get_ydata()[0] for line in figure.axes[-1].get_lines() if line.get_linestyle() == "--"
    ]
    assert dashed == [0.3, 0.7]
    with pytest.raises(ValueError, match=r"moments=\(\): expected at least one frame"):
        plot_moments([], area, "lidar_loss")


@pytest.mark.slow
def test_a_calibrated_run_finds_the_same_boxes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, run = tmp_path / "kitti", tmp_path / "run"
    (root / "ImageSets").mkdir(parents=True)
    for i in range(5):
        write_frame(root, f"{i:06d}", i)
    (root / "ImageSets" / "train.txt").write_text("000000\n")
    (root / "ImageSets" / "val.txt").write_text("000001\n000002\n000003\n000004\n")
    cache = prepare_cache(root, root / "cache_tiny", "tiny", any_size=True)
    trained = choices.Train(root, "dense_argate", "tiny", steps=1, failures=True)
    open_run(run, {k: v for k, v in vars(trained).items() if k not in NOT_SETTINGS})
    setup = build(trained, cache)
    state = jax.jit(partial(init_training, config=setup.config))(jax.random.key(0))
    checkpoints = Checkpoints(run / "checkpoints")
    checkpoints.save(1, state._replace(step=state.step + 1), [])
    checkpoints.close()
    options = choices.Eval(root, "dense_argate", "tiny", run=run, pictures=0, out=tmp_path / "raw")
    plain = command.main(options)
    assert "called_camera" not in plain
    calibration.calibrate_if_possible(run, setup, state, cache)
    assert "4 frames of 'val', 99 are needed" in capsys.readouterr().out
    chosen = choices.Calibrate(root, "dense_argate", "tiny", run=run)
    with pytest.raises(ValueError, match=r"rate=0\.01: expected at least 99 frames"):
        command.main(chosen)
    with pytest.raises(ValueError, match="split='train': expected frames that the training did"):
        command.main(dataclasses.replace(chosen, split="train"))
    held = command.main(dataclasses.replace(chosen, false_alarm_rate=0.25))
    assert held["frames"] == 4 and held["trained_steps"] == 1
    found = command.main(dataclasses.replace(options, out=tmp_path / "calibrated"))
    assert 0.0 <= found["called_lidar"] <= 1.0
    assert found["3d_moderate_r40"] == plain["3d_moderate_r40"] or np.isnan(
        plain["3d_moderate_r40"]
    )
    for name in ("data/000002.txt", "fusion_weights.txt"):
        texts = {(tmp_path / f / name).read_text() for f in ("raw", "calibrated")}
        assert len(texts) == 1
    before, after = (np.loadtxt(tmp_path / f / "failed.txt") for f in ("raw", "calibrated"))
    log_odds = np.log(before / (1 - before))
    slope, offset = ([held[f"{n}_{s}"] for s in ("camera", "lidar")] for n in ("slope", "offset"))
    expected = 1 / (1 + np.exp(-(log_odds * slope + offset)))
    np.testing.assert_allclose(after, expected, rtol=1e-4)
    assert not np.allclose(after, before, atol=0.01)
    suite = choices.Robustness(
        root, "dense_argate", "tiny", run=run, kinds=("camera_blackout", "lidar_loss"), levels=(5,)
    )
    scored = command.main(suite)
    assert {"failed_auroc", "brier_camera", "error_lidar"} <= set(scored)
    assert "calibrated on these frames" in capsys.readouterr().out
    record = json.loads((run / "robustness_val" / "robustness.json").read_text())
    assert set(record["told"]["auroc"]) == {"camera_blackout", "lidar_loss"}
    for sensor in ("camera", "lidar"):  # a head that tells nothing cannot be read backwards
        assert ("brier_before" in record["told"][sensor]) == (held[f"slope_{sensor}"] > 0)
    picture = choices.Drive(
        root, "dense_argate", "tiny", run=run, frames=3, failure="lidar_loss", dpi=40,
        out=tmp_path / "drive.png",
    )  # fmt: skip
    assert command.main(picture)["kilobytes"] > 5
