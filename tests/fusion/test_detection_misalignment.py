"""Scans that do not fit the picture, and what no correction restores of any failed scan."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, median_filter

from fusion.detection.learning.examples import make_example
from fusion.detection.learning.training import FAILURES, SENSOR_FAILURES, fail_sensor
from fusion.detection.presets import preset
from fusion.detection.sensors import LIDAR_FAILURES, MISALIGNMENTS, lidar_failure, misaligned
from fusion.detection.sensors.hdl64 import ELEVATIONS
from fusion.detection.sensors.misalignment import LAG, ROTATION, SHIFT, SPEED
from tests.fusion.test_detection_network import a_frame

TO_CAMERA = jnp.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3]])
BOXES = jnp.array([[-3.0, 1.6, 12, 4.2, 1.7, 1.5, 1.4], [4, 1.6, 25, 4.2, 1.7, 1.5, 0.2]])
ALL = jnp.ones(2, bool)


@pytest.fixture(scope="module")
def scan() -> tuple[jax.Array, np.ndarray]:
    """200 points of the road, 100 in each car, 10 rows of padding; and all in the camera frame."""
    rng = np.random.default_rng(0)
    road = np.stack([rng.uniform(-10, 10, 200), np.full(200, 1.6), rng.uniform(4, 40, 200)], 1)
    away = np.hypot(road[:, :1] - BOXES[:, 0], road[:, 2:] - BOXES[:, 2]).min(axis=1) < 3
    road[away] = [0.0, 1.6, 30.0]
    clouds = [road]
    for x, y, z, length, width, height, yaw in np.asarray(BOXES):
        a, b = rng.uniform(-0.5, 0.5, (2, 100)) * [[length], [width]]
        c, s = np.cos(yaw), np.sin(yaw)
        up = y - height * rng.uniform(0.3, 1, 100)
        clouds.append(np.stack([x + c * a + s * b, up, z - s * a + c * b], axis=1))
    camera = np.concatenate(clouds)
    lidar = (camera - np.asarray(TO_CAMERA[:, 3])) @ np.asarray(TO_CAMERA[:, :3])
    points = np.concatenate([lidar, np.full((400, 1), 0.5)], axis=1)
    return jnp.asarray(np.concatenate([points, np.zeros((10, 4))]), jnp.float32), camera


def _moved(kind: str, severity: float, scan: tuple[jax.Array, np.ndarray], n: int) -> np.ndarray:
    """Camera-frame points `[n, 400, 3]` of n draws."""
    mask = jnp.arange(410) < 400
    one = jax.jit(partial(misaligned, scan[0], mask, TO_CAMERA, BOXES, ALL, kind))
    out = np.stack(
        [np.asarray(one(jnp.float32(severity), key=jax.random.key(i))) for i in range(n)]
    )
    assert (out[:, 400:] == 0).all() and (out[:, :400, 3] == 0.5).all()
    return out[:, :400, :3] @ np.asarray(TO_CAMERA[:, :3]).T + np.asarray(TO_CAMERA[:, 3])


def test_severity_zero_changes_nothing(scan: tuple[jax.Array, np.ndarray]) -> None:
    for kind in MISALIGNMENTS:
        mask = jnp.arange(410) < 400
        same = misaligned(
            scan[0], mask, TO_CAMERA, BOXES, ALL, kind, jnp.float32(0), key=jax.random.key(0)
        )
        np.testing.assert_array_equal(same, scan[0])
    with pytest.raises(ValueError, match="both sensors' failure 'rain': expected one of calib"):
        misaligned(scan[0], mask, TO_CAMERA, BOXES, ALL, "rain", key=jax.random.key(0))
    assert (*SENSOR_FAILURES, *MISALIGNMENTS) == FAILURES


def test_a_wrong_mount_is_one_rigid_motion(scan: tuple[jax.Array, np.ndarray]) -> None:
    clean = scan[1]
    for severity in (0.2, 1.0):
        for moved in _moved("calibration_shift", severity, scan, 3):
            # Kabsch: the rotation between the centred clouds, by singular values.
            a, b = clean - clean.mean(axis=0), moved - moved.mean(axis=0)
            u, _, vt = np.linalg.svd(a.T @ b)
            rotation = (u @ vt).T
            np.testing.assert_allclose(a @ rotation.T, b, atol=1e-3)
            angle = np.arccos((np.trace(rotation) - 1) / 2)
            assert angle == pytest.approx(severity * ROTATION, rel=0.02)
            shift = moved.mean(axis=0) - rotation @ clean.mean(axis=0)
            assert np.linalg.norm(shift) == pytest.approx(severity * SHIFT, rel=0.02)


def test_after_a_lag_cars_are_elsewhere(scan: tuple[jax.Array, np.ndarray]) -> None:
    clean = scan[1]
    forward, apart = [], []
    for moved in _moved("time_lag", 1.0, scan, 40):
        road, before = moved[:200], clean[:200]
        # What stands turns about the vertical axis and comes nearer or goes away.
        np.testing.assert_allclose(road[:, 1], before[:, 1], atol=1e-4)
        a, b = before[:, [0, 2]], road[:, [0, 2]]
        u, _, vt = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
        rotation = (u @ vt).T
        ahead = (b - a @ rotation.T).mean(axis=0)
        np.testing.assert_allclose(a @ rotation.T + ahead, b, atol=1e-3)
        assert abs(ahead[0]) < 1e-3
        forward.append(ahead[1])
        car = (moved[200:300, [0, 2]] - ahead) @ rotation - clean[200:300, [0, 2]]
        np.testing.assert_allclose(car, np.broadcast_to(car[0], car.shape), atol=1e-3)
        apart.append(car[0] @ [np.cos(1.4), -np.sin(1.4)])
        assert abs(car[0] @ [np.sin(1.4), np.cos(1.4)]) < 1e-3  # it drives where it heads
    size = np.abs(forward)
    assert size.min() >= SPEED[0] * LAG and size.max() <= SPEED[1] * LAG and np.ptp(size) > 2
    assert min(forward) < 0 < max(forward)  # older and newer
    parked = (np.abs(apart) < 1e-3).mean()
    assert 0.25 < parked < 0.75 and 3 < np.abs(apart).max() <= 15 * LAG
    # Behind is where a car that drives was earlier: both signs belong together.
    driving = np.abs(apart) > 0.1
    assert (np.sign(np.asarray(apart)[driving]) == -np.sign(np.asarray(forward)[driving])).all()


@pytest.mark.parametrize("kind", MISALIGNMENTS)
def test_no_one_map_restores_a_misaligned_scan(
    kind: str, scan: tuple[jax.Array, np.ndarray]
) -> None:
    moved, clean = _moved(kind, 1.0, scan, 60), np.broadcast_to(scan[1], (60, 400, 3))
    inputs = np.concatenate([moved, np.ones((60, 400, 1))], axis=2).reshape(-1, 4)
    best = np.linalg.lstsq(inputs, clean.reshape(-1, 3), rcond=None)[0]
    left = np.linalg.norm((inputs @ best).reshape(60, 400, 3) - clean, axis=2)
    error = np.linalg.norm(moved - clean, axis=2)
    assert left.mean() > 0.6 * error.mean() and left.mean() > 0.8  # [m]
    if kind == "time_lag":  # nor a map of each frame: cars drive, the road does not
        alone = []
        for frame in inputs.reshape(60, 400, 4):
            best = np.linalg.lstsq(frame, scan[1], rcond=None)[0]
            alone.append(np.linalg.norm(frame @ best - scan[1], axis=1)[200:].mean())
        assert np.mean(alone) > 0.3


@pytest.mark.parametrize("kind", LIDAR_FAILURES)
def test_no_correction_restores_a_failed_scan(kind: str) -> None:
    """Holes filled from the nearest reading or not, medians or not, and the best line of ranges."""
    rng = np.random.default_rng(0)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-180, 180, 4)), ELEVATIONS)
    ranges = 20.0 + rng.normal(0, 0.4, (22, 30)).repeat(3, axis=0).repeat(3, axis=1)[:64]
    level = ranges * np.cos(elevation)
    place = [level * np.cos(azimuth), level * np.sin(azimuth), ranges * np.sin(elevation)]
    points = np.stack([*place, np.full_like(level, 0.3)], axis=-1).reshape(-1, 4)
    mask = jnp.ones(len(points), bool)
    failed, kept = lidar_failure(
        jnp.asarray(points, jnp.float32), mask, kind, key=jax.random.key(1)
    )
    read = np.linalg.norm(np.asarray(failed)[:, :3], axis=1).reshape(ranges.shape)
    there = np.asarray(kept).reshape(ranges.shape)
    if there.any():
        nearest = distance_transform_edt(~there, return_indices=True, return_distances=False)
        read = read[tuple(nearest)]
    asked = ~there if not there.all() else np.ones_like(there)
    for look in (read, median_filter(read, (3, 3))):
        x, y = look[asked], ranges[asked] - ranges[asked].mean()
        line = np.linalg.lstsq(np.stack([x, np.ones_like(x)], axis=1), y, rcond=None)[0]
        left = ((y - line[0] * x - line[1]) ** 2).mean() / (y**2).mean()
        assert left > 0.4, f"{left:.2f} of the variance of the ranges is left unexplained"


@pytest.mark.slow
def test_inputs_are_of_the_displaced_scan() -> None:
    config = preset("tiny", "dense").config
    example, _ = make_example(config, a_frame())
    for kind in MISALIGNMENTS:
        read = jax.jit(lambda s, k, kind=kind: fail_sensor(config, example, kind, s, key=k))
        none = read(jnp.float32(0.0), jax.random.key(0))
        some = read(jnp.float32(0.6), jax.random.key(0))
        np.testing.assert_array_equal(some.image, none.image)
        np.testing.assert_array_equal(some.truth, none.truth)
        assert float(jnp.abs(some.bev - none.bev).max()) > 0.1
        np.testing.assert_allclose(some.told, [0.6, 0.6])
