"""Labels of a simulated frame, as KITTI has them, and what each sensor saw of each object."""

from __future__ import annotations

import dataclasses

import numpy as np

from fusion.detection.kitti.calibration import Calibration
from fusion.detection.kitti.objects import Objects
from fusion.detection.simulator.rendering import Readings
from fusion.detection.simulator.scene import KINDS, LABELLED, Scene

PARTLY, LARGELY, HARDLY = 0.9, 0.5, 0.1  # visible share below which occlusion is 1, 2, 3
DARK = 0.05  # reflectivity of dark paint lies below this
_NEAR = 0.1  # [m]
_EDGES = np.array(
    [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
)


@dataclasses.dataclass(frozen=True, eq=False)
class Visibility:
    """What the sensors got of the M labelled objects and look-alikes of a frame.

    Attributes:
        slot: `[M]` slot in the scene.
        label: `[M]` row in the labels, -1 where there is none (a look-alike, or out of sight).
        kind: `[M]` one of `KINDS`.
        points: `[M]` lidar points on it.
        pixels: `[M]` pixels that show it, and `share` of those that would if it stood alone.
        dark_paint, low_contrast: `[M]` hard to see for the lidar; for the camera.
    """

    slot: np.ndarray
    label: np.ndarray
    kind: np.ndarray
    points: np.ndarray
    pixels: np.ndarray
    share: np.ndarray
    dark_paint: np.ndarray
    low_contrast: np.ndarray


def _corners(place: np.ndarray, turn: np.ndarray, size: np.ndarray) -> np.ndarray:
    """`[n, 8, 3]` corners in the camera frame: the bottom face, then the top one."""
    length, width = np.array([1, 1, -1, -1]), np.array([1, -1, -1, 1])
    a = 0.5 * size[:, 2, None] * np.tile(length, 2)
    c = 0.5 * size[:, 1, None] * np.tile(width, 2)
    y = -size[:, 0, None] * np.repeat([0.0, 1.0], 4)
    cos, sin = turn[:, :1], turn[:, 1:]
    x, z = a * cos + c * sin, -a * sin + c * cos
    return place[:, None] + np.stack([x, y, z], axis=-1)


def image_boxes(
    calibration: Calibration,
    place: np.ndarray,
    turn: np.ndarray,
    size: np.ndarray,
    height: int,
    width: int,
) -> tuple[np.ndarray, np.ndarray]:
    """2D boxes around the projected 3D boxes, and how much of them the image cuts off.

    What lies less than 0.1 m before the camera is cut away first.

    Args:
        calibration: of the camera.
        place, turn, size: `[n, 3]`, `[n, 2]`, `[n, 3]` as in `Scene`.
        height, width: of the image [pixel].

    Returns:
        boxes `[n, 4]` within the image, and truncation `[n]`, 1 for what lies outside.
    """
    p = calibration.p2
    corners = _corners(place.astype(np.float64), turn.astype(np.float64), size.astype(np.float64))
    points = corners @ p[:, :3].T + p[:, 3]
    start, end = points[:, _EDGES[:, 0]], points[:, _EDGES[:, 1]]
    # Where an edge passes the near plane, both of its ends are moved onto it or kept.
    rise = end[..., 2] - start[..., 2]
    rise = np.where(np.abs(rise) < 1e-12, 1e-12, rise)
    cross = np.clip((_NEAR - start[..., 2]) / rise, 0.0, 1.0)[..., None]
    middle = start + cross * (end - start)
    ends = np.concatenate([np.where(e[..., 2:] < _NEAR, middle, e) for e in (start, end)], axis=1)
    before = np.asarray(ends[..., 2] >= _NEAR - 1e-9)
    pixels = ends[..., :2] / np.maximum(ends[..., 2:], _NEAR)
    low = np.where(before[..., None], pixels, np.inf).min(axis=1)
    high = np.where(before[..., None], pixels, -np.inf).max(axis=1)
    seen = np.asarray(before.any(axis=1))
    low, high = np.where(seen[:, None], low, 0.0), np.where(seen[:, None], high, 0.0)
    limit = np.array([width, height], dtype=np.float64)
    boxes = np.concatenate([np.clip(low, 0.0, limit), np.clip(high, 0.0, limit)], axis=1)
    whole = np.maximum((high - low).prod(axis=1), 1e-9)
    kept = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    return boxes, np.clip(1.0 - kept / whole, 0.0, 1.0)


def visibility_of(scene: Scene, readings: Readings, n_things: int) -> Visibility:
    """Count points and pixels of the first `n_things` slots of one frame (numpy leaves)."""
    slot = np.arange(n_things)
    kind = np.array(KINDS)[np.asarray(scene.kind)[:n_things]]
    owner = np.asarray(readings.point_owner)
    points = np.bincount(owner[owner >= 0], minlength=n_things)[:n_things]
    pixels = np.asarray(readings.visible)[:n_things]
    share = pixels / np.maximum(np.asarray(readings.alone)[:n_things], 1e-9)
    labelled = np.isin(kind, LABELLED) & (pixels > 0)
    return Visibility(
        slot=slot,
        label=np.where(labelled, np.cumsum(labelled) - 1, -1),
        kind=kind,
        points=points,
        pixels=pixels,
        share=share,
        dark_paint=np.asarray(scene.reflectivity)[:n_things] < DARK,
        low_contrast=np.asarray(scene.low_contrast)[:n_things] > 0.5,
    )


def labels_of(
    scene: Scene, seen: Visibility, calibration: Calibration, height: int, width: int
) -> Objects:
    """Labels of the objects that show in at least one ray of the image.

    Occlusion is 0 from 90 % of the pixels that the object alone would have, 1 from 50 %, 2 from
    10 %, else 3.
    """
    kept = seen.slot[seen.label >= 0]
    place, size = np.asarray(scene.place)[kept], np.asarray(scene.size)[kept]
    turn = np.asarray(scene.turn)[kept]
    boxes, truncated = image_boxes(calibration, place, turn, size, height, width)
    yaw = np.arctan2(turn[:, 1], turn[:, 0]).astype(np.float64)
    alpha = yaw - np.arctan2(place[:, 0], place[:, 2])
    share = seen.share[kept]
    return Objects(
        type=seen.kind[kept].astype("<U14"),
        truncated=truncated,
        occluded=np.sum([share < PARTLY, share < LARGELY, share < HARDLY], axis=0),
        alpha=np.mod(alpha + np.pi, 2 * np.pi) - np.pi,
        bbox=boxes,
        dimensions=size.astype(np.float64),
        location=place.astype(np.float64),
        rotation_y=yaw,
        score=np.full(len(kept), np.nan),
    )
