"""The objects of one frame, labels or detections, as one tuple of arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

KITTI_TYPES = (
    "Car",
    "Van",
    "Truck",
    "Pedestrian",
    "Person_sitting",
    "Cyclist",
    "Tram",
    "Misc",
    "DontCare",
)
DONT_CARE = "DontCare"
NO_BOX3D = -1000.0  # the location that KITTI writes where an object has no 3D box


@dataclasses.dataclass(frozen=True, eq=False)
class Objects:
    """N labelled or detected objects, in the units and frames of KITTI's text files.

    The camera frame is the rectified one of camera 0: x right, y down, z forward.

    Attributes:
        type: `[N]` strings, see `KITTI_TYPES`.
        truncated: `[N]` share outside the image, 0 to 1; -1 where unknown.
        occluded: `[N]` 0 visible, 1 partly, 2 largely, 3 unknown; -1 where unknown.
        alpha: `[N]` observation angle [rad]; -10 where there is none.
        bbox: `[N, 4]` left, top, right, bottom [pixel].
        dimensions: `[N, 3]` height, width, length [m]; -1 where there is no 3D box.
        location: `[N, 3]` centre of the bottom face in the camera frame [m].
        rotation_y: `[N]` heading about the camera's y axis [rad].
        score: `[N]` confidence of a detection; NaN in labels.
    """

    type: np.ndarray
    truncated: np.ndarray
    occluded: np.ndarray
    alpha: np.ndarray
    bbox: np.ndarray
    dimensions: np.ndarray
    location: np.ndarray
    rotation_y: np.ndarray
    score: np.ndarray

    def __len__(self) -> int:
        """Number of objects."""
        return int(self.truncated.shape[0])


def empty() -> Objects:
    """No object at all: what an empty label or result file holds."""
    none = np.zeros(0)
    return Objects(
        np.zeros(0, "<U14"), none, np.zeros(0, np.int64), none, np.zeros((0, 4)),
        np.zeros((0, 3)), np.zeros((0, 3)), none, none,
    )  # fmt: skip


def _fields(objects: Objects) -> list[np.ndarray]:
    return [getattr(objects, field.name) for field in dataclasses.fields(Objects)]


def select(objects: Objects, index: np.ndarray) -> Objects:
    """The objects at `index`: a bool mask `[N]` or integer positions."""
    return Objects(*(field[index] for field in _fields(objects)))


def concatenate(parts: Sequence[Objects]) -> Objects:
    """All objects of several frames, in order."""
    columns = zip(*(_fields(part) for part in (empty(), *parts)), strict=True)
    return Objects(*(np.concatenate(column) for column in columns))


def points_inside(
    points: Float[np.ndarray, "n 3"],
    objects: Objects,
    *,
    margin: float = 0.0,
    clearance: float = 0.0,
) -> Bool[np.ndarray, "n k"]:
    """Which camera-frame points lie in which 3D box.

    Args:
        points: `[n, 3]` [m].
        objects: k of them, with 3D boxes.
        margin: the boxes grow by it on their four sides [m].
        clearance: so much of the box above its bottom face does not count [m].
    """
    away = points[:, None] - objects.location[None]
    cos, sin = np.cos(objects.rotation_y)[None], np.sin(objects.rotation_y)[None]
    along = away[..., 0] * cos - away[..., 2] * sin
    across = away[..., 0] * sin + away[..., 2] * cos
    height, width, length = objects.dimensions.T[:, None]
    inside = (np.abs(along) < length / 2 + margin) & (np.abs(across) < width / 2 + margin)
    return inside & (away[..., 1] < -clearance) & (away[..., 1] > -height)
