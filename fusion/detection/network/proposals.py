"""From anchors to boxes: where they lie in both views, proposals, decoded detections; one frame.

Everything runs inside jit at fixed sizes; `vmap` the functions for a batch.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fusion.detection.config import DetectorConfig
from fusion.detection.geometry.bev import ground_to_unit
from fusion.detection.geometry.encodings import (
    anchor_ground,
    box3d_to_anchor,
    box3d_to_box4c,
    box4c_to_box3d,
    box_corners,
    decode_offsets,
    ground_box,
    project_boxes,
    resolve_heading,
)
from fusion.detection.geometry.suppression import nms

# Sizes that training can ask of a proposal, as factors of its anchor; keeps exp() finite.
_LOG_LIMIT = 1.5


class Detections(NamedTuple):
    """Boxes of one frame at a fixed size, best first.

    Attributes:
        boxes: `[k, 7]` x, y, z, length, width, height, rotation_y.
        scores: `[k]` probability of an object.
        mask: `[k]` which rows are detections.
        weights: `[2]` fusion weights of (camera, lidar).
        failed: `[2]` probability that each of them has failed; NaN where the gate does not tell.
    """

    boxes: Array
    scores: Array
    mask: Array
    weights: Array
    failed: Array


def anchor_boxes(anchors: Float[Array, "n 6"]) -> Float[Array, "n 7"]:
    """3D boxes of anchors: along x where the anchor is longer there, else along z."""
    x, y, z, dx, dy, dz = anchors.T
    yaw = jnp.where(dx >= dz, 0.0, 0.5 * jnp.pi)
    sides = jnp.maximum(dx, dz), jnp.minimum(dx, dz)
    return jnp.stack([x, y, z, *sides, dy, yaw], axis=1)


def view_boxes(
    config: DetectorConfig,
    anchors: Float[Array, "n 6"],
    p2: Float[Array, "3 4"],
    image_size: Float[Array, "2"],
) -> tuple[Float[Array, "n 4"], Float[Array, "n 4"]]:
    """Where anchors lie in the image and in the map, in the units of `crop_and_resize`."""
    corners = box_corners(anchor_boxes(anchors))
    image = project_boxes(corners, p2, image_size[0], image_size[1])
    # A box that leaves the picture is cropped at its border, not filled up with zeros.
    return jnp.clip(image, 0.0, 1.0), ground_to_unit(config.bev, anchor_ground(anchors))


def propose(
    config: DetectorConfig,
    anchors: Float[Array, "n 6"],
    mask: Bool[Array, "n"],
    objectness: Float[Array, "n 2"],
    offsets: Float[Array, "n 6"],
    n_proposals: int,
) -> tuple[Float[Array, "k 6"], Bool[Array, "k"]]:
    """The best regressed anchors that do not overlap more than `config.rpn_nms`."""
    limited = offsets.at[:, 3:].set(jnp.clip(offsets[:, 3:], -_LOG_LIMIT, _LOG_LIMIT))
    moved = decode_offsets(anchors, limited)
    score = objectness[:, 1] - objectness[:, 0]
    index, found = nms(
        anchor_ground(moved),
        score,
        mask,
        iou_threshold=config.rpn_nms,
        max_output=n_proposals,
        max_candidates=config.candidates,
    )
    return moved[index], found


def decode_second(
    proposals: Float[Array, "k 6"],
    offsets: Float[Array, "k 10"],
    angle: Float[Array, "k 2"],
    plane: Float[Array, "4"],
) -> Float[Array, "k 7"]:
    """3D boxes of the second stage: moved corners, and the heading that the angle vector tells."""
    corners = box3d_to_box4c(anchor_boxes(proposals), plane) + offsets
    boxes = box4c_to_box3d(corners, plane)
    heading = resolve_heading(boxes[:, 6], angle)
    return boxes.at[:, 6].set(heading)


def final_boxes(
    config: DetectorConfig,
    boxes: Float[Array, "k 7"],
    scores: Float[Array, "k 2"],
    mask: Bool[Array, "k"],
    weights: Float[Array, "2"],
    failed: Float[Array, "2"],
) -> Detections:
    """Probabilities, suppression on the ground, and the boxes above the score threshold.

    `failed` are log odds.
    """
    probability = jax.nn.softmax(scores, axis=-1)[:, 1]
    sound = (boxes[:, 3:6] > 0.0).all(axis=1) & jnp.isfinite(boxes).all(axis=1)
    rotated = config.final_overlap == "rotated"
    index, found = nms(
        ground_box(boxes) if rotated else anchor_ground(box3d_to_anchor(boxes)),
        probability,
        mask & sound & (probability >= config.score_threshold),
        iou_threshold=config.final_nms,
        max_output=config.max_detections,
        max_candidates=boxes.shape[0],
        overlap=config.final_overlap,
    )
    return Detections(
        boxes[index],
        jnp.where(found, probability[index], 0.0),
        found,
        weights,
        jax.nn.sigmoid(failed),
    )
