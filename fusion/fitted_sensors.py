"""A trained network of sensors of unequal shapes, in use: raw windows in, one file on the disk."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fusion._array_files import build, flatten, read_arrays, unflatten, write_arrays
from fusion._checks import check_mask
from fusion.data.csv_folder import SensorFolder, TargetKind
from fusion.data.dataset import Scale, apply_scale
from fusion.fitted import far_outside
from fusion.sensor_network import FolderConfig, fusion_of

FORMAT = "sensors 1"
"""Kind and version of the file that `FittedSensors.save` writes."""


class SensorPrediction(NamedTuple):
    """What the network says about a batch of windows; arrays on the host.

    Attributes:
        output: probabilities of the classes `[row, class]` or of the labels `[row, label]`, or the
            numbers in their own units `[row, column]`.
        weights: fusion weights, `[row, sensor]`; 0 for absent sensors.
        available: sensors that sent something, `[row, sensor]`.
        out_of_range: sensors with readings far outside their training range.
    """

    output: Float[np.ndarray, "n c"]
    weights: Float[np.ndarray, "n k"]
    available: Bool[np.ndarray, "n k"]
    out_of_range: Bool[np.ndarray, "n k"]


@functools.partial(jax.jit, static_argnums=(0, 1))
def _apply(
    config: FolderConfig,
    sizes: tuple[int, int],
    params: Any,
    readings: list[Array],
    available: Array,
) -> tuple[Array, Array]:
    model = fusion_of(config, *sizes, training=False)
    out: Any = model.apply({"params": params}, readings, available)
    return out.output, out.weights


@dataclasses.dataclass(frozen=True, eq=False)
class FittedSensors:
    """A network of `fusion.sensor_network` with the names, scales and units of its sensors.

    Attributes:
        config: the network; params: of it, without auxiliary heads and targets.
        sensors: their names; channels: of each; lengths: samples of a window of each.
        kind: of the target; names: of its classes or columns.
        scales: training range of each sensor's channels.
        centre, spread: of the numbers.
    """

    config: FolderConfig
    params: Any
    sensors: tuple[str, ...]
    channels: tuple[tuple[str, ...], ...]
    lengths: tuple[int, ...]
    kind: TargetKind
    names: tuple[str, ...]
    scales: tuple[Scale, ...]
    centre: np.ndarray
    spread: np.ndarray

    def predict(self, readings: Sequence[Any], *, available: Any = None) -> SensorPrediction:
        """Predict from raw windows.

        Args:
            readings: for each sensor `[row, channel, sample]` in the units of training; a window
                with NaN is absent. `fusion.data.csv_folder.read_windows` reads them.
            available: `[row, sensor]`, False for sensors that sent nothing, beside those with NaN.

        Raises:
            ValueError: another number of sensors, another shape of one, infinite readings.
            TypeError: `available` without truth values.
        """
        raw = self._checked(readings)
        there = np.stack([~np.isnan(x).any(axis=(1, 2)) for x in raw], axis=1)
        if available is not None:
            given = np.asarray(available)
            check_mask("available", given, there.shape)
            there &= given.astype(bool)
        scaled, far = [], np.zeros_like(there)
        for s, (x, scale) in enumerate(zip(raw, self.scales, strict=True)):
            far[:, s] = there[:, s] & far_outside(x, scale).any(axis=1)
            present = there[:, s, None, None]
            scaled.append(np.where(present, apply_scale(x, scale), 0.0).astype(np.float32))
        sizes = len(self.sensors), len(self.names)
        found = _apply(self.config, sizes, self.params, scaled, there)
        output, weights = np.asarray(found[0], np.float64), np.asarray(found[1])
        return SensorPrediction(self._told(output), weights, there, far)

    def _checked(self, readings: Sequence[Any]) -> list[np.ndarray]:
        if len(readings) != len(self.sensors):
            raise ValueError(
                f"readings={len(readings)} sensors: expected {list(self.sensors)}; give one array "
                "for each, in this order"
            )
        arrays = [np.asarray(x, np.float64) for x in readings]
        n = len(arrays[0])
        for name, channels, length, x in zip(
            self.sensors, self.channels, self.lengths, arrays, strict=True
        ):
            wanted = (n, len(channels), length)
            if x.shape != wanted or n == 0:
                raise ValueError(
                    f"readings[{name!r}].shape={x.shape}: expected {wanted}, rows, channels "
                    f"{list(channels)} and samples; bring the windows to it"
                )
            if np.isinf(x).any():
                raise ValueError(
                    f"readings[{name!r}]=windows with infinity: expected finite readings; use NaN "
                    "for those that are missing"
                )
        return arrays

    def _told(self, output: np.ndarray) -> np.ndarray:
        if self.kind == "numbers":
            return np.asarray(output * self.spread + self.centre)
        if self.kind == "labels":
            return np.asarray(jax.nn.sigmoid(output))
        return np.asarray(jax.nn.softmax(output, axis=-1))

    def save(self, path: str | Path) -> None:
        """Write one `.npz` file without pickled objects; a reader sees the old file or the new."""
        arrays = {f"params/{name}": value for name, value in flatten(self.params).items()}
        arrays |= {"centre": self.centre, "spread": self.spread}
        for s, scale in enumerate(self.scales):
            arrays |= {f"scale/{s}/low": scale.low, f"scale/{s}/high": scale.high}
        kept = ("sensors", "channels", "lengths", "kind", "names")
        header = {name: getattr(self, name) for name in kept}
        header |= {"format": FORMAT, "config": dataclasses.asdict(self.config)}
        write_arrays(Path(path), header, arrays)

    @classmethod
    def load(cls, path: str | Path) -> FittedSensors:
        """Read a file of `save`.

        Raises:
            FileNotFoundError: it is not there.
            ValueError: it is no such file.
        """
        header, held = read_arrays(Path(path))
        if header.get("format") != FORMAT:
            raise ValueError(
                f"path={str(path)!r} of format {header.get('format')!r}: expected {FORMAT!r}, a "
                "file of FittedSensors.save; read one of another kind with its own class"
            )
        params = {n[len("params/") :]: v for n, v in held.items() if n.startswith("params/")}
        sensors = range(len(header["sensors"]))
        return cls(
            config=build(FolderConfig, header["config"]),
            params=unflatten(params),
            sensors=tuple(header["sensors"]),
            channels=tuple(map(tuple, header["channels"])),
            lengths=tuple(header["lengths"]),
            kind=header["kind"],
            names=tuple(header["names"]),
            scales=tuple(Scale(held[f"scale/{s}/low"], held[f"scale/{s}/high"]) for s in sensors),
            centre=held["centre"],
            spread=held["spread"],
        )


def finish_sensors(config: FolderConfig, params: Any, data: SensorFolder) -> FittedSensors:
    """Make a trained network ready for use.

    Args:
        config, params, data: as given to and got from `fusion.sensor_network.fit`.
    """
    main = {
        name: jax.tree.map(jnp.asarray, tree)
        for name, tree in params["model"].items()
        if not name.startswith(("auxiliary_heads", "targets"))
    }
    return FittedSensors(
        config=config,
        params=main,
        sensors=data.sensors,
        channels=data.channels,
        lengths=tuple(x.shape[2] for x in data.train.readings),
        kind=data.kind,
        names=tuple(data.names),
        scales=data.scales,
        centre=np.asarray(data.centre, np.float64),
        spread=np.asarray(data.spread, np.float64),
    )
