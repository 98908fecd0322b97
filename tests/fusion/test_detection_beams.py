"""Lidars other than the HDL-64E: their beams are told from scans, given, or refused; and lost."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.detection.config import DetectorConfig
from fusion.detection.kitti.files import read_points
from fusion.detection.kitti.sensor_files import write_points
from fusion.detection.learning.cache import open_cache, prepare_cache
from fusion.detection.sensors import (
    ELEVATIONS,
    beam_of,
    beams_of_scans,
    elevations_of,
    find_beams,
    lidar_failure,
    random_lidar_failure,
)
from tests.snn_fusion_failure.test_train_detector import write_frame

LIDARS = {
    16: np.linspace(15.0, -15.0, 16),
    32: np.linspace(10.67, -30.67, 32),
    # Dense in the middle, as the 40-beam ones are: steps of 1/3, 1 and up to 6 degrees.
    40: np.concatenate([[15, 11, 8, 5, 3], 2.0 - np.arange(24) / 3, -6.67 - np.arange(11)]),
    128: np.linspace(11.25, -11.25, 128),
}  # fmt: skip
KEY = jax.random.key(1)


def scan(degrees: np.ndarray, spread: float = 0.0, n: int = 60) -> np.ndarray:
    """Points `[beams * n, 4]` of a lidar with these beams, beam by beam."""
    rng = np.random.default_rng(0)
    elevation = np.radians(np.repeat(degrees, n)) + np.radians(spread) * rng.normal(
        size=len(degrees) * n
    )
    azimuth, distance = rng.uniform(-0.7, 0.7, elevation.shape), rng.uniform(4, 40, elevation.shape)
    flat = distance * np.cos(elevation)
    place = [flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)]
    return np.stack([*place, np.full(elevation.shape, 0.3)], axis=1).astype(np.float32)


@pytest.mark.parametrize("n", sorted(LIDARS))
def test_beams_are_found_and_lost(n: int) -> None:
    points = scan(LIDARS[n], spread=0.01 if n < 128 else 0.002)
    for given in (None, n):
        found = find_beams(elevations_of(points), given)
        np.testing.assert_allclose(np.degrees(found), LIDARS[n], atol=0.01)
    told = beams_of_scans([elevations_of(points)])
    assert told is not None and len(told) == n
    config = DetectorConfig(beams=told)
    beam = np.repeat(np.arange(n), 60)
    np.testing.assert_array_equal(beam_of(jnp.asarray(points), config.beam_elevations), beam)
    mask = jnp.ones(len(points), bool)
    for severity, lost in ((0.5, n // 2), (1.0, n - max(1, n // 16))):
        _, kept = lidar_failure(
            jnp.asarray(points), mask, "beam_loss", severity, key=KEY, beams=config.beam_elevations
        )
        per_beam = np.asarray(kept).reshape(n, 60).sum(axis=1)
        # Whole beams go; by the HDL-64E's beams parts of one would stay, or several go together.
        assert set(per_beam.tolist()) <= {0, 60} and (per_beam == 0).sum() == lost


def test_the_lidar_of_the_benchmark_stays_what_it_was() -> None:
    known = np.degrees(ELEVATIONS).astype(np.float64)
    for seen in (known, known[5:]):  # the top beams meet nothing in some scenes
        assert beams_of_scans([elevations_of(scan(seen, 0.01))]) is None
    # Corrected for motion: beams run into each other, and the points lie in its view.
    assert beams_of_scans([elevations_of(scan(known, 0.3))]) is None
    np.testing.assert_array_equal(DetectorConfig().beam_elevations, ELEVATIONS)
    assert beams_of_scans([]) is None


def test_beams_that_cannot_be_told_are_refused() -> None:
    blurred = elevations_of(scan(LIDARS[128], spread=0.2))
    with pytest.raises(ValueError, match="beams=unknown: 7680 points do not show them by their"):
        find_beams(blurred)
    with pytest.raises(ValueError, match=r"do not show 128 of them .* the lidar's data sheet"):
        beams_of_scans([blurred], 128)
    with pytest.raises(ValueError, match="do not show 17 of them"):
        find_beams(elevations_of(scan(LIDARS[16])), 17)
    with pytest.raises(ValueError, match="n_beams=3: expected 4 to 256"):
        find_beams(blurred, 3)
    assert beams_of_scans([blurred]) == ()
    assert beams_of_scans([blurred], (-3.0, 5.0, 1.0)) == (5.0, 1.0, -3.0)
    unknown = DetectorConfig(beams=()).beam_elevations
    points, mask = jnp.ones((8, 4)), jnp.ones(8, bool)
    for fail in (lidar_failure, random_lidar_failure):
        options = {"kind": "beam_loss"} if fail is lidar_failure else {}
        with pytest.raises(ValueError, match=r"beams=\[\]: expected the elevations .*`--beams`"):
            fail(points, mask, key=KEY, beams=unknown, **options)
    lidar_failure(points, mask, "loss", key=KEY, beams=unknown)  # needs no beams
    for wrong in ((1.0, 1.0), (-1.0, 1.0), (3.0,), (95.0, 1.0)):
        with pytest.raises(ValueError, match=r"expected elevations .* from the top beam down"):
            DetectorConfig(beams=wrong)


def test_a_cache_keeps_the_beams_of_its_scans(tmp_path: Path) -> None:
    (tmp_path / "ImageSets").mkdir()
    write_frame(tmp_path, "000000", 0)
    (tmp_path / "ImageSets" / "train.txt").write_text("000000\n")
    path = tmp_path / "training" / "velodyne" / "000000.bin"
    write_points(path, np.concatenate([read_points(path), scan(LIDARS[16], n=400)]))
    options = {"splits": ("train",), "any_size": True}
    for name, given, expected in (
        ("told", LIDARS[16].tolist(), 16), ("unknown", None, 0), ("number", 16, None),
    ):  # fmt: skip
        if expected is None:  # the other points hide the beams
            with pytest.raises(ValueError, match="do not show 16 of them"):
                prepare_cache(tmp_path, tmp_path / name, "tiny", beams=given, **options)
            continue
        prepare_cache(tmp_path, tmp_path / name, "tiny", beams=given, **options)
        cache = open_cache(tmp_path / name)
        assert cache.beams is not None and len(cache.beams) == expected
        assert cache.config("dense").beams == cache.beams
    like = open_cache(tmp_path / "told")
    made = prepare_cache(tmp_path, tmp_path / "like", "tiny", like=like, **options)
    assert made.beams == like.beams
    # Caches of before have the HDL-64E's.
    record = tmp_path / "told" / "cache.json"
    record.write_text(record.read_text().replace('"beams"', '"other"'))
    assert open_cache(tmp_path / "told").beams is None
