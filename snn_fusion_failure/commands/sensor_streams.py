"""The recordings that `watch-sensors` shows: test windows in a row, with a sensor that fails."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from fusion.data.dataset import Dataset, Scale


def load_stream(dataset: str, data_dir: Path | None, samples: int) -> tuple[Dataset, np.ndarray]:
    """A data set and a recording of its test windows, `[sample, sensor]` in raw units.

    Raises:
        ValueError: its windows hold one sample each, which makes no stream.
    """
    import numpy as np

    from fusion import load

    data = load(dataset, data_dir)
    if data.n_time == 1:
        raise ValueError(
            f"dataset={dataset!r}: expected simulated or har, whose windows make a stream"
        )
    # Windows of one person overlap by half in HAR; simulated ones stand alone.
    step = data.n_time // 2 if dataset == "har" else data.n_time
    windows = data.test_x[data.test_group == data.test_group[0]][:, :, data.n_time - step :]
    stream = np.concatenate(list(windows), axis=1).T[:samples]
    low, high = data.scale.low, data.scale.high
    return data, (stream + 1.0) / 2.0 * (high - low) + low


def failing_sensor(fail: int | None, n_sensors: int) -> int:
    """The sensor that is to fail.

    Raises:
        ValueError: there is no such sensor.
    """
    sensor = n_sensors - 1 if fail is None else fail
    if not 0 <= sensor < n_sensors:
        raise ValueError(f"fail={sensor}: expected 0..{n_sensors - 1}; name a sensor")
    return sensor


def check_length(stream: np.ndarray, n_times: int) -> None:
    """Refuse a recording that is shorter than one window."""
    if len(stream) < n_times:
        raise ValueError(
            f"recording of {len(stream)} samples: expected at least {n_times}, one window; give a "
            "longer one"
        )


def break_sensor(stream: np.ndarray, scale: Scale, sensor: int, seed: int) -> np.ndarray:
    """The recording with one sensor's second half replaced by uniform noise of its range."""
    import numpy as np

    broken = stream.copy()
    half = len(stream) // 2
    low, high = scale.low[sensor], scale.high[sensor]
    broken[half:, sensor] = np.random.default_rng(seed).uniform(low, high, len(stream) - half)
    return broken
