"""The objects of one frame, labels or detections, as one tuple of arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

__all__ = ["DONT_CARE", "KITTI_TYPES", "NO_BOX3D", "Objects", "concatenate", "empty", "select"]

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
