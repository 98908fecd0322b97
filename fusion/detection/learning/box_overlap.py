r"""How well the boxes that cells tell overlap their cars, as a loss.

.. math:: L_o = 1 - \overline{o}

with the overlap o in 3D of each cell near a car. Absolute errors see each number of a box on its
own; the overlap, which decides what is a hit, sees them together, and the numbers that cost most of
it are corrected first.

Source: Zhou et al. (2019), IoU loss for 2D/3D object detection.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion.detection.config import DetectorConfig
from fusion.detection.geometry.overlaps import box3d_iou
from fusion.detection.learning.dense_targets import GridTargets, decode_cells
from fusion.detection.network.lifting import grid_centres


def _most_near(config: DetectorConfig) -> int:
    """How many cells of a frame can be near a car at most."""
    d = config.dense
    across = math.floor(2.0 * d.radius / d.cell) + 1
    rows, columns = grid_centres(config)[0].shape
    return min(rows * columns, config.max_objects * (across**2 + 1))


def box_overlaps(
    config: DetectorConfig,
    told: Float[Array, "r s 10"],
    targets: GridTargets,
    plane: Float[Array, "4"],
) -> Float[Array, "r s"]:
    """Overlap in 3D of each cell's box with its car, inside jit, with a gradient; 1 far from cars.

    Overlaps of rotated boxes are dear and a car has a dozen cells, so those are gathered first.

    Args:
        config: static.
        told: boxes as the network tells them.
        targets: of the same frame.
        plane: its ground.
    """
    near = targets.near.ravel()
    cells = jnp.flatnonzero(near, size=_most_near(config), fill_value=near.size)
    at = jnp.minimum(cells, near.size - 1)
    wanted = targets.boxes.reshape(-1, told.shape[-1])[at]
    # A box anywhere may have no gradient; those that do not count are replaced before.
    found = jnp.where(near[at][:, None], told.reshape(-1, told.shape[-1])[at], wanted)
    boxes, truth = (decode_cells(config, x, plane, at) for x in (found, wanted))
    overlaps = jnp.ones(near.size).at[cells].set(box3d_iou(boxes, truth), mode="drop")
    return overlaps.reshape(targets.near.shape)


def overlap_loss(
    config: DetectorConfig,
    told: Float[Array, "r s 10"],
    targets: GridTargets,
    plane: Float[Array, "4"],
) -> Float[Array, ""]:
    """Mean of 1 - overlap over the cells near a car of one frame, 0 without any, inside jit."""
    missing = 1.0 - box_overlaps(config, told, targets, plane)
    n = targets.near.astype(missing.dtype).sum()
    return jnp.where(targets.near, missing, 0.0).sum() / jnp.maximum(1.0, n)
