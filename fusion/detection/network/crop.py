r"""Crop boxes out of a feature map and resize them to one size, by bilinear interpolation.

Source: the operation of this name in TensorFlow (Abadi et al., 2016), as AVOD uses it; a gather of
four neighbours here, so that it runs inside jit and has a gradient for map and boxes.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def _samples(low: Array, high: Array, size: int, length: int) -> Array:
    """`[n, size]` positions along one axis, in pixels."""
    if size == 1:
        return (0.5 * (low + high) * (length - 1))[:, None]
    step = jnp.arange(size, dtype=low.dtype) / (size - 1)
    return (low[:, None] + (high - low)[:, None] * step[None]) * (length - 1)


def _neighbours(position: Array, length: int) -> tuple[Array, Array, Array, Array]:
    """Indices before and after, the share of the second one, and which positions are inside."""
    inside = (position >= 0) & (position <= length - 1)
    position = jnp.where(inside, position, 0.0)
    before = jnp.clip(jnp.floor(position), 0, max(length - 2, 0))
    first = before.astype(jnp.int32)
    return first, jnp.minimum(first + 1, length - 1), position - before, inside


def crop_and_resize(
    features: Float[Array, "h w c"], boxes: Float[Array, "n 4"], size: tuple[int, int]
) -> Float[Array, "n rows columns c"]:
    """One crop for each box.

    .. math:: y_i = \\left(y_1 + (y_2 - y_1) \\frac{i}{rows - 1}\\right) (h - 1)

    and likewise along x; a crop of one row samples the middle. Samples outside the map are 0.

    Args:
        features: `[h, w, c]`.
        boxes: `[n, 4]` y1, x1, y2, x2, where 0 and 1 are the first and the last pixel centre.
        size: rows and columns of each crop (static).

    Raises:
        ValueError: a size below 1.
    """
    if min(size) < 1:
        raise ValueError(f"size={size}, expected at least one row and one column")
    height, width, _ = features.shape
    y0, y1, fy, in_y = _neighbours(_samples(boxes[:, 0], boxes[:, 2], size[0], height), height)
    x0, x1, fx, in_x = _neighbours(_samples(boxes[:, 1], boxes[:, 3], size[1], width), width)
    fy, fx = fy[:, :, None, None], fx[:, None, :, None]

    def take(y: Array, x: Array) -> Array:
        return features[y[:, :, None], x[:, None, :]]

    top = take(y0, x0) * (1 - fx) + take(y0, x1) * fx
    bottom = take(y1, x0) * (1 - fx) + take(y1, x1) * fx
    inside = in_y[:, :, None, None] & in_x[:, None, :, None]
    return jnp.where(inside, top * (1 - fy) + bottom * fy, 0.0)
