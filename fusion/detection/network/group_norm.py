r"""Group normalization of maps with its ReLU, as two passes over the map each way.

.. math::
    y = \mathrm{relu}\Big(\gamma_c \frac{x - \mu_g}{\sqrt{\sigma_g^2 + \epsilon}} + \beta_c\Big)

Mean and variance are those of a group of neighbouring channels of one map. Forward and backward are
one pass for the sums of each channel and one for the result, which is linear in the map (and in the
gradient) with a factor for each channel. Left to automatic differentiation, maps this thin (8
channels) are read many more times than they are worth.

Source: Wu, He (2018), Group Normalization, Equations 1 to 5.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

GROUP_SIZE = 4  # channels normalized together
_EPSILON = 1e-3


def _group_mean(sums: Array, pixels: int) -> Array:
    """Mean over each group from sums over pixels `[b, c]`, repeated for its channels."""
    grouped = sums.reshape(sums.shape[0], -1, GROUP_SIZE)
    return jnp.repeat(grouped.sum(axis=-1) / (GROUP_SIZE * pixels), GROUP_SIZE, axis=1)


def _statistics(x: Array) -> tuple[Array, Array]:
    """Mean and inverse standard deviation of every channel's group `[b, c]`."""
    pixels = x.shape[1] * x.shape[2]
    mean = _group_mean(x.sum(axis=(1, 2)), pixels)
    square = _group_mean((x * x).sum(axis=(1, 2)), pixels)
    return mean, jax.lax.rsqrt(jnp.maximum(square - mean * mean, 0.0) + _EPSILON)


def _linear(x: Array, factor: Array, offset: Array) -> Array:
    return x * factor[:, None, None] + offset[:, None, None]


@jax.custom_vjp
def group_norm_relu(
    x: Float[Array, "b h w c"], scale: Float[Array, "c"], bias: Float[Array, "c"]
) -> Float[Array, "b h w c"]:
    """Group normalization, then ReLU; gradients in reverse mode.

    Args:
        x: maps; `c` is a multiple of `GROUP_SIZE`.
        scale, bias: of each channel.
    """
    return _forward(x, scale, bias)[0]


def _forward(x: Array, scale: Array, bias: Array) -> tuple[Array, tuple[Array, ...]]:
    mean, inverse = _statistics(x)
    factor = inverse * scale[None]
    y = jnp.maximum(_linear(x, factor, bias[None] - mean * factor), 0.0)
    return y, (x, scale, bias, mean, inverse)


def _backward(kept: tuple[Array, ...], g: Array) -> tuple[Array, Array, Array]:
    x, scale, bias, mean, inverse = kept
    pixels = x.shape[1] * x.shape[2]
    factor = inverse * scale[None]
    g = jnp.where(_linear(x, factor, bias[None] - mean * factor) > 0, g, 0.0)
    sums = g.sum(axis=(1, 2))
    along = inverse * ((g * x).sum(axis=(1, 2)) - mean * sums)  # with the normalized map
    # dx = (scale g - mean(scale g) - normalized x mean(scale g normalized x)) / deviation
    level = _group_mean(scale[None] * sums, pixels)
    slope = _group_mean(scale[None] * along, pixels) * inverse
    dx = _linear(g, factor, inverse * (slope * mean - level)) - x * (inverse * slope)[:, None, None]
    return dx, along.sum(axis=0), sums.sum(axis=0)


group_norm_relu.defvjp(_forward, _backward)
