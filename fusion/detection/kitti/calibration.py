r"""Calibration of one frame, and the way between lidar, camera and image coordinates.

.. math::
    x_{rect} = R_0 \, [R | t]_{velo \to cam} \, \tilde x_{velo}, \qquad
    w \, (u, v, 1)^T = P_2 \, \tilde x_{rect}

The lidar frame has x forward, y left, z up; the rectified camera frame has x right, y down,
z forward. Everything is numpy in float64: calibration files hold 13 digits, and a projection in
float32 is off by a hundredth of a pixel.

Source: Geiger, Lenz, Urtasun (2012), development kit of the KITTI object benchmark.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class Calibration(NamedTuple):
    """Matrices of one calibration file.

    Attributes:
        projections: `[4, 3, 4]`, P0 to P3; P2 is the left colour camera, the others are NaN where
            there are none.
        r0_rect: `[3, 3]` rectifying rotation of camera 0.
        velo_to_cam: `[3, 4]` lidar to unrectified camera 0.
        imu_to_velo: `[3, 4]` inertial unit to lidar, NaN where there is none; not used here, kept
            so that files can be written back.
    """

    projections: np.ndarray
    r0_rect: np.ndarray
    velo_to_cam: np.ndarray
    imu_to_velo: np.ndarray

    @property
    def p2(self) -> np.ndarray:
        """`[3, 4]` projection into the left colour image."""
        return self.projections[2]


def check_calibration(calibration: Calibration) -> None:
    """Refuse matrices that no KITTI calibration can have.

    Raises:
        ValueError: a matrix is not finite, a rotation is not one (to 1e-3), or P2 cannot be
            inverted.
    """
    used = calibration._asdict() | {"projections": calibration.projections[2]}
    for name, value in used.items():
        # Matrices that nothing here reads may be missing, whole.
        missing = name == "imu_to_velo" and np.isnan(value).all()
        if not (missing or np.isfinite(value).all()):
            raise ValueError(f"{name} holds NaN or inf, expected finite numbers")
    rotations = {
        "R0_rect": calibration.r0_rect,
        "Tr_velo_to_cam": calibration.velo_to_cam[:, :3],
    }
    for name, r in rotations.items():
        error = np.abs(r @ r.T - np.eye(3)).max()
        if error > 1e-3 or np.linalg.det(r) < 0:
            raise ValueError(
                f"{name} is not a rotation (R R^T differs from the identity by {error:.2g}, "
                f"determinant {np.linalg.det(r):.3g}): were rows and columns swapped?"
            )
    if abs(np.linalg.det(calibration.p2[:, :3])) < 1e-6:
        raise ValueError("P2 has no inverse: expected a 3x4 projection with two focal lengths")


def _lidar_matrix(calibration: Calibration) -> np.ndarray:
    """`[4, 4]` lidar to rectified camera, homogeneous."""
    velo, rect = np.eye(4), np.eye(4)
    velo[:3] = calibration.velo_to_cam
    rect[:3, :3] = calibration.r0_rect
    return rect @ velo


def lidar_to_camera(
    calibration: Calibration, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Lidar points `[n, 3]` in the rectified camera frame [m]."""
    m = _lidar_matrix(calibration)
    return points.astype(np.float64) @ m[:3, :3].T + m[:3, 3]


def camera_to_lidar(
    calibration: Calibration, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Camera-frame points `[n, 3]` in the lidar frame [m]: the exact inverse.

    The matrices of the files are rotations to seven digits only, so the inverse is solved for and
    not taken as the transpose.
    """
    m = np.linalg.inv(_lidar_matrix(calibration))
    return points.astype(np.float64) @ m[:3, :3].T + m[:3, 3]


def project(
    calibration: Calibration, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
    """Camera-frame points into the left colour image.

    Returns:
        pixels `[n, 2]` (u to the right, v down) and depth w `[n]` [m]. Pixels of points with
        w <= 0 lie behind the camera and mean nothing; they are NaN where w is 0.
    """
    p = calibration.p2
    homogeneous = points.astype(np.float64) @ p[:, :3].T + p[:, 3]
    depth = homogeneous[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = homogeneous[:, :2] / depth[:, None]
    return np.where(depth[:, None] == 0, np.nan, pixels), depth


def back_project(
    calibration: Calibration, pixels: Float[np.ndarray, "n 2"], depth: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """The camera-frame points that `project` maps to these pixels and depths."""
    p = calibration.p2
    homogeneous = np.concatenate([pixels * depth[:, None], depth[:, None]], axis=1)
    return np.linalg.solve(p[:, :3], (homogeneous - p[:, 3]).T).T


def in_image(
    pixels: Float[np.ndarray, "n 2"], depth: Float[np.ndarray, "n"], height: int, width: int
) -> Bool[np.ndarray, "n"]:
    """Which projected points lie in front of the camera and inside `height` x `width` pixels."""
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0) & (pixels < np.array([width, height]))
    return inside.all(axis=1) & (depth > 0)
