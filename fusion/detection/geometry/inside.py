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
    down = points[:, 1, None] - boxes[None, :, 1]
    inside = in_footprints(points[:, 0], points[:, 2], boxes, margin=margin)
    return inside & (down < margin) & (down > -boxes[None, :, 5] - margin)


def in_footprints(
    x: Float[Array, "p"], z: Float[Array, "p"], boxes: Float[Array, "g 7"], *, margin: float = 0.0
) -> Bool[Array, "p g"]:
    """Which places on the ground lie below or above a box; arguments as `points_in_boxes`."""
    dx, dz = x[:, None] - boxes[None, :, 0], z[:, None] - boxes[None, :, 2]
    c, s = jnp.cos(boxes[:, 6])[None], jnp.sin(boxes[:, 6])[None]
    along, across = jnp.abs(c * dx - s * dz), jnp.abs(s * dx + c * dz)
    half = 0.5 * boxes[:, 3:5] + margin
    return (along < half[None, :, 0]) & (across < half[None, :, 1])
