"""Ground planes: made scans with clutter, and the planes that come with the real frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.detection.geometry.planes import (
    PlaneConfig,
    fit_plane,
    height_above,
    plane_difference,
    plane_y,
)
from fusion.detection.kitti.calibration import in_image, lidar_to_camera, project
from fusion.detection.kitti.files import frame_names, read_frame
from fusion.detection.kitti.objects import DONT_CARE


def scan(plane: np.ndarray, seed: int, clutter: float) -> np.ndarray:
    """Ground points that get sparse with distance, walls, cars, and points below ground."""
    rng = np.random.default_rng(seed)
    n = 6000
    x, z = rng.uniform(-15, 15, n), 3 + 37 * rng.uniform(0, 1, n) ** 2
    ground = np.stack([x, plane_y(plane, x, z), z], axis=1) + rng.normal(0, 0.02, (n, 3))
    m = int(clutter * n)
    things = np.stack(
        [rng.uniform(-15, 15, m), rng.uniform(-2, 2.2, m), rng.uniform(3, 40, m)], axis=1
    )
    return np.concatenate([ground, things])


@pytest.mark.parametrize("seed", range(4))
def test_finds_a_known_plane_in_clutter(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    normal = np.array([rng.uniform(-0.06, 0.06), -1.0, rng.uniform(-0.04, 0.04)])
    plane = np.append(normal, rng.uniform(1.4, 1.9)) / np.linalg.norm(normal)
    fit = fit_plane(scan(plane, seed, clutter=0.8))
    height, tilt = plane_difference(fit.plane, plane)
    assert height < 0.02 and tilt < 0.15
    np.testing.assert_allclose(np.linalg.norm(fit.plane[:3]), 1.0)
    assert fit.plane[1] < 0 and 0.4 < fit.inlier_share < 1
    np.testing.assert_array_equal(fit_plane(scan(plane, seed, clutter=0.8)).plane, fit.plane)


def test_plane_difference_is_height_and_angle() -> None:
    a = np.array([0.0, -1.0, 0.0, 1.65])
    b = np.array([0.0, -np.cos(0.02), np.sin(0.02), 1.60])
    np.testing.assert_allclose(plane_difference(a, b), [0.05, np.degrees(0.02)], rtol=1e-6)
    x, z = np.array([1.0, -3.0]), np.array([5.0, 20.0])
    on = np.stack([x, plane_y(b, x, z), z], axis=1)
    np.testing.assert_allclose(height_above(b, on), 0.0, atol=1e-12)


def test_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match="0 points near the expected ground, expected at least 50"):
        fit_plane(np.full((100, 3), np.nan))
    wall = np.stack([np.zeros(200), np.linspace(0.8, 2.2, 200), np.full(200, 10.0)], axis=1)
    with pytest.raises(ValueError, match="none of 400 planes is within"):
        fit_plane(wall)
    with pytest.raises(ValueError, match="trials=0"):
        PlaneConfig(trials=0)
    with pytest.raises(ValueError, match="max_tilt=95"):
        PlaneConfig(max_tilt=95.0)


@pytest.mark.data
def test_agrees_with_the_provided_planes(data_dir: Path) -> None:
    root = data_dir / "kitti"
    ours, theirs = [], []
    names = frame_names(root / "training" / "planes")
    assert len(names) == 13
    for name in names:
        frame = read_frame(root, name)
        camera = lidar_to_camera(frame.calibration, frame.points[:, :3])
        pixels, depth = project(frame.calibration, camera)
        camera = camera[in_image(pixels, depth, *frame.image.shape[:2])]
        fit = fit_plane(camera)
        assert frame.plane is not None and frame.labels is not None
        height, tilt = plane_difference(fit.plane, frame.plane)
        assert height < 0.1 and tilt < 1.0, name
        bottom = frame.labels.location[frame.labels.type != DONT_CARE]
        ours.extend(abs(height_above(fit.plane, bottom)))
        theirs.extend(abs(height_above(frame.plane, bottom)))
    # The labelled objects stand on our planes at least as well as on the provided ones.
    assert np.mean(ours) < np.mean(theirs) + 0.02
