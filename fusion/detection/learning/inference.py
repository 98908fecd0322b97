"""Detections of trained networks, and their way into KITTI's result format."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from fusion.detection.config import DetectorConfig
from fusion.detection.geometry.encodings import box_corners, project_boxes
from fusion.detection.kitti.objects import Objects
from fusion.detection.network.forward import encode, propose_boxes, score_proposals
from fusion.detection.network.inputs import Inputs
from fusion.detection.network.proposals import Detections, decode_second, final_boxes
from fusion.detection.sensors.platt import Calibration, rescaled


def detect(
    config: DetectorConfig,
    main: Any,
    stats: Any,
    inputs: Inputs,
    calibration: Calibration | None = None,
) -> Detections:
    """Both stages on a batch of frames, inside jit.

    Args:
        config: static.
        main: `params["main"]`; the auxiliary side and the lattice are not needed.
        stats: of batch norm.
        inputs: batch of frames.
        calibration: of the told failures; as the head tells them when left out.

    Returns:
        `Detections` with a leading axis of frames.
    """
    encoded, _ = encode(config, main, stats, inputs, train=False)
    scale = 2.0 * encoded.weights
    proposals, found = propose_boxes(config, main, encoded, scale, inputs, config.proposals)
    scores, moves, angle = score_proposals(config, main, encoded, scale, inputs, proposals).outputs
    boxes = jax.vmap(decode_second)(proposals, moves, angle, inputs.plane)
    return jax.vmap(lambda b, s, m, w, f: final_boxes(config, b, s, m, w, f))(
        boxes, scores, found, encoded.weights, rescaled(calibration, encoded.failed)
    )


@jax.jit
def _project(boxes: Array, p2: Array, height: Array, width: Array) -> Array:
    return project_boxes(box_corners(boxes), p2, height, width)


def to_objects(
    detections: Detections, p2: np.ndarray, image_size: np.ndarray, name: str = "Car"
) -> Objects:
    """Detections of one frame as KITTI objects; those outside the picture are left out.

    Args:
        detections: of one frame, on the host.
        p2: `[3, 4]` projection.
        image_size: rows and columns of the image [pixel].
        name: their class.
    """
    mask, boxes = np.asarray(detections.mask), np.asarray(detections.boxes, np.float32)
    height, width = (float(v) for v in image_size)
    # All rows, so that one compiled program serves every frame.
    unit = _project(boxes, np.asarray(p2, np.float32), height, width)
    boxes, scores = boxes[mask], np.asarray(detections.scores, np.float64)[mask]
    pixels = np.asarray(unit, np.float64)[mask][:, [1, 0, 3, 2]]
    pixels = np.clip(pixels, 0.0, 1.0) * [width - 1, height - 1, width - 1, height - 1]
    seen = (pixels[:, 2] - pixels[:, 0] > 1.0) & (pixels[:, 3] - pixels[:, 1] > 1.0)
    seen &= boxes[:, 2] > 0.0
    boxes, scores, pixels = boxes[seen].astype(np.float64), scores[seen], pixels[seen]
    n = len(boxes)
    alpha = boxes[:, 6] - np.arctan2(boxes[:, 0], boxes[:, 2])
    return Objects(
        type=np.full(n, name, "<U14"),
        truncated=np.full(n, -1.0),
        occluded=np.full(n, -1, np.int64),
        alpha=np.mod(alpha + np.pi, 2 * np.pi) - np.pi,
        bbox=pixels,
        dimensions=boxes[:, [5, 4, 3]],
        location=boxes[:, :3],
        rotation_y=boxes[:, 6],
        score=scores,
    )
