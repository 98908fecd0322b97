"""The reversible encoder of K sensors as a flax module: the trunk, and what gate and head read."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
from jaxtyping import Array, Float

from fusion.reversible.blocks import Params, draw_parameter, forward, stage_shapes
from fusion.reversible.config import ReversibleConfig
from fusion.series_readout import pooled_features
from fusion.stacked import stacked_dense


class ReversibleEncoder(nn.Module):
    """Encode windows of K sensors: a reversible trunk in place of strided convolutions.

    `[branch, batch, time] -> [branch, batch, features]`, as `fusion.encoders.SeriesEncoder`. The
    trunk's output holds the whole window; what gate and head read of it (mean and maximum over
    time, beside the spectrum) does not.

    Attributes:
        config: stages of the trunk.
        features: width of the result.
        spectral: add the path over spectrum and moments (series only).
        expand: features of a scalar that enter the trunk, `[k, b, 1] -> [k, b, c]`, the scalar
            itself first.
    """

    config: ReversibleConfig
    features: int
    spectral: bool = True
    expand: Callable[[Any], Any] | None = None

    @nn.compact
    def __call__(self, x: Float[Array, "k b t"]) -> Float[Array, "k b f"]:
        """Return one feature vector per sensor and example."""
        k, b, t = x.shape
        scalar = t == 1 and self.expand is not None
        inputs = self.expand(x)[:, :, None, :] if scalar else x[..., None]  # type: ignore[misc]
        params: Params = {}
        for stage in range(len(self.config.squeezes)):
            for name, shape in stage_shapes(self.config, k, stage).items():
                draw = functools.partial(_draw, self.config, stage, name, shape)
                full = f"stage{stage}_{name}"
                params[full] = self.param(full, draw)
        h = jax.nn.relu(forward(self.config, params, inputs))
        if scalar:
            found = nn.relu(stacked_dense(self, "out", h.reshape(k, b, -1), self.features))
        else:
            found = pooled_features(self, h, x, self.features, spectral=self.spectral)
        return found if self.config.learned else jax.lax.stop_gradient(found)


def _draw(
    config: ReversibleConfig, stage: int, name: str, shape: tuple[int, ...], key: Array
) -> Array:
    return draw_parameter(config, stage, name, shape, key=key)
