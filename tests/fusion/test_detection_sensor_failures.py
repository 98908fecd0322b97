"""Failures of camera and lidar: physics by hand, untouched at severity 0, jit and vmap."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import median_filter, uniform_filter

from fusion.detection.sensors import (
    CAMERA_FAILURES,
    LIDAR_FAILURES,
    beam_of,
    camera_failure,
    lidar_failure,
    random_camera_failure,
    random_lidar_failure,
)
from fusion.detection.sensors.camera_failures import READ_NOISE, _blur
from fusion.detection.sensors.depth import FARTHEST, depth_image
from fusion.detection.sensors.hdl64 import ELEVATIONS

KEY = jax.random.key(3)
DEPTH = jnp.full((24, 64), 15.0)
camera = jax.jit(camera_failure, static_argnames="kind")
lidar = jax.jit(lidar_failure, static_argnames="kind")


@pytest.fixture(scope="module")
def image() -> jax.Array:
    return jax.random.uniform(jax.random.key(0), (24, 64, 3), minval=0.05, maxval=0.95)


@pytest.fixture(scope="module")
def scan() -> tuple[jax.Array, jax.Array]:
    """A wall 20 m away all around, 64 beams by 90 azimuths, and 40 rows of padding."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-180, 180, 4)), ELEVATIONS)
    unit = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1).reshape(-1, 3)
    points = np.concatenate([20 * unit, np.full((len(unit), 1), 0.3)], axis=1)
    padded = np.concatenate([points, np.zeros((40, 4))]).astype(np.float32)
    return jnp.asarray(padded), jnp.arange(len(padded)) < len(points)


def test_severity_zero_changes_nothing(image: jax.Array, scan: tuple[jax.Array, jax.Array]) -> None:
    for kind in CAMERA_FAILURES:
        same = camera(image, kind, jnp.float32(0), key=KEY, depth=DEPTH)
        np.testing.assert_array_equal(same, image)
    for kind in LIDAR_FAILURES:
        points, mask = lidar(*scan, kind, jnp.float32(0), key=KEY)
        np.testing.assert_array_equal(points, scan[0])
        np.testing.assert_array_equal(mask, scan[1])


def test_more_severity_leaves_less(image: jax.Array, scan: tuple[jax.Array, jax.Array]) -> None:
    for kind in CAMERA_FAILURES:
        out = [camera(image, kind, jnp.float32(s), key=KEY, depth=DEPTH) for s in (0.3, 1.0)]
        assert all(float(o.min()) >= 0 and float(o.max()) <= 1 for o in out)
        change = [float(jnp.abs(o - image).mean()) for o in out]
        assert change[0] > 0.02 and change[1] >= change[0]
    kept = {
        kind: [int(lidar(*scan, kind, jnp.float32(s), key=KEY)[1].sum()) for s in (0.3, 1.0)]
        for kind in LIDAR_FAILURES
    }
    n = int(scan[1].sum())
    assert kept["noise"] == [n, n] and kept["loss"] == [0, 0]
    assert n > kept["beam_loss"][0] > kept["beam_loss"][1] > 0
    assert n > kept["sector_dropout"][0] > kept["sector_dropout"][1] > 0.8 * n


def test_fog_follows_koschmieder(image: jax.Array) -> None:
    depth = jnp.full(image.shape[:2], 15.0).at[0].set(jnp.inf).at[1].set(0.0)
    out = np.asarray(camera(image, "fog", jnp.float32(1), depth=depth, key=KEY))
    # Sky is airlight alone; at the visibility 5 % of the contrast is left; then noise and 8 bits.
    clean = np.concatenate([np.full_like(image[:1], 0.8), image[1:2], 0.05 * image[2:] + 0.76])
    np.testing.assert_allclose(out, clean, atol=5 * READ_NOISE)
    assert (out - clean).std() == pytest.approx(READ_NOISE, rel=0.1)
    with pytest.raises(ValueError, match="depth=None: expected the distance of each pixel"):
        camera_failure(image, "fog", key=KEY)
    with pytest.raises(ValueError, match="depth=None: expected the distance of each pixel"):
        random_camera_failure(image, key=KEY)


