r"""What the cells of the grid should say about the labelled cars, and back.

.. math::
    Y_{ij} = \max_g \exp\Big(-\frac{|c_{ij} - g|^2}{2 \sigma^2}\Big), \qquad
    t = \Big(x_g - x, \; z_g - z, \; 2 (y_g - y_0), \; 2 \log\frac{d_g}{\bar d}, \;
      \cos 2 r_g, \; \sin 2 r_g, \; \cos r_g, \; \sin r_g\Big)

for the centre c of a cell and the nearest car g, whose own cell has heat 1; :math:`\bar d` are mean
sizes, :math:`y_0` is the ground below the car. The doubled angle tells the box's axis, and the
plain one only which of the axis' two directions is the front: a scan hardly tells front from back,
and the best guess at a vector that may as well be its opposite is short and points anywhere.

Source: Zhou, Wang, Kraehenbuehl (2019), objects as points; axis and direction apart as in Ku et al.
(2018), whose box has the axis and whose angle vector the direction.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fusion.detection.config import DetectorConfig
from fusion.detection.geometry.encodings import wrap_angle
from fusion.detection.geometry.inside import in_footprints
from fusion.detection.geometry.planes import plane_y
from fusion.detection.network.inputs import Inputs
from fusion.detection.network.lifting import grid_centres

_MARGIN, _MIDDLE = 0.5, 0.8  # around ignored boxes, height of a car's middle [m]
_LOG_LIMIT = 1.0  # sizes as factors of the mean, e to this at most


class GridTargets(NamedTuple):
    """Of one frame.

    Attributes:
        heat: `[r, s]` in [0, 1].
        centre: `[r, s]` cells of a car's centre.
        near: `[r, s]` cells that tell a box.
        boxes: `[r, s, 10]` what they should tell.
        ignored: `[r, s]` cells that are neither object nor background.
    """

    heat: Array
    centre: Array
    near: Array
    boxes: Array
    ignored: Array


def _mean_size(config: DetectorConfig) -> np.ndarray:
    return np.mean(np.asarray(config.anchors.sizes, np.float32), axis=0)


def _inside_boxes(boxes: Array, mask: Array, x: Array, z: Array) -> Array:
    """Which cells' centres lie in the footprint of a box, half a metre around it included."""
    inside = in_footprints(x.ravel(), z.ravel(), boxes, margin=_MARGIN) & mask[None]
    return inside.any(axis=1).reshape(x.shape)


def _inside_regions(
    regions: Float[Array, "d 4"], plane: Array, p2: Float[Array, "3 4"], x: Array, z: Array
) -> Array:
    """Which cells are seen in a DontCare region, at the height of a car's middle."""
    points = jnp.stack([x, plane_y(plane, x, z) - _MIDDLE, z, jnp.ones_like(x)], axis=-1)
    seen = points @ p2.T
    u, v = (seen[..., i] / jnp.maximum(seen[..., 2], 0.1) for i in (0, 1))
    left, top, right, bottom = (regions[:, i, None, None] for i in range(4))
    return ((u[None] > left) & (u[None] < right) & (v[None] > top) & (v[None] < bottom)).any(axis=0)


def ignored_cells(config: DetectorConfig, inputs: Inputs) -> Bool[Array, "r s"]:
    """Cells of one frame that are neither object nor background, inside jit.

    They are those on a box of the neighbouring class (vans for cars, which the benchmark counts
    neither as hits nor as misses) and those seen in a DontCare region of the picture.
    """
    x, z = (jnp.asarray(a) for a in grid_centres(config))
    on_box = _inside_boxes(inputs.truth, inputs.ignored, x, z)
    return on_box | _inside_regions(inputs.regions, inputs.plane, inputs.p2, x, z)


