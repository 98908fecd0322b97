"""The study of robustness: rows from cells on disk, and a run of it on tiny frames."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from fusion.detection.learning.training import SENSOR_FAILURES
from fusion.detection.presets import preset
from snn_fusion_failure.commands import detector_runs as runs
from snn_fusion_failure.commands.detector_cells import Cell, read_cells
from tests._scripts import load_script
from tests.snn_fusion_failure.test_train_detector import write_frame

study = load_script("studies/study_robustness")


def _write(folder: Path, cell: Cell, precision: float, camera: tuple[float, float]) -> None:
    """A cell of two frames with these camera weights, which tell the failure as 1 - weight."""
    folder.mkdir(parents=True, exist_ok=True)
    weights = [[w, 1 - w] for w in camera]
    record = {
        "3d_moderate_r40": precision,
        "weights": weights,
        "failed": [w[::-1] for w in weights],
    }
    (folder / f"{cell.name.replace(' ', '_')}.json").write_text(json.dumps(record))


def _config(tmp_path: Path, **changes: object) -> object:
    return study.Config(
        tmp_path, kinds=("camera_fog", "lidar_noise"), levels=(2, 5), out=tmp_path / "runs",
        results=tmp_path / "results", split="test", seeds=2, collect_only=True, **changes,
    )  # fmt: skip


def test_every_kind_is_left_out_once() -> None:
    assert sorted(kind for fold in study.FOLDS for kind in fold) == sorted(SENSOR_FAILURES)
    for fold in study.FOLDS:
        assert {kind.partition("_")[0] for kind in fold} == {"camera", "lidar"}
    assert sorted(study.unseen_kinds("all")) == sorted(SENSOR_FAILURES)
    config = study.Config(Path("x"), seeds=2, models=("dense", "avod"), fold="seed")
    names = [training.folder(config).name for training in study.trainings(config)]
    assert names == ["dense_fold0_s0", "avod_fold0_s0", "dense_fold1_s1", "avod_fold1_s1"]
    with pytest.raises(ValueError, match=r"levels=\(6,\): expected severities from 1 to 5"):
        study.cells(study.Config(Path("x"), levels=(6,)))
    with pytest.raises(ValueError, match="kinds='rain': expected of camera_noise"):
        study.cells(study.Config(Path("x"), kinds=("rain",)))


def test_rows_are_means_of_the_cells(tmp_path: Path) -> None:
    config = _config(tmp_path)
    cells = study.cells(config)
    assert [cell.name for cell in cells] == [
        "clean", "camera_fog 2", "camera_fog 5", "lidar_noise 2", "lidar_noise 5",
    ]  # fmt: skip
    precision = {"dense": (50, 40, 30, 20, 10), "dense_argate": (60, 50, 40, 24, 12)}
    for model, values in precision.items():
        for seed in (0, 1):
            kept = study.Training(model, seed, None).folder(config) / "cells_test"
            for cell, value in zip(cells, values, strict=True):
                failing = cell.failure == "camera_fog"
                _write(kept, cell, value - seed, (0.1, 0.5) if failing else (0.5, 0.6))
    # A seed that is not complete counts nowhere.
    _write(study.Training("avod", 0, None).folder(config) / "cells_test", Cell(), 1.0, (0.5, 0.5))
    # Fold 0 leaves out the fog, fold 1 the noise of the lidar; a seed with both has their mean.
    for fold, values in ((0, (50, 20, 10, 30, 30)), (1, (50, 30, 30, 0, 6))):
        kept = study.Training("dense", 0, fold).folder(config) / "cells_test"
        for cell, value in zip(cells, values, strict=True):
            _write(kept, cell, value, (0.5, 0.5))
    study.main(config)
    table = json.loads((tmp_path / "results" / "study_robustness.json").read_text())
    held = {(r["row"], r["model"], r["metric"]): r["values"] for r in table["rows"]}
    assert held["clean", "dense", "3d_moderate_r40"] == [50, 49]
    assert held["camera_fog 2", "dense_argate", "3d_moderate_r40"] == [50, 49]
    assert held["seen kinds", "dense", "3d_moderate_r40"] == [25, 24]
    assert held["seen kinds", "dense", "mra"] == pytest.approx([0.5, 24 / 49])
    assert held["seen kinds", "dense", "mce"] == [1.0, 1.0]
    wanted = [0.5 * ((110 + 2 * s) / (130 + 2 * s) + (164 + 2 * s) / (170 + 2 * s)) for s in (0, 1)]
    assert held["seen kinds", "dense_argate", "mce"] == pytest.approx(wanted)
    # Of four pairs of frames three have the lower weight while the camera fails, one is a tie.
    assert held["camera_fog 2", "dense", "weight_auroc"] == pytest.approx([0.875] * 2)
    assert held["camera_fog 2", "dense", "failed_auroc"] == pytest.approx([0.875] * 2)
    assert ("clean", "dense", "weight_auroc") not in held
    assert held["unseen kinds", "dense", "3d_moderate_r40"] == [(15 + 3) / 2]
    assert held["seen kinds (folds)", "dense", "3d_moderate_r40"] == [30]
    assert not [key for key in held if key[1] == "avod"]
    found = {(row["row"], row["comparison"]): row["difference"] for row in table["comparisons"]}
    assert not any("fog" in row for row, _ in found)
    assert found["seen kinds", "dense_argate - dense"] == pytest.approx(6.5)
    assert found["clean", "dense_argate - dense"] == pytest.approx(10.0)


def test_trainings_that_see_no_failure_have_rows_of_their_own_and_a_bound(tmp_path: Path) -> None:
    config = _config(tmp_path, models=("dense",), fold="all")
    cells = study.cells(config)
    variants = {
        "": (50, 40, 30, 20, 10),
        "_lidar_only": (45, 45, 45, 5, 2),
        "_camera_only": (1,) * 5,
    }
    [training, _] = study.trainings(config)
    assert training.folder(config).name == "dense_foldall_s0"
    for name, values in variants.items():
        for cell, value in zip(cells, values, strict=True):
            _write(training.folder(config) / f"cells_test{name}", cell, value, (0.5, 0.5))
    study.main(config)
    table = json.loads((tmp_path / "results" / "study_robustness.json").read_text())
    held = {(r["row"], r["model"], r["metric"]): r["values"] for r in table["rows"]}
    of = {(row, model): v for (row, model, metric), v in held.items() if metric == study.METRIC}
    assert all(row.endswith("(none seen)") for row, _ in of)
    assert of["camera_fog 5 (none seen)", "dense"] == [30]
    assert of["unseen kinds (none seen)", "dense"] == [25]
    assert of["camera_fog 5 (none seen)", "best_of_both"] == [45]
    assert of["unseen kinds (none seen)", "best_of_both"] == [(45 + 15) / 2]
    options = study._options(config, training)
    cache = SimpleNamespace(size="small", config=lambda model: preset("small", model).config)
    assert runs.build(options, cache).train.failure_share == 0.0


def test_each_model_is_trained_as_long_as_its_preset_says(tmp_path: Path) -> None:
    config = study.Config(tmp_path, seeds=1)
    found = {}
    for training in study.trainings(config):
        made = preset("small", training.model).config
        cache = SimpleNamespace(size="small", config=lambda model, made=made: made)
        setup = runs.build(study._options(config, training), cache)
        assert setup.train.failure_share == pytest.approx(2 / 3)
        found[training.model] = setup.train.steps, setup.train.batch_size
    assert found == {
        "avod": (2000, 1), "avod_argate": (2000, 1),
        "dense": (6000, 2), "dense_argate": (6000, 2), "dense_oracle": (6000, 2),
    }  # fmt: skip


def test_models_measured_later_are_scored_against_the_baseline_on_record(tmp_path: Path) -> None:
    config = _config(tmp_path)
    cells = study.cells(config)
    kept = study.Training("dense", 0, None).folder(config) / "cells_test"
    for cell, value in zip(cells, (50, 40, 30, 20, 10), strict=True):
        _write(kept, cell, value, (0.5, 0.5))
    study.main(config)
    path = tmp_path / "results" / "study_robustness.json"
    before = json.loads(path.read_text())["rows"]

    # Another machine: the table is here, the runs of the baseline are not.
    elsewhere = dataclasses.replace(config, out=tmp_path / "other", models=("avod", "avod_argate"))
    for model, lower in (("avod", 5), ("avod_argate", 0)):
        for seed in (0, 1):
            kept = study.Training(model, seed, None).folder(elsewhere) / "cells_test"
            for cell, value in zip(cells, (50, 40, 30, 20, 10), strict=True):
                _write(kept, cell, value - lower, (0.5, 0.5))
    study.main(elsewhere)
    rows = json.loads(path.read_text())["rows"]
    assert rows[: len(before)] == before
    held = {(r["row"], r["model"], r["metric"]): r["values"] for r in rows}
    # The baseline has no seed 1, and an error against one seed of two would be no column's mean.
    assert held["seen kinds", "avod", "3d_moderate_r40"] == [20, 20]
    assert ("seen kinds", "avod", "mce") not in held
    study.main(dataclasses.replace(elsewhere, seeds=1))
    held = {(r["row"], r["model"], r["metric"]): r["values"]
            for r in json.loads(path.read_text())["rows"]}  # fmt: skip
    assert held["seen kinds", "avod", "mce"] == pytest.approx([0.5 * (140 / 130 + 180 / 170)])
    assert held["seen kinds", "avod_argate", "mce"] == [1.0]

    # What other models have on disk by now is not written under this command's name.
    _write(study.Training("dense", 0, None).folder(config) / "cells_test", Cell(), 1.0, (0.5, 0.5))
    study.main(dataclasses.replace(elsewhere, out=config.out))
    assert json.loads(path.read_text())["rows"][: len(before)] == before


@pytest.mark.slow
@pytest.mark.relaxed
def test_tiny_frames_go_all_the_way(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "kitti"
    for i in range(4):
        write_frame(root, f"{i:06d}", i)
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "train.txt").write_text("000000\n000001\n")
    (root / "ImageSets" / "val.txt").write_text("000002\n000003\n")
    options = study.Config(
        root, seeds=1, models=("dense", "dense_oracle", "avod", "avod_argate"), size="tiny",
        steps=4, levels=(5,), kinds=("camera_blackout", "lidar_loss"), fold="1", any_size=True,
        out=tmp_path / "runs", results=tmp_path / "results",
    )  # fmt: skip
    study.main(options)
    table = json.loads((tmp_path / "results" / "study_robustness_val.json").read_text())
    rows = {(row["row"], row["model"]) for row in table["rows"]}
    for model in ("dense", "dense_oracle", "camera_only", "lidar_only", "avod", "avod_argate"):
        assert {("clean (folds)", model), ("seen kinds (folds)", model)} <= rows
        assert ("unseen kinds", model) in rows  # the blackout, which fold 1 leaves out
    run = tmp_path / "runs" / "tiny" / "dense_fold1_s0"
    settings = json.loads((run / "result.json").read_text())["settings"]["training"]
    assert "camera_blackout" not in settings["failure_kinds"]
    assert "lidar_loss" in settings["failure_kinds"]
    held = json.loads((run / "cells_val_camera_only" / "lidar_loss_5.json").read_text())
    assert held["weights"] == [[1.0, 0.0]] * 2 and held["failed"] is None
    # The same cells and scores of the two-stage models; without a gate there is no weight to score.
    metrics = {(row["model"], row["metric"]) for row in table["rows"]}
    assert ("avod", "mce") in metrics and ("avod_argate", "mce") in metrics
    assert ("avod_argate", "weight_auroc") in metrics and ("avod", "weight_auroc") not in metrics
    # Without its camera's failure the oracle weighs as the clean frames say.
    oracle = tmp_path / "runs" / "tiny" / "dense_oracle_fold1_s0" / "cells_val"
    weights = [json.loads((oracle / f"{n}.json").read_text())["weights"][0]
               for n in ("clean", "camera_blackout_5")]  # fmt: skip
    assert weights[0] != weights[1]
    assert read_cells(oracle, [Cell(), Cell("camera_fog", 5)]) is None
    capsys.readouterr()
    study.main(dataclasses.replace(options))
    assert "result: cells=0" in capsys.readouterr().out.splitlines()[-1]
