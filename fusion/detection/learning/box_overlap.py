r"""How well the boxes that cells tell overlap their cars, as a loss.

.. math:: L_o = 1 - \overline{o}

with the overlap o in 3D of each cell near a car. Absolute errors see each number of a box on its
own; the overlap, which decides what is a hit, sees them together, and the numbers that cost most of
it are corrected first.

Source: Zhou et al. (2019), IoU loss for 2D/3D object detection.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion.detection.config import DetectorConfig
from fusion.detection.geometry.overlaps import box3d_iou
from fusion.detection.learning.dense_targets import GridTargets, decode_cells


def box_overlaps(
    config: DetectorConfig,
    told: Float[Array, "r s 10"],
    targets: GridTargets,
    plane: Float[Array, "4"],
) -> Float[Array, "r s"]:
    """Overlap in 3D of each cell's box with its car, inside jit, with a gradient; 1 far from cars.

    Args:
        config: static.
        told: boxes as the network tells them.
        targets: of the same frame.
        plane: its ground.
    """
    # A box anywhere may have no gradient; those that do not count are replaced before.
    told = jnp.where(targets.near[..., None], told, targets.boxes)
    boxes, truth = (decode_cells(config, x, plane) for x in (told, targets.boxes))
    return box3d_iou(boxes, truth).reshape(targets.near.shape)


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
