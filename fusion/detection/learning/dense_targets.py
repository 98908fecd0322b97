r"""What the cells of the grid should say about the labelled cars, and back.

.. math::
    Y_{ij} = \max_g \exp\Big(-\frac{|c_{ij} - g|^2}{2 \sigma^2}\Big), \qquad
    t = \Big(x_g - x, \; z_g - z, \; 2 (y_g - y_0), \; 2 \log\frac{d_g}{\bar d}, \; \cos r_g, \;
      \sin r_g\Big)

for the centre c of a cell and the nearest car g, whose own cell has heat 1; :math:`\bar d` are mean
sizes, :math:`y_0` is the ground below the car.

Source: Zhou, Wang, Kraehenbuehl (2019), objects as points.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fusion.detection.config import DetectorConfig
from fusion.detection.network.lifting import grid_centres

_LOG_LIMIT = 1.0  # sizes as factors of the mean, e to this at most


class GridTargets(NamedTuple):
    """Of one frame.

    Attributes:
        heat: `[r, s]` in [0, 1].
        centre: `[r, s]` cells of a car's centre.
        near: `[r, s]` cells that tell a box.
        boxes: `[r, s, 8]` what they should tell.
    """

    heat: Array
    centre: Array
    near: Array
    boxes: Array


def _mean_size(config: DetectorConfig) -> np.ndarray:
    return np.mean(np.asarray(config.anchors.sizes, np.float32), axis=0)


def _ground(plane: Array, x: Array, z: Array) -> Array:
    return -(plane[0] * x + plane[2] * z + plane[3]) / plane[1]


def grid_targets(
    config: DetectorConfig,
    truth: Float[Array, "g 7"],
    mask: Bool[Array, "g"],
    plane: Float[Array, "4"],
) -> GridTargets:
    """Targets of one frame, inside jit.

    Args:
        config: static.
        truth, mask: labelled boxes, padded.
        plane: ground plane.
    """
    d = config.dense
    x, z = (jnp.asarray(a) for a in grid_centres(config))
    square = (truth[:, 0, None, None] - x[None]) ** 2 + (truth[:, 2, None, None] - z[None]) ** 2
    square = jnp.where(mask[:, None, None], square, 1e9)
    heat = jnp.exp(-square / (2.0 * d.heat_sd**2)).max(axis=0)
    row = jnp.floor((config.bev.z_range[1] - truth[:, 2]) / d.cell).astype(jnp.int32)
    column = jnp.floor((truth[:, 0] - config.bev.x_range[0]) / d.cell).astype(jnp.int32)
    flat = jnp.where(mask, row * x.shape[1] + column, x.size)
    centre = jnp.zeros(x.size, bool).at[flat].set(True, mode="drop").reshape(x.shape)
    nearest = truth[square.argmin(axis=0)]
    raised = nearest[..., 1] - _ground(plane, nearest[..., 0], nearest[..., 2])
    size = jnp.maximum(nearest[..., 3:6], 0.1) / jnp.asarray(_mean_size(config))[None, None]
    boxes = jnp.concatenate(
        [
            jnp.stack([nearest[..., 0] - x, nearest[..., 2] - z, 2.0 * raised], axis=-1),
            2.0 * jnp.log(size),
            jnp.stack([jnp.cos(nearest[..., 6]), jnp.sin(nearest[..., 6])], axis=-1),
        ],
        axis=-1,
    )
    near = square.min(axis=0) < d.radius**2
    return GridTargets(jnp.where(centre, 1.0, heat), centre, near | centre, boxes)


def decode_cells(
    config: DetectorConfig, boxes: Float[Array, "r s 8"], plane: Float[Array, "4"]
) -> Float[Array, "n 7"]:
    """3D boxes that the cells tell, in the order of the flattened grid."""
    x, z = (jnp.asarray(a) for a in grid_centres(config))
    at_x, at_z = x + boxes[..., 0], z + boxes[..., 1]
    y = _ground(plane, at_x, at_z) + 0.5 * boxes[..., 2]
    log_size = jnp.clip(0.5 * boxes[..., 3:6], -_LOG_LIMIT, _LOG_LIMIT)
    size = jnp.asarray(_mean_size(config))[None, None] * jnp.exp(log_size)
    heading = jnp.arctan2(boxes[..., 7], boxes[..., 6])
    return jnp.concatenate(
        [jnp.stack([at_x, y, at_z], axis=-1), size, heading[..., None]], axis=-1
    ).reshape(-1, 7)
