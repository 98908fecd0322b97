"""How far away is what each pixel shows: from the scan, and from the road where no point lies.

Fog needs it. A point covers the pixels around it, as dense as the scan is; where there is none the
road counts, and above the horizon nothing.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

FARTHEST = 200.0  # [m], of what no ray of the road meets
_REACH = (0.035, 0.01)  # half sides of the patch of a point, as shares of rows and columns


def depth_image(
    size: tuple[int, int],
    points: Float[Array, "n 3"],
    mask: Bool[Array, "n"],
    p2: Float[Array, "3 4"],
    image_size: Float[Array, "2"],
    plane: Float[Array, "4"],
) -> Float[Array, "h w"]:
    """Depth of every pixel of a resized image, inside jit.

    Args:
        size: rows and columns of the resized image (static).
        points: camera-frame points [m], padded; mask: which are real.
        p2: projection into the image of the original size.
        image_size: its rows and columns.
        plane: ground plane a, b, c, d.

    Returns:
        Depth along the camera's axis [m]; `FARTHEST` where nothing is known.
    """
    height, width = size
    step = image_size / jnp.array([height, width], jnp.float32)
    v, u = jnp.meshgrid(
        (jnp.arange(height, dtype=step.dtype) + 0.5) * step[0],
        (jnp.arange(width, dtype=step.dtype) + 0.5) * step[1],
        indexing="ij",
    )
    # A pixel's points are t (u, v, 1) seen through P2; on the road a x + b y + c z + d = 0.
    inverse = jnp.linalg.inv(p2[:, :3])
    ray = jnp.stack([u, v, jnp.ones_like(u)], axis=-1) @ inverse.T
    origin = -inverse @ p2[:, 3]
    along, above = ray @ plane[:3], origin @ plane[:3] + plane[3]
    road = jnp.where(along < -1e-6, above / jnp.maximum(-along, 1e-6), FARTHEST)
    road = jnp.clip(road, 0.0, FARTHEST)

    seen = points @ p2[:, :3].T + p2[:, 3][None]
    depth = seen[:, 2]
    row = jnp.floor(seen[:, 1] / jnp.maximum(depth, 0.1) / step[0])
    column = jnp.floor(seen[:, 0] / jnp.maximum(depth, 0.1) / step[1])
    inside = mask & (depth > 0.1) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    at = jnp.where(inside, row * width + column, height * width).astype(jnp.int32)
    nearest = jnp.full(height * width, jnp.inf).at[at].min(depth, mode="drop")
    window = [2 * max(1, round(share * side)) + 1 for share, side in zip(_REACH, size, strict=True)]
    spread = jax.lax.reduce_window(
        nearest.reshape(height, width), jnp.inf, jax.lax.min, window, (1, 1), "SAME"
    )
    return jnp.where(jnp.isfinite(spread), jnp.minimum(spread, FARTHEST), road)
