"""The evaluation script on a folder of made files: table, numbers, errors."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from fusion.detection.kitti.files import write_labels, write_results
from fusion.detection.kitti.objects import Objects
from snn_fusion_failure.commands import evaluate_kitti


@pytest.fixture
def config(tmp_path: Path) -> evaluate_kitti.Config:
    """Three frames with two cars each; perfect detections of one of the two."""
    n = 2
    box = np.array([[100.0, 100, 200, 200], [300, 120, 380, 170]])
    labels = Objects(
        np.array(["Car"] * n), np.zeros(n), np.zeros(n, np.int64), np.full(n, 0.5), box,
        np.tile([1.5, 1.6, 4.0], (n, 1)), np.array([[0, 1.7, 15], [5, 1.7, 25.0]]),
        np.full(n, 0.3), np.full(n, np.nan),
    )  # fmt: skip
    for i in range(3):
        write_labels(tmp_path / "label_2" / f"00000{i}.txt", labels)
        found = Objects(*(getattr(labels, f.name)[:1] for f in dataclasses.fields(Objects)))
        found = dataclasses.replace(found, score=np.array([0.9 - 0.1 * i]))
        write_results(tmp_path / "found" / f"00000{i}.txt", found)
    return evaluate_kitti.Config(
        labels=tmp_path / "label_2", detections=tmp_path / "found", out=tmp_path / "ap.json"
    )


def test_table_and_record(
    config: evaluate_kitti.Config, capsys: pytest.CaptureFixture[str]
) -> None:
    record = evaluate_kitti.main(config)
    assert config.out is not None
    written = json.loads(config.out.read_text())
    assert written["frames"] == 3 and written["objects"]["Car"] == [6, 6, 6]
    by_name = {(r["class"], r["metric"], r["points"]): r for r in record["rows"]}
    # Three hits, no false alarm: precision 1 at three of the recall steps.
    for metric in ("2d", "orientation", "bev", "3d"):
        assert by_name["Car", metric, 11]["easy"] == pytest.approx(100 / 11)
        assert by_name["Car", metric, 40]["hard"] == pytest.approx(100 * 2 / 40)
    text = capsys.readouterr().out
    assert "AP R11 [%]                  easy  moderate    hard" in text
    assert "Car: 3 detections; objects 6 / 6 / 6" in text
    assert "Car: fewer than 41 objects; R40 cannot exceed 12.5 / 12.5 / 12.5" in text


def test_missing_files_are_named(config: evaluate_kitti.Config, tmp_path: Path) -> None:
    (tmp_path / "split.txt").write_text("000001\n000007\n")
    with pytest.raises(FileNotFoundError, match=r"label_2.000007\.txt does not exist"):
        evaluate_kitti.main(dataclasses.replace(config, split=tmp_path / "split.txt"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no detection file"):
        evaluate_kitti.main(dataclasses.replace(config, detections=tmp_path / "empty"))


def test_bins_overlap_and_other_difficulties(
    config: evaluate_kitti.Config, capsys: pytest.CaptureFixture[str]
) -> None:
    options = dataclasses.replace(config, classes=("Car",), ranges=(0.0, 20.0), overlap=0.5)
    rows = evaluate_kitti.main(options)["rows"]
    assert len(rows) == 16 and [r["range"] for r in rows[8::4]] == [[0, 20], [20, None]]
    text = capsys.readouterr().out
    assert "AP R40 [%], 0 to 20 m " in text and "AP R40 [%], over 20 m " in text
    assert rows[11]["moderate"] > 0 and rows[15]["moderate"] == 0  # the far one is never found
    far = evaluate_kitti.main(dataclasses.replace(options, ranges=(), difficulty="distance"))
    assert far["objects"]["Car"] == [3, 6, 6]
    with pytest.raises(FileNotFoundError, match=r"velodyne.000000\.bin does not exist"):
        evaluate_kitti.main(dataclasses.replace(options, difficulty="points"))
    with pytest.raises(ValueError, match=r"overlap=1\.5: expected a share"):
        evaluate_kitti.main(dataclasses.replace(options, overlap=1.5))
