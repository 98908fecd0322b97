"""The command that shows a stream, and trainings on one's own windows."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from fusion.data.own_file import load_file, read_recording
from fusion.fitted import FittedARGate
from snn_fusion_failure.commands import train_argate, watch_sensors
from snn_fusion_failure.commands.argate_runs import Config as TrainConfig
from snn_fusion_failure.runs.command import run_command

# optax's Adam raises a float to an integer power, which strict promotion forbids.
pytestmark = pytest.mark.relaxed


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("watch")
    config = watch_sensors.Config(
        preset="quick", samples=44, save=folder / "net.npz", picture=folder / "watch.gif"
    )
    return folder, watch_sensors.main(config)


def test_a_network_is_trained_watched_kept_and_drawn(shown: tuple[Path, dict]) -> None:
    folder, found = shown
    assert found["ms_per_sample"] > 0.0
    assert (folder / "watch.gif").read_bytes()[:3] == b"GIF"
    assert FittedARGate.load(folder / "net.npz").channels[0] == "sensor_0"


def test_a_recording_from_a_file_is_watched_with_its_lost_samples(
    shown: tuple[Path, dict], tmp_path: Path
) -> None:
    folder, _ = shown
    names = FittedARGate.load(folder / "net.npz").channels
    rows = np.random.default_rng(0).normal(size=(40, len(names)))
    lines = [",".join(reversed(names))]
    lines += [",".join(f"{v:.3f}" for v in reversed(row)) for row in rows]
    cells = lines[20].split(",")
    lines[20] = ",".join(["", *cells[1:]])  # the last sensor's
    path = tmp_path / "stream.csv"
    path.write_text("\n".join(lines))
    read = read_recording(path, names)
    assert np.isnan(read[19, -1]) and read[0, 0] == pytest.approx(rows[0, 0], abs=1e-3)
    config = watch_sensors.Config(model=folder / "net.npz", recording=path)
    assert names[-1] in watch_sensors.main(config)["failed_sensors"]


def test_bad_streams_are_refused_with_their_line(shown: tuple[Path, dict], tmp_path: Path) -> None:
    folder, _ = shown
    path = tmp_path / "stream.csv"
    path.write_text("a,b\n1,2\n3,x\n")
    with pytest.raises(ValueError, match="line 3"):
        read_recording(path, ("a", "b"))
    with pytest.raises(ValueError, match="line 1"):
        read_recording(path, ("a", "c"))
    path.write_text(",".join(FittedARGate.load(folder / "net.npz").channels) + "\n")
    config = watch_sensors.Config(model=folder / "net.npz", recording=path)
    with pytest.raises(ValueError, match="recording of 0 samples"):
        watch_sensors.main(config)
    with pytest.raises(ValueError, match="--recording"):
        watch_sensors.main(dataclasses.replace(config, recording=None))


def test_a_dead_sensor_that_is_found_is_not_a_failed_command(shown: tuple[Path, dict]) -> None:
    _, found = shown
    run_command(watch_sensors.Config, lambda _: found, description="", argv=[])


@pytest.mark.parametrize(
    ("given", "text"),
    [({"fail": 9}, "fail=9: expected 0..5"), ({"samples": 8}, "recording of 8 samples")],
)
def test_nothing_is_trained_for_what_cannot_be_shown(
    given: dict[str, int], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def train(*_: object) -> None:
        raise AssertionError("a network was trained first")

    monkeypatch.setattr(watch_sensors, "train", train)
    with pytest.raises(ValueError, match=text):
        watch_sensors.main(watch_sensors.Config(preset="quick", **given))


@pytest.mark.slow
def test_own_windows_are_trained_on_from_the_shell(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    y = rng.integers(0, 2, 200)
    x = rng.normal(size=(200, 3, 1)) + 2.0 * y[:, None, None]
    np.savez(tmp_path / "my.npz", x=x, y=y, channels=["a", "b", "c"])
    config = TrainConfig(data=tmp_path / "my.npz", preset="quick", out=tmp_path / "run")
    found = train_argate.main(dataclasses.replace(config, protocol="clean"))
    assert found["cases"]["clean"]["accuracy"] > 80.0
    assert found["cases"]["clean"]["source"] is None
    # The network that was scored is kept: the same accuracy on the same rows, in their own units.
    assert found["networks"] == {"clean": "model.npz"}
    fitted = FittedARGate.load(tmp_path / "run" / "model.npz")
    assert fitted.channels == ("a", "b", "c") and fitted.classes == ("0", "1")
    data = load_file(tmp_path / "my.npz")
    low, high = data.scale.low[:, None], data.scale.high[:, None]
    answer = fitted.predict((data.test_x + 1.0) / 2.0 * (high - low) + low)
    hit = (answer.probabilities.argmax(1) == data.test_y).mean()
    assert 100.0 * hit == pytest.approx(found["accuracy"], abs=1e-9)
