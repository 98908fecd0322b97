r"""Camera features at the cells of a grid over the ground.

.. math:: y_{ij} = \big\Vert_h \, x\big(P_2 (X_j, Y_{ij} - h, Z_i, 1)^T\big)

The centre of every cell, at several heights h above the ground plane, is projected into the image,
and the camera's map is read there by bilinear interpolation; outside the picture it is 0.

Source: Roddick, Kendall, Cipolla (2019), orthographic feature transform, with points in place of
integrals.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fusion.detection.config import DetectorConfig


def grid_centres(config: DetectorConfig) -> tuple[np.ndarray, np.ndarray]:
    """x and z of the cells `[rows, columns]` [m]; row 0 is the farthest, as in the map."""
    stride = round(config.dense.cell / config.bev.cell)
    rows, columns = (n // stride for n in config.bev.shape)
    x = config.bev.x_range[0] + config.dense.cell * (np.arange(columns) + 0.5)
    z = config.bev.z_range[1] - config.dense.cell * (np.arange(rows) + 0.5)
    grid = np.meshgrid(x, z)
    return grid[0].astype(np.float32), grid[1].astype(np.float32)


def lift(
    config: DetectorConfig,
    features: Float[Array, "h w c"],
    plane: Float[Array, "4"],
    p2: Float[Array, "3 4"],
    image_size: Float[Array, "2"],
) -> Float[Array, "r s d"]:
    """The camera's map of one frame at every cell, heights side by side, inside jit.

    Args:
        config: gives grid and heights.
        features: map of the resized image.
        plane: ground plane a, b, c, d.
        p2: projection into the image of the original size.
        image_size: its rows and columns.
    """
    x, z = (jnp.asarray(a) for a in grid_centres(config))
    ground = -(plane[0] * x + plane[2] * z + plane[3]) / plane[1]
    height, width, channels = features.shape
    # Each pixel beside its right, lower and lower right neighbours: one place is read for a point,
    # and one written in the gradient, in place of four.
    padded = jnp.pad(features, ((0, 1), (0, 1), (0, 0)), mode="edge")
    corners = [padded[i : i + height, j : j + width] for i in (0, 1) for j in (0, 1)]
    table = jnp.stack(corners, axis=2).reshape(height * width, 4, channels)
    found = []
    for above in config.dense.heights:
        points = jnp.stack([x, ground - above, z, jnp.ones_like(x)], axis=-1)
        seen = points @ p2.T
        depth = jnp.maximum(seen[..., 2], 0.1)
        u = seen[..., 0] / depth / (image_size[1] - 1.0) * (width - 1)
        v = seen[..., 1] / depth / (image_size[0] - 1.0) * (height - 1)
        inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
        u, v = jnp.where(inside, u, 0.0), jnp.where(inside, v, 0.0)
        left = jnp.clip(jnp.floor(u), 0, max(width - 2, 0)).astype(jnp.int32)
        top = jnp.clip(jnp.floor(v), 0, max(height - 2, 0)).astype(jnp.int32)
        fu, fv = u - left.astype(u.dtype), v - top.astype(v.dtype)
        corner = [(1 - fv) * (1 - fu), (1 - fv) * fu, fv * (1 - fu), fv * fu]
        shares = jnp.where(inside[..., None], jnp.stack(corner, axis=-1), 0.0)
        # Kept apart, or the gradient would compute them anew for every channel of every corner.
        at, shares = jax.lax.optimization_barrier((top * width + left, shares))
        found.append(jnp.einsum("rsk,rskc->rsc", shares, table[at]))
    return jnp.concatenate(found, axis=-1)
