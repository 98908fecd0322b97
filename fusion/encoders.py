"""Unisensory encoders: one small network per sensor, all of them computed as one batched matmul.

Every array has the sensor (branch) axis first, `[branch, batch, ...]`, see `fusion.stacked`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Literal, get_args

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fusion._checks import check_choice, check_count, check_counts, check_type
from fusion.reversible.config import ReversibleConfig
from fusion.reversible.encoder import ReversibleEncoder
from fusion.series_readout import pooled_features
from fusion.spiking.config import SpikingConfig
from fusion.spiking.encoder import SpikingEncoder
from fusion.stacked import Backend, conv1d, he_init, stacked_dense
from fusion.tables import TableEncoder

SeriesKind = Literal["conv", "spiking", "reversible"]
ScalarKind = Literal["fourier", "table"]


@dataclasses.dataclass(frozen=True)
class EncoderConfig:
    """Sizes of the unisensory encoders (shared by all models that are compared).

    Attributes:
        features: width D of the feature vector of one sensor (not read by spiking encoders, whose
            last layer is as wide as its neurons are many).
        conv_features: channels of the two convolutions (series only).
        conv_kernels: their widths, in samples.
        conv_strides: their strides, in samples.
        spectral: add the path over the log power spectrum and moments (series only).
        frequencies: number of octaves of the Fourier features of a scalar (scalars only).
        levels: sorted readings that each sensor gave in training, one tuple per sensor (scalars
            only); adds the distance to the nearest of them, see `reading_levels`. Empty for none.
        scalar: `"fourier"` encodes a scalar by octaves of its value, `"table"` by a learned row
            for each of its levels, see `fusion.tables.TableEncoder`.
        ranks: share of training rows below each level, for the first rows of the tables.
        known_readings: a table gives a token of its own for readings that are no level.
        backend: how `conv1d` is computed; `"matmul"` for CPU, `"conv"` for accelerators.
        series: what encodes a sensor, `"conv"` the convolutions and Fourier features above,
            `"spiking"` the neurons of `spiking`, `"reversible"` the stages of `reversible`, both
            for series and for scalars.
        spiking: code, layers and neurons of the spiking encoders.
        reversible: stages of the reversible encoders.

    Raises:
        ValueError: sizes that cannot be built, or readings that are not sorted.
    """

    features: int = 64
    conv_features: tuple[int, int] = (16, 32)
    conv_kernels: tuple[int, int] = (8, 5)
    conv_strides: tuple[int, int] = (4, 2)
    spectral: bool = True
    frequencies: int = 8
    levels: tuple[tuple[float, ...], ...] = ()
    scalar: ScalarKind | str = "fourier"
    ranks: tuple[tuple[float, ...], ...] = ()
    known_readings: bool = True
    backend: Backend | str = "matmul"
    series: SeriesKind | str = "conv"
    spiking: SpikingConfig = dataclasses.field(default_factory=SpikingConfig)
    reversible: ReversibleConfig = dataclasses.field(default_factory=ReversibleConfig)

    def __post_init__(self) -> None:
        """Refuse sizes that cannot be built."""
        for name in ("features", "frequencies"):
            check_count(name, getattr(self, name))
        for name in ("conv_features", "conv_kernels", "conv_strides"):
            check_counts(name, getattr(self, name), size=2)
        check_choice("spectral", self.spectral, (True, False))
        check_choice("backend", self.backend, get_args(Backend))
        check_choice("series", self.series, get_args(SeriesKind))
        check_type("spiking", self.spiking, SpikingConfig, "build a SpikingConfig")
        check_type("reversible", self.reversible, ReversibleConfig, "build a ReversibleConfig")
        for k, row in enumerate(self.levels):
            if not row or not all(math.isfinite(v) for v in row) or sorted(set(row)) != list(row):
                raise ValueError(
                    f"levels[{k}]={row}: expected sorted, different, finite readings; make levels "
                    "with reading_levels"
                )
        check_choice("scalar", self.scalar, get_args(ScalarKind))
        check_choice("known_readings", self.known_readings, (True, False))
        if self.scalar == "table" and self.features < 3:
            raise ValueError(
                f"features={self.features}: expected at least 3 for a table, one of them flags "
                "unknown readings; raise it"
            )
        if self.ranks and [len(r) for r in self.ranks] != [len(r) for r in self.levels]:
            raise ValueError(
                f"ranks={len(self.ranks)} rows: expected one rank for each level; make ranks with "
                "reading_ranks"
            )

    @property
    def width(self) -> int:
        """Width of the feature vector that the encoder gives."""
        return self.spiking.features if self.series == "spiking" else self.features

    @property
    def learns_by_reward(self) -> bool:
        """Whether the synapses learn from the auxiliary losses instead of by gradients."""
        return self.series == "spiking" and self.spiking.learning == "reward_stdp"


class SeriesEncoder(nn.Module):
    """Encode windows of K sensors: two strided convolutions beside a log-spectrum path.

    `[branch, batch, time] -> [branch, batch, features]`. The convolutions see the series without
    its mean (their mean and maximum over time are kept); level and spread come from the moments.
    """

    config: EncoderConfig

    @nn.compact
    def __call__(self, x: Float[Array, "k b t"]) -> Float[Array, "k b f"]:
        """Return one feature vector per sensor and example."""
        config = self.config
        k = x.shape[0]
        h = 5.0 * (x - jnp.mean(x, axis=-1, keepdims=True))[..., None]
        for layer in range(2):
            width, features = config.conv_kernels[layer], config.conv_features[layer]
            shape = (k, width, h.shape[-1], features)
            kernel = self.param(f"conv{layer}_kernel", he_init, shape)
            bias = self.param(f"conv{layer}_bias", nn.initializers.zeros, (k, features))
            stride = config.conv_strides[layer]
            h = nn.relu(conv1d(h, kernel, bias, stride=stride, backend=config.backend))
        return pooled_features(self, h, x, config.features, spectral=config.spectral)


def readings_recur(x: Float[np.ndarray, "n k 1"]) -> bool:
    """Whether every sensor gives few distinct readings, each about eight times or more."""
    return all(8 * len(np.unique(x[:, k])) <= len(x) for k in range(x.shape[1]))


def reading_levels(
    x: Float[np.ndarray, "n k 1"], limit: int = 512
) -> tuple[tuple[float, ...], ...]:
    """The distinct readings of each scalar sensor in the training rows, for `EncoderConfig.levels`.

    Sensors on a digital bus give few distinct values; a reading between them is implausible. A
    sensor with more than `limit` values is thinned to that many quantiles and tells little.
    """
    levels = []
    for k in range(x.shape[1]):
        values = np.unique(x[:, k, 0])
        if len(values) > limit:
            values = values[np.linspace(0, len(values) - 1, limit).round().astype(int)]
        levels.append(tuple(float(v) for v in values))
    return tuple(levels)


def _novelty(x: Float[Array, "k b 1"], levels: tuple[tuple[float, ...], ...]) -> Array:
    """Logarithm of the distance to the nearest known reading, of order one."""
    longest = max(len(row) for row in levels)
    padded = [(*row, *(row[-1:] * (longest - len(row)))) for row in levels]
    known = jnp.asarray(np.asarray(padded, np.float32))
    distance = jnp.min(jnp.abs(x - known[:, None, :]), axis=-1, keepdims=True)
    return 0.25 * jnp.log(distance + 1e-6) + 2.0


def scalar_features(config: EncoderConfig, x: Float[Array, "k b 1"]) -> Float[Array, "k b c"]:
    """Octaves of each scalar, and how far it lies from the nearest known reading."""
    octaves = jnp.asarray(np.pi * 2.0 ** np.arange(-1, config.frequencies - 1), x.dtype)
    angle = x * octaves[None, None, :]
    parts = [x, jnp.sin(angle), jnp.cos(angle)]
    if config.levels:
        parts.append(_novelty(x, config.levels))
    return jnp.concatenate(parts, axis=-1)


class ScalarEncoder(nn.Module):
    r"""Encode K scalar sensors by Fourier features and a dense layer each.

    .. math:: \phi(x) = (x, \sin 2^{m}\pi x, \cos 2^{m}\pi x), \; m = -1 \ldots M-2

    `[branch, batch, 1] -> [branch, batch, features]`. A scalar that takes few or unevenly spread
    values is not separable by a narrow network on the value itself; octaves of it are.
    """

    config: EncoderConfig

    @nn.compact
    def __call__(self, x: Float[Array, "k b 1"]) -> Float[Array, "k b f"]:
        """Return one feature vector per sensor and example."""
        phi = scalar_features(self.config, x)
        return nn.relu(stacked_dense(self, "out", phi, self.config.features))


def encoder(config: EncoderConfig, n_times: int, name: str) -> nn.Module:
    """The encoder for windows of `n_times` samples: `ScalarEncoder` for one, else the series.

    Raises:
        ValueError: windows that the layers cannot read.
    """
    if config.series == "spiking":
        if n_times > 1 and n_times % config.spiking.stride:
            raise ValueError(
                f"n_times={n_times}: expected a multiple of {config.spiking.stride} samples, the "
                "strides of all spiking layers; change spiking.strides or cut the windows"
            )
        return SpikingEncoder(config.spiking, functools.partial(scalar_features, config), name=name)
    if config.series == "reversible":
        if n_times % config.reversible.squeeze:
            raise ValueError(
                f"n_times={n_times}: expected a multiple of {config.reversible.squeeze} samples, "
                "the squeezes of all reversible stages; change reversible.squeezes or cut the "
                "windows"
            )
        expand = functools.partial(scalar_features, config)
        sizes = config.reversible, config.features, config.spectral, expand
        return ReversibleEncoder(*sizes, name=name)
    shortest = config.conv_kernels[0] + config.conv_strides[0] * (config.conv_kernels[1] - 1)
    if n_times == 1 and config.scalar == "table":
        if not config.levels:
            raise ValueError(
                "levels=(): expected the readings that the tables are for; make levels with "
                "reading_levels"
            )
        parts = config.levels, config.ranks, config.features, config.known_readings
        return TableEncoder(*parts, name=name)
    if n_times == 1:
        return ScalarEncoder(config, name=name)
    if n_times < shortest:
        raise ValueError(
            f"n_times={n_times}: expected at least {shortest} samples for the convolutions; use "
            "longer windows or smaller conv_kernels"
        )
    return SeriesEncoder(config, name=name)
