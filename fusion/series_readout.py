"""From a series of channels to features: mean and maximum over time, beside a spectrum."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion.spectrum import spectral_features
from fusion.stacked import stacked_dense


def pooled_features(
    module: nn.Module,
    h: Float[Array, "k b n c"],
    x: Float[Array, "k b t"],
    features: int,
    *,
    spectral: bool,
) -> Float[Array, "k b f"]:
    """Features of K series, with parameters `conv_out`, `spectral` and `out` of `module`.

    Args:
        module: whose parameters the dense layers are.
        h: rectified channels that a network made of the windows.
        x: the windows, for their spectrum and moments.
        features: width of the result.
        spectral: add the path over the spectrum.
    """
    h = jnp.concatenate([jnp.mean(h, axis=2), jnp.max(h, axis=2)], axis=-1)
    paths = [nn.relu(stacked_dense(module, "conv_out", h, features))]
    if spectral:
        paths.append(nn.relu(stacked_dense(module, "spectral", spectral_features(x), features)))
    return nn.relu(stacked_dense(module, "out", jnp.concatenate(paths, -1), features))