def grid_targets(config: DetectorConfig, inputs: Inputs) -> GridTargets:
    """Targets of one frame, inside jit: reads its labelled boxes, ground plane and P2."""
    truth, mask, plane = inputs.truth, inputs.truth_mask, inputs.plane
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
    raised = nearest[..., 1] - plane_y(plane, nearest[..., 0], nearest[..., 2])
    size = jnp.maximum(nearest[..., 3:6], 0.1) / jnp.asarray(_mean_size(config))[None, None]
    heading = nearest[..., 6]
    angles = [jnp.cos(2.0 * heading), jnp.sin(2.0 * heading), jnp.cos(heading), jnp.sin(heading)]
    boxes = jnp.concatenate(
        [
            jnp.stack([nearest[..., 0] - x, nearest[..., 2] - z, 2.0 * raised], axis=-1),
            2.0 * jnp.log(size),
            jnp.stack(angles, axis=-1),
        ],
        axis=-1,
    )
    near = square.min(axis=0) < d.radius**2
    near = near | centre
    ignored = ignored_cells(config, inputs) & ~near
    return GridTargets(jnp.where(centre, 1.0, heat), centre, near, boxes, ignored)


def average_cells(
    config: DetectorConfig, outputs: Float[Array, "r s 11"]
) -> Float[Array, "r s 11"]:
    r"""Outputs whose boxes are means over the cells around, weighed by their heat, inside jit.

    .. math:: \bar t_i = \sum_{j \in N(i)} y_j t_j \Big/ \sum_{j \in N(i)} y_j

    Every cell within `DenseConfig.radius` of a car learns to tell its box, with errors of its own:
    the mean over the 3 x 3 cells of a peak is steadier than the peak's own box. Places are
    averaged, not distances from each cell.

    Args:
        config: static.
        outputs: of the network; the heat stays as it is.
    """
    at = jnp.stack([jnp.asarray(a) for a in grid_centres(config)], axis=-1)
    heat = jax.nn.sigmoid(outputs[..., :1])
    told = outputs[..., 1:].at[..., :2].add(at)
    sums = [
        jax.lax.reduce_window(a, 0.0, jax.lax.add, (3, 3, 1), (1, 1, 1), "SAME")
        for a in (heat * told, heat)
    ]
    mean = (sums[0] / jnp.maximum(sums[1], 1e-9)).at[..., :2].add(-at)
    return jnp.concatenate([outputs[..., :1], mean], axis=-1)


def decode_cells(
    config: DetectorConfig,
    boxes: Float[Array, "*n 10"],
    plane: Float[Array, "4"],
    cells: Int[Array, "n"] | None = None,
) -> Float[Array, "n 7"]:
    """3D boxes that the cells tell, in the order of the flattened grid.

    Args:
        config: gives grid and mean sizes.
        boxes: what all cells tell `[r, s, 10]`, or `[n, 10]` what some of them tell.
        plane: ground of the frame.
        cells: places of the latter in the flattened grid.
    """
    x, z = (jnp.asarray(a) for a in grid_centres(config))
    if cells is not None:
        x, z = x.ravel()[cells], z.ravel()[cells]
    at_x, at_z = x + boxes[..., 0], z + boxes[..., 1]
    y = plane_y(plane, at_x, at_z) + 0.5 * boxes[..., 2]
    log_size = jnp.clip(0.5 * boxes[..., 3:6], -_LOG_LIMIT, _LOG_LIMIT)
    mean = jnp.broadcast_to(jnp.asarray(_mean_size(config)), log_size.shape)
    size = mean * jnp.exp(log_size)
    # Features that are all zero tell no axis, and the angle of (0, 0) has no gradient.
    untold = (boxes[..., 6] == 0.0) & (boxes[..., 7] == 0.0)
    axis = 0.5 * jnp.arctan2(boxes[..., 7], jnp.where(untold, 1e-3, boxes[..., 6]))
    ahead = jnp.cos(axis) * boxes[..., 8] + jnp.sin(axis) * boxes[..., 9] >= 0.0
    heading = wrap_angle(jnp.where(ahead, axis, axis + jnp.pi))
    return jnp.concatenate(
        [jnp.stack([at_x, y, at_z], axis=-1), size, heading[..., None]], axis=-1
    ).reshape(-1, 7)
