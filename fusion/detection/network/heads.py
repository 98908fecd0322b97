"""What reads the feature maps: the first stage's head, the gate, the second stage's head."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion.detection.sensors.deviation import Clean, deviations
from fusion.gating import Normalizer, normalize

_LEAK = 0.1
_RARE = 4.0  # log odds that a sensor works whose readings are as clean ones in the mean
SENSORS = ("camera", "lidar")


class RpnHead(nn.Module):
    """Two towers over fused crops: is there an object, and where is it from the anchor.

    A 3x3 convolution over a 3x3 crop without padding has one output, so the tower's convolutions
    are dense layers.

    Source: Ku et al. (2018), section III-C.
    """

    width: int
    dropout: float

    @nn.compact
    def __call__(
        self, crops: Float[Array, "*b s s c"], train: bool
    ) -> tuple[Float[Array, "*b 2"], Float[Array, "*b 6"]]:
        """Scores of background and object, and six offsets, of each crop."""
        flat = crops.reshape(*crops.shape[:-3], -1)
        outputs = []
        for name, n in (("objectness", 2), ("offsets", 6)):
            x = flat
            for i in range(2):
                x = nn.relu(nn.Dense(self.width, name=f"{name}{i}")(x))
                x = nn.Dropout(self.dropout, deterministic=not train)(x)
            outputs.append(nn.Dense(n, name=name)(x))
        return outputs[0], outputs[1]


class CleanReadings(nn.Module):
    """How far a frame's statistics lie from those of clean training frames, sensor by sensor.

    Its numbers are fitted before training (`with_clean_readings`) and no gradient reaches them;
    until then they compare with nothing, mean 0 and deviation 1.
    """

    @nn.compact
    def __call__(self, statistics: tuple[Array, ...]) -> tuple[Array, ...]:
        """`deviations` `[b, n]` of each sensor, in their order."""
        found = []
        for sensor, given in zip(SENSORS, statistics, strict=True):
            n = given.shape[-1]
            mean = self.param(f"{sensor}_mean", nn.initializers.zeros, (n,))
            whiten = self.param(f"{sensor}_whiten", lambda _, shape: jnp.eye(shape[0]), (n, n))
            found.append(deviations(Clean(mean, whiten), given))
        return tuple(found)


class QualityHead(nn.Module):
    r"""Log odds that a sensor has failed: a weighted squared distance from clean readings.

    .. math:: \ell_k = \sum_i \log(1 + e^{a_{ki}}) \, q_{ki}^2 + b_k - 4

    :math:`q_{ki}` are the deviations of sensor k. No weight is negative, so that a reading farther
    from clean ones never looks healthier, in a way that no failure of the training was, either;
    equal weights, which training begins with, are the plain distance.

    Source: ours; a logistic regression that is monotonic as the lattice of the targets is.
    """

    @nn.compact
    def __call__(self, away: tuple[Float[Array, "b _"], ...]) -> Float[Array, "b 2"]:
        """Log odds that (camera, lidar) has failed."""
        zeros, found = nn.initializers.zeros, []
        for sensor, q in zip(SENSORS, away, strict=True):
            weights = self.param(f"{sensor}_weights", zeros, (q.shape[-1],))
            offset = self.param(f"{sensor}_bias", zeros, ())
            found.append(q**2 @ jax.nn.softplus(weights) + offset - _RARE)
        return jnp.stack(found, axis=-1)


def _bounded(log_odds: Array) -> Array:
    """What a gate reads of log odds: no failure is more of one than e^4 to 1; without gradient."""
    return jax.lax.stop_gradient(jnp.clip(log_odds, -_RARE, _RARE))


class MapGate(nn.Module):
    r"""Fusion weights of a frame from the one-channel map of each view and the raw readings.

    .. math:: w = N\Big(W_o \, \big[\mathrm{lrelu}\big(\textstyle\sum_k W_k p_k + b_k\big),
        \ell\big] + b_o\Big)

    :math:`p_k` are mean and standard deviation over the map of view k after two strided
    convolutions, :math:`\ell` the log odds of failures that `QualityHead` reads from the
    deviations of the raw readings (`CleanReadings`), at most 4 in size, :math:`N` the normalizer;
    rectifiers are leaky, since a gate whose few units have died weighs all frames alike.
    `init_detector` starts the last layer at zero, that is from equal weights, as AVOD fuses.

    Source: Shim (2020), section 3.3.2.2 and Figure 3.6 (the layers' sizes are not given).
    Deviation: the log odds; normalized maps do not hold what a failure changes most. The gate reads
    no deviations beside them: what it made of ones that no failure of the training moved would be
    chance.
    """

    width: int
    normalizer: Normalizer

    @nn.compact
    def __call__(
        self,
        maps: tuple[Array, ...],
        failed: Float[Array, "b k"] | None = None,
    ) -> Float[Array, "b k"]:
        """Weights of the views for every frame."""
        hidden = jnp.zeros((maps[0].shape[0], self.width))
        for k, x in enumerate(maps):
            for i, features in enumerate((8, 16)):
                conv = nn.Conv(features, (5, 5), strides=(4, 4), name=f"view{k}_conv{i}")
                x = nn.leaky_relu(conv(x), _LEAK)
            spread = jnp.sqrt(x.var(axis=(1, 2)) + 1e-6)
            pooled = jnp.concatenate([x.mean(axis=(1, 2)), spread], axis=-1)
            hidden = hidden + nn.Dense(self.width, name=f"view{k}")(pooled)
        hidden = nn.leaky_relu(hidden, _LEAK)
        if failed is not None:
            hidden = jnp.concatenate([hidden, _bounded(failed)], axis=-1)
        last = nn.Dense(len(maps), name="fusion")
        return normalize(last(hidden), self.normalizer)


class GridGate(nn.Module):
    """Fusion weights from the views' grids over the ground, as `MapGate` from its maps.

    Grids of many channels need no convolutions of their own: mean and deviation of each channel.
    """

    width: int
    normalizer: Normalizer

    @nn.compact
    def __call__(
        self,
        grids: tuple[Array, ...],
        failed: Float[Array, "b t"] | None = None,
        away: tuple[Array, ...] = (),
    ) -> Float[Array, "b k"]:
        """Weights of the views for every frame; the oracle's gate is told more than log odds, and
        reads the deviations, too."""
        parts = [x.mean(axis=(1, 2)) for x in grids]
        parts += [jnp.sqrt(x.var(axis=(1, 2)) + 1e-6) for x in grids]
        parts += away
        hidden = nn.Dense(self.width, name="views")(jnp.concatenate(parts, axis=-1))
        hidden = nn.leaky_relu(hidden, _LEAK)
        if failed is not None:
            hidden = jnp.concatenate([hidden, _bounded(failed)], axis=-1)
        return normalize(nn.Dense(len(grids), name="fusion")(hidden), self.normalizer)


class SecondHead(nn.Module):
    """Class, box and heading of each proposal from its fused crop.

    Source: Ku et al. (2018), section III-D.
    """

    widths: tuple[int, ...]
    dropout: float
    n_classes: int = 2

    @nn.compact
    def __call__(
        self, crops: Float[Array, "*b s s c"], train: bool
    ) -> tuple[Float[Array, "*b n"], Float[Array, "*b 10"], Float[Array, "*b 2"]]:
        """Class scores (background first), ten corner offsets [m], and the angle vector."""
        x = crops.reshape(*crops.shape[:-3], -1)
        for i, width in enumerate(self.widths):
            x = nn.relu(nn.Dense(width, name=f"fc{i}")(x))
            x = nn.Dropout(self.dropout, deterministic=not train)(x)
        scores = nn.Dense(self.n_classes, name="classes")(x)
        offsets = nn.Dense(10, name="offsets")(x)
        return scores, offsets, nn.Dense(2, name="angle")(x)
