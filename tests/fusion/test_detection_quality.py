"""Statistics of raw readings tell a failing sensor from a working one, kind by kind."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.detection.geometry import BevConfig, bev_maps
from fusion.detection.learning.gate_objective import failure_loss
from fusion.detection.network import QualityHead
from fusion.detection.sensors import (
    CAMERA_FAILURES,
    LIDAR_FAILURES,
    N_IMAGE,
    N_SCAN,
    camera_failure,
    image_statistics,
    lidar_failure,
    quality_statistics,
    scan_statistics,
)
from fusion.detection.sensors.hdl64 import ELEVATIONS
from fusion.evaluate import auroc

N = 48
BEV = BevConfig(x_range=(-16.0, 16.0), z_range=(2.0, 34.0), cell=0.5)
PLANE = jnp.array([0.0, -1.0, 0.0, 1.7])
DEPTH = jnp.asarray(np.minimum(60.0, 8.0 + 0.0 * np.zeros((32, 96))), jnp.float32)


def pictures(rng: np.random.Generator) -> np.ndarray:
    """Blocks of random colours, by day and in shade."""
    blocks = rng.uniform(0.1, 0.9, (N, 8, 24, 3)).repeat(4, axis=1).repeat(4, axis=2)
    light = rng.uniform(0.5, 1.0, (N, 1, 1, 1))
    return np.clip(light * blocks + rng.normal(0, 0.01, blocks.shape), 0, 1).astype(np.float32)


def scans(rng: np.random.Generator) -> np.ndarray:
    """A road and some walls, 64 beams by 90 azimuths in front; `[N, 5760, 4]`."""
    azimuth, elevation = np.meshgrid(np.radians(np.linspace(-40, 40, 90)), ELEVATIONS)
    found = []
    for _ in range(N):
        wall = rng.uniform(8, 30, 10).repeat(9)[None]
        road = 1.7 / np.maximum(np.tan(-elevation), 1e-3)
        distance = np.minimum(np.minimum(wall, road), 60.0) * rng.normal(1, 0.001, azimuth.shape)
        unit = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1)
        points = (distance[..., None] * unit).reshape(-1, 3)
        found.append(np.concatenate([points, np.full((len(points), 1), 0.3)], axis=1))
    return np.asarray(found, np.float32)


def told(clean: np.ndarray, failed: np.ndarray) -> float:
    """AUROC, on the second half, of a ridge regression fitted on the first half."""
    half = N // 2
    x = np.concatenate([clean[:half], failed[:half]]).astype(np.float64)
    mean, sd = x.mean(0), x.std(0) + 1e-3
    x, y = (x - mean) / sd, np.repeat([-1.0, 1.0], half)
    weights = np.linalg.solve(x.T @ x + 3.0 * np.eye(x.shape[1]), x.T @ y)
    score = [(part[half:] - mean) / sd @ weights for part in (failed, clean)]
    return auroc(*score)


@pytest.mark.parametrize("kind", CAMERA_FAILURES)
def test_pictures_of_a_failing_camera_are_told(kind: str) -> None:
    images = jnp.asarray(pictures(np.random.default_rng(0)))
    keys = jax.random.split(jax.random.key(0), N)

    @jax.jit
    def run(images: jax.Array) -> tuple[jax.Array, jax.Array]:
        fail = partial(camera_failure, kind=kind, severity=jnp.float32(0.5), depth=DEPTH)
        failed = jax.vmap(lambda image, key: fail(image, key=key))(images, keys)
        return image_statistics(images - 0.37), image_statistics(failed - 0.37)

    clean, failed = (np.asarray(part) for part in run(images))
    assert clean.shape == (N, N_IMAGE) and np.isfinite(failed).all() and np.abs(failed).max() < 8
    assert told(clean, failed) > 0.95


def read_scans(
    kind: str, severity: float, seed: int, bev: BevConfig, thinnest: float = 1.0
) -> tuple[np.ndarray, ...]:
    """Statistics of scans as they are and with a failure; some return fewer points than others."""
    rng = np.random.default_rng(seed)
    points = jnp.asarray(scans(rng))
    returned = rng.uniform(size=points.shape[:2]) < rng.uniform(thinnest, 1.0, (N, 1))
    keys = jax.random.split(jax.random.key(0), N)
    to_camera = jnp.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])

    def statistics(points: jax.Array, mask: jax.Array) -> jax.Array:
        return scan_statistics(bev, bev_maps(bev, points[:, :3] @ to_camera.T, mask, PLANE)[None])

    def one(points: jax.Array, mask: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        failed = lidar_failure(points, mask, kind, jnp.float32(severity), key=key)
        return statistics(points, mask)[0], statistics(*failed)[0]

    clean, failed = jax.jit(jax.vmap(one))(points, jnp.asarray(returned), keys)
    return np.asarray(clean), np.asarray(failed)


@pytest.mark.parametrize("kind", LIDAR_FAILURES)
def test_maps_of_a_failing_lidar_are_told(kind: str) -> None:
    clean, failed = read_scans(kind, 0.7, 1, BEV)
    assert clean.shape == (N, N_SCAN) and np.isfinite(failed).all() and np.abs(failed).max() < 8
    assert told(clean, failed) > 0.95


@pytest.mark.parametrize(
    ("kind", "profile", "value"), [("sector_dropout", 14, 2), ("beam_loss", 7, 4)]
)
def test_one_number_tells_a_fifth_of_the_beams_and_twelve_degrees_of_the_view(
    kind: str, profile: int, value: int
) -> None:
    # Unevenness by bearing, bends from ring to ring; counts alone tell a thin scan from neither.
    clean, failed = read_scans(kind, 0.2, 2, dataclasses.replace(BEV, cell=0.25), thinnest=0.3)
    column = N_SCAN - profile + value
    assert auroc(failed[:, column], clean[:, column]) > 0.9


def test_a_map_too_coarse_for_profiles_has_statistics_too() -> None:
    coarse = BevConfig(x_range=(-8.0, 8.0), z_range=(30.0, 46.0), cell=8.0)
    found = scan_statistics(coarse, jnp.ones((1, *coarse.shape, 6)))
    assert found.shape == (1, N_SCAN) and np.isfinite(found).all()


def test_what_tells_noisy_ranges_and_blur_moves_as_far_as_other_statistics_do() -> None:
    # Noisy ranges: beside 196 solid cells 6 stand alone, then 24, as many times as of real scans.
    bev = np.zeros((2, *BEV.shape, 6), np.float32)
    for frame, alone in enumerate((6, 24)):
        place = np.arange(alone)
        bev[frame, 1 + 2 * (place % 24), 1 + 2 * (place // 24), -1] = 0.5
        bev[frame, :49, 10:14, -1] = 0.5
    shift = np.diff(np.asarray(scan_statistics(BEV, jnp.asarray(bev))), axis=0)[0]
    assert shift[15] > 0.5 and np.sort(shift)[-2] < 0.1
    # Blur: neighbouring pixels alike, at the same contrast of the blocks.
    rng = np.random.default_rng(0)
    sharp = pictures(rng)[:1] - 0.37
    blurred = (np.roll(sharp, 1, axis=2) + sharp + np.roll(sharp, -1, axis=2)) / 3.0
    found = np.asarray(image_statistics(jnp.asarray(np.concatenate([sharp, blurred]))))
    assert found[0, 10] - found[1, 10] > 0.5


def test_a_reading_farther_from_clean_ones_never_looks_healthier() -> None:
    head, rng = QualityHead(), np.random.default_rng(0)
    near = tuple(jnp.asarray(rng.uniform(0, 1, (64, n)), jnp.float32) for n in (5, 3))
    fresh = head.init(jax.random.key(0), near)
    drawn = jax.tree.map(lambda a: jnp.asarray(rng.normal(0, 3, a.shape), jnp.float32), fresh)
    # Any one statistic moves, in a sensor whose weights are of any sign.
    far = tuple(x.at[:, 1].add(0.5) for x in near)
    odds = [np.asarray(head.apply(drawn, x)) for x in (near, far, (far[0], near[1]))]
    assert (odds[1] > odds[0]).all()
    # One sensor does not tell of others.
    np.testing.assert_array_equal(odds[2][:, 1], odds[0][:, 1])
    # Before training it is the distance, and says "works" of a reading as clean ones are.
    distance = np.stack([(np.asarray(x) ** 2).sum(1) for x in near], axis=1)
    np.testing.assert_allclose(head.apply(fresh, near), np.log(2) * distance - 4, rtol=1e-5)


def test_statistics_pass_no_gradient_and_labels_count_where_they_are_known() -> None:
    image, bev = jnp.ones((2, 32, 96, 3)), jnp.ones((2, *BEV.shape, 6))
    slope = jax.grad(lambda x: quality_statistics(BEV, x, bev)[0].sum())(image)
    assert float(jnp.abs(slope).max()) == 0.0
    logits, failed = jnp.array([[2.0, -1.0], [0.0, jnp.nan]]), jnp.array([[True, False]] * 2)
    expected = (np.log1p(np.exp(-2.0)) + np.log1p(np.exp(-1.0)) + np.log(2)) / 4
    np.testing.assert_allclose(failure_loss(logits, failed), expected, rtol=1e-5)
    assert float(failure_loss(logits, None)) == 0.0
