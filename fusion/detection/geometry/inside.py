"""Which points lie in which boxes, inside jit."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def points_in_boxes(
    points: Float[Array, "p 3"], boxes: Float[Array, "g 7"], *, margin: float = 0.0
) -> Bool[Array, "p g"]:
    """Which points lie in a box or within `margin` [m] of it on each side.

    Args:
        points: camera frame [m], y down.
        boxes: x, y of the bottom, z, length, width, height, rotation_y.
        margin: [m].
    """
    away = points[:, None] - boxes[None, :, :3]
    c, s = jnp.cos(boxes[:, 6])[None], jnp.sin(boxes[:, 6])[None]
    along = c * away[..., 0] - s * away[..., 2]
    across = s * away[..., 0] + c * away[..., 2]
    half = 0.5 * boxes[:, 3:5] + margin
    inside = (jnp.abs(along) < half[None, :, 0]) & (jnp.abs(across) < half[None, :, 1])
    return inside & (away[..., 1] < margin) & (away[..., 1] > -boxes[None, :, 5] - margin)
