"""A trained network with all that its use needs: raw windows in, probabilities and warnings out."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from fusion._array_files import build, flatten, read_arrays, unflatten, write_arrays
from fusion._checks import check_mask, check_type
from fusion._inputs import check_windows
from fusion.config import ModelConfig
from fusion.data.dataset import Dataset, Scale, apply_scale
from fusion.loop import Corruption, test_output
from fusion.models import Params, export, predict
from fusion.monitor import MonitorParams, failure_probability, fit_monitor
from fusion.predictive_scores import fit_temperature
from fusion.train import TrainState

FORMAT = 1
"""Version of the file that `FittedARGate.save` writes."""
FAR = 0.5
"""A reading farther outside the training range than this share of it is flagged."""


def far_outside(x: Float[np.ndarray, "n c t"], scale: Scale) -> Bool[np.ndarray, "n c"]:
    """Which channels of which windows hold a reading far outside the training range (`FAR`)."""
    margin = FAR * (scale.high - scale.low)
    low, high = (scale.low - margin)[:, None], (scale.high + margin)[:, None]
    return ((x < low) | (x > high)).any(axis=-1)


class Prediction(NamedTuple):
    """What a fitted network says about a batch of windows; arrays on the host.

    Attributes:
        probabilities: of the classes, `[batch, class]`, temperature scaled.
        weights: fusion weights, `[batch, sensor]`; 0 for absent sensors.
        failure_probability: that a sensor has failed, `[batch, sensor]`; 1 for absent sensors.
        failed: sensors called failed at the stated false-alarm rate, and absent ones.
        out_of_range: sensors with readings far outside their training range.
    """

    probabilities: Float[np.ndarray, "b c"]
    weights: Float[np.ndarray, "b k"]
    failure_probability: Float[np.ndarray, "b k"]
    failed: Bool[np.ndarray, "b k"]
    out_of_range: Bool[np.ndarray, "b k"]


@functools.partial(jax.jit, static_argnums=0)
def classify(
    config: ModelConfig,
    main: Params,
    monitor: MonitorParams,
    temperature: Float[Array, ""],
    x: Float[Array, "b k t"],
) -> tuple[Array, Array, Array]:
    """Class probabilities, fusion weights and failure probabilities of scaled windows."""
    absent = jnp.any(jnp.isnan(x), axis=-1)
    out = predict(config, main, x, absent if config.reads_failed else None)
    calls = jnp.where(
        absent, jnp.ones_like(out.weights), failure_probability(monitor, out.features)
    )
    return jax.nn.softmax(out.logits / temperature, axis=-1), out.weights, calls


@dataclasses.dataclass(frozen=True, eq=False)
class FittedARGate:
    """A trained network, the scale and names of its sensors, and its calibration.

    Attributes:
        config: the network; params: of the main model (`fusion.export`).
        scale: training range of every channel, in the units of the sensors.
        channels, classes: names, in the order of the arrays.
        monitor: tells failed sensors; false_alarm_rate: what its thresholds stand for.
        temperature: logits are divided by it, so that probabilities are calibrated.
    """

    config: ModelConfig
    params: Params
    scale: Scale
    channels: tuple[str, ...]
    classes: tuple[str, ...]
    monitor: MonitorParams
    false_alarm_rate: float
    temperature: float

    def predict(
        self,
        x: Any,
        *,
        channels: Sequence[str] | None = None,
        available: Any = None,
    ) -> Prediction:
        """Classify raw windows.

        Args:
            x: `[batch, sensor, time]` in the units of the training data; NaN in a window means
                that the sensor sent nothing.
            channels: names of the sensors of `x`, checked against those of training.
            available: False for sensors that sent nothing, beside those with NaN.

        Raises:
            TypeError: `x` does not hold numbers, `available` no truth values.
            ValueError: no window, wrong shape, other channel names, infinite readings.
        """
        raw = _numbers(x)
        if channels is not None and tuple(channels) != self.channels:
            raise ValueError(
                f"channels={list(channels)}: expected {list(self.channels)}; put the sensors in "
                "this order"
            )
        check_windows(self.config, raw)
        if not len(raw):
            raise ValueError(
                f"x.shape={raw.shape}: expected one window or more; leave the call out"
            )
        if np.isinf(raw).any():
            window, sensor, _ = np.argwhere(np.isinf(raw))[0]
            raise ValueError(
                f"x[{window}, {sensor}]=window with infinity: expected finite readings of "
                f"{self.channels[sensor]!r}; use NaN for readings that are missing"
            )
        absent = np.isnan(raw).any(axis=-1)
        if available is not None:
            there = np.asarray(available)
            check_mask("available", there, absent.shape)
            absent |= ~there.astype(bool)
        scaled = apply_scale(raw, self.scale)
        scaled = np.where(absent[:, :, None], np.float32(np.nan), scaled)
        arrays = classify(
            self.config, self.params, self.monitor, jnp.float32(self.temperature), scaled
        )
        probabilities, weights, calls = map(np.asarray, arrays)
        far = far_outside(raw, self.scale) & ~absent
        failed = absent | (calls > np.asarray(self.monitor.threshold))
        return Prediction(probabilities, weights, calls, failed, far)

    def save(self, path: str | Path) -> None:
        """Write one `.npz` file without pickled objects; a reader sees the old file or the new."""
        arrays = {f"params/{name}": value for name, value in flatten(self.params).items()}
        arrays |= {f"monitor/{n}": np.asarray(v) for n, v in self.monitor._asdict().items()}
        arrays |= {"scale/low": self.scale.low, "scale/high": self.scale.high}
        header = {
            "format": FORMAT,
            "config": dataclasses.asdict(self.config),
            "channels": self.channels,
            "classes": self.classes,
            "false_alarm_rate": self.false_alarm_rate,
            "temperature": self.temperature,
        }
        write_arrays(Path(path), header, arrays)

    @classmethod
    def load(cls, path: str | Path) -> FittedARGate:
        """Read a file of `save`.

        Raises:
            FileNotFoundError: it is not there.
            ValueError: it is no such file, or one of another version.
        """
        header, held = read_arrays(Path(path))
        if header["format"] != FORMAT:
            raise ValueError(
                f"path={str(path)!r} of format {header['format']}: expected format {FORMAT}; "
                "read one of sensors of unequal shapes with FittedSensors.load, or install the "
                "version that wrote it"
            )
        parts: dict[str, dict[str, np.ndarray]] = {"params": {}, "monitor": {}, "scale": {}}
        for name, value in held.items():
            part, _, rest = name.partition("/")
            parts[part][rest] = value
        return cls(
            config=build(ModelConfig, header["config"]),
            params=unflatten(parts["params"]),
            scale=Scale(**parts["scale"]),
            channels=tuple(header["channels"]),
            classes=tuple(header["classes"]),
            monitor=MonitorParams(**{n: jnp.asarray(v) for n, v in parts["monitor"].items()}),
            false_alarm_rate=header["false_alarm_rate"],
            temperature=header["temperature"],
        )


def _numbers(x: Any) -> np.ndarray:
    """Readings as an array."""
    try:
        raw = np.asarray(x)
    except ValueError:
        raise ValueError(
            "x=sequences of unequal length: expected windows [batch, sensor, time] of one length; "
            "cut them to it"
        ) from None
    if raw.dtype.kind not in "fiu":
        raise TypeError(f"x.dtype={raw.dtype}: expected numbers; convert the readings first")
    return raw


def finish(
    model: ModelConfig,
    state: TrainState,
    data: Dataset,
    noise: Corruption,
    *,
    key: Key[Array, ""],
    false_alarm_rate: float = 0.01,
) -> FittedARGate:
    """Make a trained network ready for use: calibrate it on held-out rows.

    Args:
        model: as in `fit`.
        state: trained.
        data: its test rows calibrate, so give `validation_split(data)`, never the test rows that
            will be reported on.
        noise: the sensor failures that the probabilities are to be right under.
        key: of the simulated failures.
        false_alarm_rate: share of windows of a working sensor in which it is called failed.

    Returns:
        The network with temperature, and with a monitor trained on failures of every kind.

    Raises:
        ValueError: the network and the data set disagree in shape.
        TypeError: `data` is no data set, `state` no `TrainState`, `noise` no `Corruption`.
    """
    check_type("data", data, Dataset, "give validation_split(data)")
    output = test_output(model, state, data, noise, key=key)
    main = export(state.params)
    monitor = fit_monitor(
        model,
        main,
        jnp.asarray(data.test_x),
        key=jax.random.fold_in(key, 5),
        false_alarm_rate=false_alarm_rate,
    )
    return FittedARGate(
        config=model,
        params=jax.tree.map(jnp.asarray, main),
        scale=data.scale,
        channels=data.channels,
        classes=data.classes,
        monitor=monitor,
        false_alarm_rate=false_alarm_rate,
        temperature=fit_temperature(output.logits, output.labels),
    )