def test_exposure_gains_then_saturates(image: jax.Array) -> None:
    out = [camera(image, "exposure", jnp.float32(0.25), key=jax.random.key(i)) for i in range(8)]
    bright = [o for o in out if float(o.mean()) > float(image.mean())]
    dark = [o for o in out if float(o.mean()) < float(image.mean())]
    assert bright and dark
    gain = 2 ** (2 / 2.2)  # two stops
    for found, expected in ((bright[0], np.minimum(gain * image, 1.0)), (dark[0], image / gain)):
        error = np.asarray(found - expected)
        assert abs(error.mean()) < 0.004 and np.abs(error).mean() < 2 * READ_NOISE


def test_blur_is_a_gaussian_mean(image: jax.Array) -> None:
    flat = jnp.full((9, 64, 3), 0.4)
    blurred = np.asarray(camera(flat, "blur", jnp.float32(1), key=KEY))
    assert blurred.mean() == pytest.approx(0.4, abs=1e-3)
    assert blurred.std() == pytest.approx(READ_NOISE, rel=0.1)  # noise is read after the lens
    point = jnp.zeros((25, 64, 3)).at[12, 32].set(1.0)
    spread = np.asarray(_blur(KEY, point, jnp.float32(1), None))[:, :, 0]
    assert spread.sum() == pytest.approx(1.0, abs=1e-4)
    sd = 0.02 * 64
    offset = np.arange(-2, 3)
    np.testing.assert_allclose(
        spread[12, 30:35] / spread[12, 32], np.exp(-0.5 * (offset / sd) ** 2), rtol=1e-4
    )


def test_camera_noise_has_the_stated_variance() -> None:
    # Little enough that clipping at 0 and 1 does not matter.
    grey = jnp.full((100, 100, 3), 0.5)
    sd = float((camera(grey, "noise", jnp.float32(0.2), key=KEY) - grey).std())
    expected = np.sqrt(0.2**2 * (0.4**2 + 0.1 * 0.5) + READ_NOISE**2)
    assert sd == pytest.approx(expected, rel=0.02)


def _detail(image: np.ndarray) -> np.ndarray:
    """What is finer than a car that is far away: the picture less its mean over 9 x 9 pixels."""
    return image - uniform_filter(image, (9, 9, 1), mode="nearest")


@pytest.mark.parametrize("kind", CAMERA_FAILURES)
def test_no_correction_restores_a_failed_picture(kind: str) -> None:
    """Fog of one distance and dark exposure used to be linear maps: one line restored them."""
    rng = np.random.default_rng(0)
    blocks = rng.uniform(0.1, 0.9, (12, 40, 3)).repeat(8, axis=0).repeat(8, axis=1)
    clean = np.clip(blocks + rng.normal(0, 0.03, blocks.shape), 0, 1).astype(np.float32)
    # The road from 6 m on; above the horizon 60 m.
    depth = np.where(np.arange(96) < 40, 60.0, 6.0 * 56 / np.maximum(np.arange(96) - 39, 1))
    depth = jnp.asarray(np.minimum(depth, 60.0)[:, None].repeat(320, axis=1), jnp.float32)
    for i in range(4):  # exposure errs to both sides
        failed = camera(
            jnp.asarray(clean), kind, jnp.float32(1), key=jax.random.key(i), depth=depth
        )
        failed = np.asarray(failed)
        np.testing.assert_allclose(255 * failed, np.round(255 * failed), atol=1e-3)
        for look in (failed, median_filter(failed, (3, 3, 1))):
            x, y = _detail(look).ravel(), _detail(clean).ravel()
            slope = (x @ y) / max(float(x @ x), 1e-12)  # the best brightness and contrast
            left = ((y - slope * x) ** 2).mean() / (y**2).mean()
            assert left > 0.4, f"{left:.2f} of the detail's variance is left unexplained"


