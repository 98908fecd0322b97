r"""What the views of a trained detector know: can cars be told from look-alikes, and by whom?

Simulated frames hold bodies that have a car's shape and places and another colour. A detector
without the camera cannot tell them from cars, so how well it does tells whether the camera is used,
which average precision alone does not.

.. math:: A = \Pr(s_{car} > s_{look\text{-}alike})

of the class scores of a stage, given the true boxes (1 for perfect, 0.5 for chance); and of a
ridge regression on a view's crop, fitted on half of the frames and scored on the other, which says
what is there to be used.

Source: linear probes as in Alain, Bengio (2016), Understanding intermediate layers using linear
classifier probes.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from fusion.detection.config import DetectorConfig
from fusion.detection.geometry.encodings import box3d_to_anchor
from fusion.detection.geometry.proposals import view_boxes
from fusion.detection.learning.examples import Inputs
from fusion.detection.network.crop import crop_and_resize
from fusion.detection.network.detector import Detector, crop_views, fuse
from fusion.evaluate import auroc

__all__ = ["LOOK_ALIKES", "Bodies", "Reading", "probe_auroc", "read_bodies", "read_views"]

LOOK_ALIKES = ("bush", "container")
_BOX = ("x", "y", "z", "length", "width", "height", "rotation_y")


class Bodies(NamedTuple):
    """Cars and look-alikes of one frame, padded.

    Attributes:
        boxes: `[n, 7]` as in labels.
        car: `[n]` car or look-alike.
        mask: `[n]` which rows are bodies.
    """

    boxes: np.ndarray
    car: np.ndarray
    mask: np.ndarray


class Reading(NamedTuple):
    """What the detector makes of the true boxes of one frame.

    Attributes:
        first, second: `[n]` score of car against background in each stage.
        pixels, camera, lidar: `[n, d]` crops of the image and of both views' feature maps.
    """

    first: Array
    second: Array
    pixels: Array
    camera: Array
    lidar: Array


def read_bodies(
    path: Path,
    config: DetectorConfig,
    *,
    min_points: int = 5,
    min_pixels: float = 20.0,
    min_share: float = 0.5,
) -> Bodies:
    """Bodies of a frame that both sensors see well, from its `visibility` table.

    Args:
        path: `training/visibility/000000.csv` of simulated frames.
        config: gives the area and `max_objects`, beyond which bodies are left out.
        min_points, min_pixels, min_share: fewer lidar points, pixels, or less of it visible: left
            out.

    Raises:
        ValueError: the table has no boxes (simulated by an older version).
    """
    with path.open(encoding="ascii", newline="") as file:
        rows = list(csv.DictReader(file))
    if rows and "rotation_y" not in rows[0]:
        raise ValueError(
            f"{path}: no column rotation_y; simulate the frames again with scripts/"
            "simulate_kitti.py, which writes the boxes since"
        )
    x_range, z_range = config.bev.x_range, config.bev.z_range
    boxes, car = [], []
    for row in rows:
        box = [float(row[name]) for name in _BOX]
        inside = x_range[0] < box[0] < x_range[1] and z_range[0] < box[2] < z_range[1]
        seen = int(row["points"]) >= min_points and float(row["pixels"]) >= min_pixels
        seen &= float(row["share"]) >= min_share
        if inside and seen and row["kind"] in ("Car", *LOOK_ALIKES):
            boxes.append(box)
            car.append(row["kind"] == "Car")
    n, size = min(len(boxes), config.max_objects), config.max_objects
    padded = np.tile(np.array([0, 1.6, 20, 4, 1.6, 1.5, 0], np.float32), (size, 1))
    padded[:n] = np.array(boxes, np.float32).reshape(-1, 7)[:n]
    flags = np.zeros(size, bool)
    flags[:n] = car[:n]
    return Bodies(padded, flags, np.arange(size) < n)


def read_views(
    main: Any, stats: Any, config: DetectorConfig, inputs: Inputs, boxes: Float[Array, "n 7"]
) -> Reading:
    """Scores and crops of boxes in one frame, inside jit.

    Args:
        main: `params["main"]`.
        stats: of batch norm.
        config: static.
        inputs: of one frame, without a leading axis.
        boxes: 3D boxes, taken as proposals.
    """
    model: Any = Detector(config)
    variables = {"params": main, "batch_stats": stats}
    encoded = model.apply(variables, inputs.image[None], inputs.bev[None], False, method="encode")
    places = view_boxes(box3d_to_anchor(boxes, square=True), inputs.p2, inputs.image_size, config)
    batched = (places[0][None], places[1][None])
    scale = 2.0 * encoded.weights
    small = fuse(crop_views(encoded.maps, batched, config.rpn_crop), scale)
    crops = crop_views(encoded.features, batched, config.second_crop)
    first = model.apply(variables, small, False, method="first_stage")[0][0]
    second = model.apply(variables, fuse(crops, scale), False, method="second_stage")[0][0]
    size = (config.rpn_crop, config.rpn_crop)
    n = boxes.shape[0]
    return Reading(
        first[:, 1] - first[:, 0],
        second[:, 1] - second[:, 0],
        crop_and_resize(inputs.image, places[0], size).reshape(n, -1),
        crops[0][0].reshape(n, -1),
        crops[1][0].reshape(n, -1),
    )


def probe_auroc(features: np.ndarray, car: np.ndarray, ridge: float = 1.0) -> float:
    """How well a linear reader of the features tells cars from look-alikes.

    Args:
        features: `[n, d]`; the first half is fitted, the second scored.
        car: `[n]`.
        ridge: penalty, in units of the features' mean variance times the number of rows.

    Returns:
        Area under the ROC curve; NaN where a half lacks cars or look-alikes.
    """
    half = len(car) // 2
    if any(part.all() or not part.any() for part in (car[:half], car[half:])):
        return float("nan")
    x = features.astype(np.float64)
    x = (x - x[:half].mean(0)) / (x[:half].std(0) + 1e-6)
    gram = x[:half] @ x[:half].T
    penalty = ridge * np.trace(gram) / half
    weights = np.linalg.solve(gram + penalty * np.eye(half), car[:half] - car[:half].mean())
    scores = x[half:] @ (x[:half].T @ weights)
    return auroc(scores[car[half:]], scores[~car[half:]])
