"""What the detector's commands refuse, keep to, and hold in memory; nothing here is compiled."""

from __future__ import annotations

import dataclasses
import weakref
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fusion.detection.learning import cache, fitting
from fusion.detection.learning.cache import open_cache, prepare_cache
from fusion.detection.learning.training import DetectorState
from fusion.detection.network.proposals import Detections
from snn_fusion_failure.commands import detector_evaluation
from snn_fusion_failure.commands import detector_options as choices
from snn_fusion_failure.commands import detector_runs as runs
from snn_fusion_failure.commands import train_detector as command
from snn_fusion_failure.runs import open_run
from tests._scripts import load_script
from tests.snn_fusion_failure.test_train_detector import write_frame

bench = load_script("benchmarks/bench_detector")

FRAMES = tuple(f"{i:06d}" for i in range(5))


@pytest.fixture()
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "kitti"
    for i, name in enumerate(FRAMES):
        write_frame(folder, name, i)
    (folder / "ImageSets").mkdir()
    (folder / "ImageSets" / "train.txt").write_text("\n".join(FRAMES[:2]))
    (folder / "ImageSets" / "val.txt").write_text("\n".join(FRAMES))
    prepare_cache(folder, folder / "cache_tiny", "tiny", splits=("train", "val"), any_size=True)
    return folder


class _Began(Exception):
    """Training would begin here."""


def test_a_training_keeps_to_its_batch_and_precision(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def began(*_: Any, **named: Any) -> None:
        raise _Began(named["devices"])

    monkeypatch.setattr(fitting, "fit_detector", began)
    run = tmp_path / "run"
    first = choices.Train(
        root, "avod", "tiny", batch_size=2, changes=("detector.precision=bfloat16",), out=run
    )
    with pytest.raises(ValueError, match="batch_size=2: expected a multiple of devices=4"):
        command.train(dataclasses.replace(first, devices=4))
    with pytest.raises(ValueError, match=r"devices=64: expected at most \d+, the local devices"):
        command.train(dataclasses.replace(first, devices=64, batch_size=64))
    assert not run.exists()  # the same command with another number need not overwrite anything
    with pytest.raises(_Began, match="1"):
        command.train(first)

    again = dataclasses.replace(first, resume=True)
    with pytest.raises(_Began):
        command.train(again)
    with pytest.raises(ValueError, match=r"other settings \(batch_size: 2 -> 4\)"):
        command.train(dataclasses.replace(again, batch_size=4))
    with pytest.raises(ValueError, match=r"other settings \(changes: .*bfloat16.* -> \[\]\)"):
        command.train(dataclasses.replace(again, changes=()))
    # Devices move the rounding alone: another machine may go on.
    monkeypatch.setattr("jax.local_devices", lambda: [object(), object()])
    monkeypatch.setattr("fusion.detection.learning.sharding.Mesh", lambda *_: None)
    with pytest.raises(_Began, match="2"):
        command.train(dataclasses.replace(again, devices=2))


def test_rates_of_a_command_line_are_checked(root: Path) -> None:
    held = open_cache(root / "cache_tiny")
    plain = choices.Train(root, "avod", "tiny")
    for changed, message in (
        ({"learning_rate": 0.0}, "learning_rate=0.0: expected a finite number above 0"),
        ({"learning_rate": float("nan")}, "learning_rate=nan: expected a finite number above 0"),
        ({"changes": ("params.l2=-1e-4",)}, "l2=-0.0001: expected a finite number of at least 0"),
        ({"changes": ("params.l2_dense=-1",)}, "l2_dense=-1.*: expected a finite number of at"),
        ({"changes": ("params.clip_norm=0",)}, "clip_norm=0.*: expected a finite number above 0"),
    ):
        with pytest.raises(ValueError, match=message):
            runs.build(dataclasses.replace(plain, **changed), held)  # type: ignore[arg-type]


def test_evaluation_holds_one_frame_at_a_time(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The validation list at the size `paper` is 7 GB."""
    images: list[weakref.ref[np.ndarray]] = []
    alive: list[int] = []
    read = cache.read_example

    def counted(folder: Path, name: str) -> Any:
        alive.append(sum(image() is not None for image in images))
        example = read(folder, name)
        images.append(weakref.ref(example.image))
        return example

    def nothing(*_: Any) -> Detections:
        n = 4
        return Detections(
            np.zeros((1, n, 7), np.float32), np.zeros((1, n), np.float32), np.zeros((1, n), bool),
            np.full((1, 2), 0.5, np.float32), np.full((1, 2), np.nan, np.float32),
        )  # fmt: skip

    monkeypatch.setattr(cache, "read_example", counted)
    monkeypatch.setattr(fitting, "failed_inputs", lambda config, example, **_: example)
    monkeypatch.setattr(fitting, "_detect", lambda config: nothing)
    state = DetectorState({"main": {}}, {}, (), np.zeros((), np.int32))  # type: ignore[arg-type]
    monkeypatch.setattr(detector_evaluation, "load_run", lambda folder, setup: state)
    trained = dataclasses.asdict(choices.Train(root, "avod", "tiny"))
    kept = {k: v for k, v in trained.items() if k not in runs.NOT_SETTINGS}
    open_run(tmp_path / "run", kept)
    found = command.evaluate(choices.Eval(root, "avod", "tiny", run=tmp_path / "run", pictures=0))
    assert found["frames"] == len(FRAMES) and found["3d_moderate_r40"] == 0.0
    # The one before, while the next is read.
    assert len(alive) == len(FRAMES) and max(alive) <= 1


def test_a_benchmarked_step_must_be_finite() -> None:
    def step(loss: float, mean: float) -> tuple[Any, ...]:
        state = SimpleNamespace(opt_state={"mu": np.array([0.0, mean])}, params={"a": np.ones(2)})
        return state, SimpleNamespace(total=np.float32(loss)), None

    assert bench.check_step(step(2.5, 1.0)) == 2.5
    with pytest.raises(FloatingPointError, match=r"'mu'.* is not finite after a step"):
        bench.check_step(step(2.5, np.nan))
    with pytest.raises(FloatingPointError, match="the loss of a step is nan"):
        bench.check_step(step(np.nan, 1.0))
