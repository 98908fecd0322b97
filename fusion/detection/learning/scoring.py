"""Average precision of a detector's output, and how its fusion weights tell which sensor failed."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fusion.detection.kitti.average_precision import (
    DIFFICULTIES,
    METRICS,
    MIN_OVERLAP,
    Evaluation,
    evaluate,
)
from fusion.detection.kitti.objects import Objects
from fusion.detection.learning.inference import to_objects
from fusion.detection.network.proposals import Detections
from fusion.evaluate import auroc

_KITTI_WIDTH, _NARROWEST = 1242.0, 1000.0


def image_scale(width: float) -> float:
    """Factor from pixels of this image to pixels of the benchmark.

    The limits of easy, moderate and hard are 40 and 25 pixels of a picture 1242 pixels wide. The
    same road in a picture a quarter as wide has to be measured in the same pixels, or hardly a car
    would count. Pictures of the benchmark's own sizes are left as they are.
    """
    return 1.0 if width >= _NARROWEST else _KITTI_WIDTH / width


class Camera(NamedTuple):
    """What a frame's detections are projected with: P2 `[3, 4]`, rows and columns of the image."""

    p2: np.ndarray
    image_size: np.ndarray


def frame_objects(
    detections: Sequence[Detections], cameras: Sequence[Camera], target: str = "Car"
) -> list[Objects]:
    """Detections of each frame in KITTI's terms, in pixels of the frame's own image."""
    return [
        to_objects(found, np.asarray(camera.p2), np.asarray(camera.image_size), target)
        for found, camera in zip(detections, cameras, strict=True)
    ]


def _scaled(objects: Objects, factor: float) -> Objects:
    return dataclasses.replace(objects, bbox=objects.bbox * factor)


def class_precision(
    labels: Sequence[Objects],
    detections: Sequence[Objects],
    widths: Sequence[float],
    *,
    target: str = "Car",
    min_overlap: float | None = None,
) -> Evaluation:
    """Precision curves of one class, in pixels of the benchmark.

    Args:
        labels, detections: of the same frames.
        widths: width of each frame's image [pixel], see `image_scale`.
        target: the class.
        min_overlap: in 2D, on the ground and in 3D; the benchmark's (0.7 for cars, 0.5 for others)
            when left out.

    Raises:
        ValueError: like `fusion.detection.kitti.average_precision.evaluate`.
    """
    scales = [image_scale(width) for width in widths]
    return evaluate(
        [_scaled(o, s) for o, s in zip(labels, scales, strict=True)],
        [_scaled(o, s) for o, s in zip(detections, scales, strict=True)],
        classes=(target,),
        min_overlap={target: MIN_OVERLAP[target] if min_overlap is None else min_overlap},
    )


def precision_fields(evaluation: Evaluation) -> dict[str, float]:
    """Average precision [%]: `3d_moderate_r40` and so on, all metrics and difficulties."""
    out = {}
    for points in (11, 40):
        table = evaluation.average_precision(points)[0]
        for m, metric in enumerate(METRICS):
            for d, difficulty in enumerate(DIFFICULTIES):
                out[f"{metric}_{difficulty}_r{points}"] = float(table[m, d])
    return out


def weight_auroc(
    clean: Float[np.ndarray, "n 2"], failed: Float[np.ndarray, "n 2"], sensor: int
) -> float:
    """The chance that a sensor's weight is lower in a frame where it fails than in a clean one.

    Args:
        clean, failed: fusion weights of frames in which all sensors work, and in which one fails.
        sensor: which one; 0 for the camera, 1 for the lidar.
    """
    return auroc(clean[:, sensor], failed[:, sensor])