def test_depth_is_the_road_and_nearer_what_the_lidar_met() -> None:
    p2 = jnp.array([[70.0, 0, 48, 0], [0, 70, 16, 0], [0, 0, 1, 0]])
    plane, size = jnp.array([0.0, -1.0, 0.0, 1.6]), jnp.array([32.0, 96.0])
    points = jnp.array([[0.0, 0.0, 9.0], [0.0, 0.0, 30.0], [9.0, 9.0, -5.0], [0.0, 0.0, 0.0]])
    mask = jnp.array([True, True, True, False])
    depth = np.asarray(jax.jit(partial(depth_image, (16, 48)))(points, mask, p2, size, plane))
    assert depth.shape == (16, 48)
    assert depth[2, 5] == FARTHEST  # above the horizon
    # Row 12 shows v = 25: 1.6 m below the camera at 70 * 1.6 / 9 m.
    np.testing.assert_allclose(depth[12, 5], 70 * 1.6 / 9, rtol=1e-4)
    assert depth[8, 24] == 9.0  # the nearer of two points


def test_range_noise_stays_on_the_beam(scan: tuple[jax.Array, jax.Array]) -> None:
    clean, mask = scan
    n = int(mask.sum())
    points, _ = lidar(clean, mask, "noise", jnp.float32(0.5), key=KEY)
    before, after = np.asarray(clean)[:n, :3], np.asarray(points)[:n, :3]
    r0, r1 = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    np.testing.assert_allclose(after / r1[:, None], before / r0[:, None], atol=1e-5)
    assert (r1 - r0).std() == pytest.approx(0.5, rel=0.05)
    assert float(points[n:].max()) == 0.0 == float(jnp.abs(points[n:]).max())


def test_lost_beams_are_rings_and_lost_sectors_are_azimuths(
    scan: tuple[jax.Array, jax.Array],
) -> None:
    clean, mask = scan
    n = int(mask.sum())
    beam = np.repeat(np.arange(64), 90)
    np.testing.assert_array_equal(beam_of(clean)[:n], beam)
    points, kept = lidar(clean, mask, "beam_loss", jnp.float32(0.25), key=KEY)
    per_beam = np.asarray(kept)[:n].reshape(64, 90).sum(axis=1)
    assert set(per_beam.tolist()) == {0, 90} and (per_beam == 0).sum() == 16
    assert float(jnp.abs(points[~kept]).max()) == 0.0  # what is lost cannot be read
    _, kept = lidar(clean, mask, "beam_loss", jnp.float32(1), key=KEY)
    assert int(kept.sum()) == 4 * 90

    _, kept = lidar(clean, mask, "sector_dropout", jnp.float32(1), key=KEY)
    gone = ~np.asarray(kept)[:n].reshape(64, 90)
    assert (gone == gone[0]).all() and gone[0].sum() in (14, 15, 16)  # 60 of 360 degrees
    azimuth = np.arange(-180, 180, 4)[gone[0]]
    assert np.ptp(azimuth) <= 60 and abs(azimuth.mean()) <= 42


def test_drawn_kind_under_vmap(image: jax.Array, scan: tuple[jax.Array, jax.Array]) -> None:
    keys = jax.random.split(KEY, 12)
    pair = ("blackout", "fog")
    out = jax.jit(jax.vmap(lambda k: random_camera_failure(image, kinds=pair, key=k, depth=DEPTH)))(
        keys
    )
    dark = np.asarray(out).max(axis=(1, 2, 3)) == 0.0
    assert 0 < dark.sum() < 12
    fog = 0.05 * np.asarray(image) + 0.95 * 0.8
    np.testing.assert_allclose(
        out[~dark], np.broadcast_to(fog, out[~dark].shape), atol=5 * READ_NOISE
    )
    draw = jax.vmap(
        lambda k: random_lidar_failure(*scan, kinds=("loss", "beam_loss"), key=k)[1].sum()
    )
    assert set(jax.jit(draw)(keys).tolist()) == {0, 4 * 90}


def test_bad_input_is_named(image: jax.Array, scan: tuple[jax.Array, jax.Array]) -> None:
    with pytest.raises(ValueError, match="camera failure 'rain': expected one of noise, blackout"):
        camera_failure(image, "rain", key=KEY)
    with pytest.raises(ValueError, match="lidar failure 'fog': expected one of noise, beam_loss"):
        lidar_failure(*scan, "fog", key=KEY)
    with pytest.raises(ValueError, match=r"severity=1\.5: expected a number from 0"):
        camera_failure(image, "noise", 1.5, key=KEY)
    with pytest.raises(ValueError, match="lidar failure none given"):
        random_lidar_failure(*scan, kinds=(), key=KEY)
