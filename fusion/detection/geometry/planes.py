r"""Ground plane of a lidar scan by random sample consensus.

.. math:: h(x) = a x + b y + c z + d, \qquad a^2 + b^2 + c^2 = 1, \; b < 0,

is the height [m] of a camera-frame point above the ground (y points down), so d is the height of
the camera. A plane is drawn through three points, all planes are scored at once by the truncated
squared distances of the points (MSAC), and the best one is refined by least squares on its inliers.

Source: Fischler, Bolles (1981), random sample consensus; Torr, Zisserman (2000), the truncated
score. Ku et al. (2018) use given planes; the search limits here are our choice, see `PlaneConfig`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class PlaneConfig:
    """Limits of the search.

    Attributes:
        x_range, z_range: where ground points are looked for [m]: the road ahead.
        camera_height: KITTI's colour camera above ground [m] (sensor set-up page: 1.65).
        height_tolerance: allowed distance of the fitted height from it [m].
        max_tilt: allowed angle between the plane's normal and the camera's y axis [degree].
        inlier_distance: distance at which a point stops to count [m].
        trials: planes drawn.
        max_points: points used, drawn evenly from the scan.
        seed: of the draws; the same scan gives the same plane.
    """

    x_range: tuple[float, float] = (-10.0, 10.0)
    z_range: tuple[float, float] = (3.0, 30.0)
    camera_height: float = 1.65
    height_tolerance: float = 0.4
    max_tilt: float = 8.0
    inlier_distance: float = 0.12
    trials: int = 400
    max_points: int = 4000
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the counts and limits."""
        if self.trials < 1 or self.max_points < 3:
            raise ValueError(
                f"trials={self.trials}, max_points={self.max_points}: expected at least 1 and 3"
            )
        if not (self.inlier_distance > 0 and self.height_tolerance > 0 and 0 < self.max_tilt < 90):
            raise ValueError(
                f"inlier_distance={self.inlier_distance}, height_tolerance="
                f"{self.height_tolerance}, max_tilt={self.max_tilt}: expected positive limits and "
                "a tilt below 90 degrees"
            )


class PlaneFit(NamedTuple):
    """The plane `[4]`, the share of candidate points on it, and how many candidates there were."""

    plane: np.ndarray
    inlier_share: float
    n_points: int


def height_above(
    plane: Float[np.ndarray, "4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Height [m] of camera-frame points above the plane."""
    return points @ plane[:3] + plane[3]


def plane_y(plane: Float[Any, "4"], x: Float[Any, "*n"], z: Float[Any, "*n"]) -> Float[Any, "*n"]:
    """The camera-frame y of the ground at (x, z), in numpy or inside jit."""
    return -(plane[0] * x + plane[2] * z + plane[3]) / plane[1]


def plane_difference(a: Float[np.ndarray, "4"], b: Float[np.ndarray, "4"]) -> tuple[float, float]:
    """Difference of two planes: of the camera heights [m] and of the normals [degree]."""
    cosine = np.clip(a[:3] @ b[:3] / np.linalg.norm(a[:3]) / np.linalg.norm(b[:3]), -1.0, 1.0)
    return abs(float(a[3] - b[3])), float(np.degrees(np.arccos(cosine)))


def _upward(planes: np.ndarray) -> np.ndarray:
    return planes * np.where(planes[:, 1:2] > 0, -1.0, 1.0)


def _through(triples: np.ndarray) -> np.ndarray:
    """Planes `[t, 4]` through triples of points `[t, 3, 3]`; NaN where they lie on a line."""
    normal = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = normal / np.where(length < 1e-6, 0.0, length)
    return _upward(np.concatenate([normal, -(normal * triples[:, 0]).sum(1, keepdims=True)], 1))


def _allowed(planes: np.ndarray, config: PlaneConfig) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        level = -planes[:, 1] > np.cos(np.radians(config.max_tilt))
        return level & (np.abs(planes[:, 3] - config.camera_height) < config.height_tolerance)


def _refine(plane: np.ndarray, points: np.ndarray, config: PlaneConfig) -> np.ndarray:
    """Least squares on the inliers, a few times, as long as the plane stays allowed."""
    for _ in range(5):
        near = points[np.abs(height_above(plane, points)) < config.inlier_distance]
        if len(near) < 3:
            break
        centre = near.mean(axis=0)
        normal = np.linalg.svd(near - centre, full_matrices=False)[2][-1]
        new = _upward(np.append(normal, -normal @ centre)[None])
        if not _allowed(new, config)[0]:
            break
        plane = new[0]
    return plane


def fit_plane(points: Float[np.ndarray, "n 3"], config: PlaneConfig | None = None) -> PlaneFit:
    """Ground plane of camera-frame points.

    Args:
        points: `[n, 3]` lidar points in the rectified camera frame [m].
        config: search limits.

    Raises:
        ValueError: too few points near the expected ground, or no drawn plane is allowed.
    """
    config = config or PlaneConfig()
    x, y, z = points.T
    reach = max(abs(v) for v in (*config.x_range, *config.z_range))
    slope = np.tan(np.radians(config.max_tilt))
    near_ground = np.abs(y - config.camera_height) < config.height_tolerance + slope * np.minimum(
        np.hypot(x, z), reach
    )
    ahead = (x > config.x_range[0]) & (x < config.x_range[1])
    ahead &= (z > config.z_range[0]) & (z < config.z_range[1])
    candidates = points[near_ground & ahead].astype(np.float64)
    if len(candidates) < 50:
        raise ValueError(
            f"{len(candidates)} points near the expected ground, expected at least 50: give a "
            "plane file, or widen x_range, z_range, height_tolerance or max_tilt"
        )
    rng = np.random.RandomState(config.seed)
    # The scan is dense near the car: drawing cells of 1 m first lets far road count as well.
    cell = np.floor(candidates[:, [0, 2]]).astype(np.int64)
    _, inverse, counts = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    weight = 1.0 / counts[inverse.ravel()]
    n = min(config.max_points, len(candidates))
    kept = candidates[rng.choice(len(candidates), n, p=weight / weight.sum())]
    planes = _through(kept[rng.randint(0, n, (config.trials, 3))])
    planes = planes[_allowed(planes, config)]
    if not len(planes):
        raise ValueError(
            f"none of {config.trials} planes is within {config.height_tolerance} m and "
            f"{config.max_tilt} degrees of the expected ground: widen these limits"
        )
    heights = kept @ planes[:, :3].T + planes[:, 3]
    cost = np.minimum(np.abs(heights), config.inlier_distance) ** 2
    plane = _refine(planes[int(np.argmin(cost.sum(axis=0)))], kept, config)
    share = float((np.abs(height_above(plane, kept)) < config.inlier_distance).mean())
    return PlaneFit(plane, share, len(candidates))
