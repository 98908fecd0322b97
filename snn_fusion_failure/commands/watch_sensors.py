"""Watch a fitted network on a recorded stream: classes, fusion weights and dead sensors, live.

    python scripts/watch_sensors.py --dataset simulated
    python scripts/watch_sensors.py --model model.npz --recording stream.csv --picture watch.gif

The window slides one sample at a time; bars in the terminal show what each sensor is worth and how
likely it has failed. Without `--model` a network is trained first (simulated: seconds; har: a
minute), and halfway through its recording one sensor is replaced by noise. The line at the end
tells the time per sample.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snn_fusion_failure.commands.sensor_streams import (
    break_sensor,
    check_length,
    failing_sensor,
    load_stream,
)
from snn_fusion_failure.runs import enable_compilation_cache, print_result
from snn_fusion_failure.runs.command import run_command
from snn_fusion_failure.runs.console import live_text

if TYPE_CHECKING:
    import numpy as np

    from fusion.fitted import FittedARGate, Prediction

BAR = 20
"""Characters of a full bar."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Show what a network makes of a stream."""

    model: Path | None = None
    """File of FittedARGate.save; trained on the data set when left out."""
    dataset: str = "simulated"
    """simulated or har: what the network is trained on and whose test rows are the recording."""
    recording: Path | None = None
    """CSV with a header of channel names, one sample a line, empty cells for lost samples."""
    preset: str = "paper"
    """Of the training: paper or quick."""
    fail: int | None = None
    """Sensor that turns to noise halfway (0 is the first); the last when left out."""
    samples: int = 512
    """Samples of the data set's recording."""
    rate: float = 0.0
    """Samples per second to show; 0 as fast as they come."""
    picture: Path | None = None
    """Moving picture (.gif) of the same."""
    save: Path | None = None
    """Keep the trained network here."""
    data_dir: Path | None = None
    seed: int = 0


def train(config: Config, data: Any) -> FittedARGate:
    """A network with its monitor and temperature, trained with half of the sensors failing."""
    import jax

    from fusion import Corruption, finish, fit, preset, random_failing, validation_split

    held_out = validation_split(data)
    settings = preset(held_out, "argate_plus", config.preset)
    protocol = random_failing(data.channels, data.n_channels // 2)
    noise, key = Corruption(protocol, protocol), jax.random.key(config.seed)
    state = fit(*settings, held_out, noise, key=key).state
    return finish(settings.model, state, held_out, noise, key=key)


def view(fitted: FittedARGate, answer: Prediction, sample: int) -> str:
    """One frame for the terminal."""
    best = int(answer.probabilities[0].argmax())
    share = answer.probabilities[0, best]
    width = max(map(len, fitted.channels))
    lines = [f"sample {sample}: {fitted.classes[best]} ({100 * share:.0f} %)", ""]
    for k, name in enumerate(fitted.channels):
        bar = "#" * round(BAR * float(answer.weights[0, k]))
        risk = float(answer.failure_probability[0, k])
        state = "FAILED" if answer.failed[0, k] else ""
        lines.append(f"{name:<{width}} |{bar:<{BAR}}| failed {100 * risk:3.0f} %  {state}".rstrip())
    return "\n".join(lines)


def main(config: Config) -> dict[str, Any]:
    """Train or read a network, run the recording past it, show and time it."""
    enable_compilation_cache()
    from fusion.data.own_file import read_recording
    from fusion.fitted import FittedARGate
    from fusion.streaming import SensorStream

    if config.model is not None and config.recording is None:
        raise ValueError(
            f"model={str(config.model)!r} without recording: expected --recording with it; give "
            "the samples that the network is to see"
        )
    # What can be refused is refused before a network is trained.
    if config.model is None:
        data, own = load_stream(config.dataset, config.data_dir, config.samples)
        stream = (
            own if config.recording is None else read_recording(config.recording, data.channels)
        )
        sensor = failing_sensor(config.fail, data.n_channels) if config.recording is None else None
        check_length(stream, data.n_time)
        fitted = train(config, data)
        if config.save is not None:
            fitted.save(config.save)
        if sensor is not None:
            stream = break_sensor(stream, fitted.scale, sensor, config.seed)
    else:
        assert config.recording is not None
        fitted = FittedARGate.load(config.model)
        stream = read_recording(config.recording, fitted.channels)
        check_length(stream, fitted.config.n_times)
    shown = follow(config, fitted, SensorStream(fitted), stream)
    print_result(
        samples=len(stream),
        ms_per_sample=shown["ms_per_sample"],
        failed=",".join(shown["failed_sensors"]) or "none",
    )
    return shown


def follow(
    config: Config, fitted: FittedARGate, stream: Any, samples: np.ndarray
) -> dict[str, Any]:
    """Push every sample, show what comes back, and draw it where asked for."""
    import numpy as np

    took: list[float] = []
    weights, risks = [], []
    answer = None
    with live_text() as show:
        for number, sample in enumerate(samples):
            started = time.perf_counter()
            answer = stream.push(sample)
            if answer is None:
                continue
            took.append(time.perf_counter() - started)
            weights.append(answer.weights[0])
            risks.append(answer.failure_probability[0])
            show(view(fitted, answer, number))
            if config.rate > 0.0:
                time.sleep(max(0.0, 1.0 / config.rate - took[-1]))
    assert answer is not None
    if config.picture is not None:
        from snn_fusion_failure.records.plots import plot_stream

        config.picture.parent.mkdir(parents=True, exist_ok=True)
        moving = plot_stream(np.asarray(weights), np.asarray(risks), fitted.channels)
        moving.save(config.picture, writer="pillow", fps=20)
    # The first answer compiles.
    return {
        "ms_per_sample": 1e3 * float(np.median(took[1:] or took)),
        # Not "failed", by which a command says that its own work did.
        "failed_sensors": [c for c, f in zip(fitted.channels, answer.failed[0], strict=True) if f],
    }


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, argv=argv, prog=prog)
