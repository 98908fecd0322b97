"""Turned and scaled scenes: pixels stay, labels go along, those outside are dropped."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.detection.geometry.encodings import box_corners
from fusion.detection.learning.augmentation import turn_and_scale
from fusion.detection.learning.examples import make_example, make_inputs
from fusion.detection.learning.training import DetectorTrainConfig, training_inputs
from fusion.detection.network.lifting import grid_centres, lift
from fusion.detection.presets import preset
from tests.fusion.test_detection_network import a_frame

TINY = preset("tiny", "dense").config
P2 = jnp.array([[70.0, 2, 48, 5], [0, 70, 16, 1], [0, 0, 1, 0.003]])
PLANE = jnp.array([0.0, -1.0, 0.0, 1.6])
ANGLE, FACTOR = np.radians(20.0), 1.1


def _pixels(p2: np.ndarray, points: np.ndarray) -> np.ndarray:
    seen = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ np.asarray(p2).T
    return seen[:, :2] / seen[:, 2:]


def test_points_stay_at_their_pixels_and_in_their_boxes() -> None:
    truth = jnp.array([[-2.4, 1.6, 9.4, 4.2, 1.7, 1.5, 0.3], [3.4, 1.6, 14.6, 3.6, 1.6, 1.4, -3.0]])
    plane = jnp.array([0.1, -0.99, 0.05, 1.6])
    corners = box_corners(truth).reshape(-1, 3)
    moved, p2, ground, boxes = jax.jit(turn_and_scale)(
        jnp.float32(ANGLE), jnp.float32(FACTOR), corners, P2, plane, truth
    )
    np.testing.assert_allclose(_pixels(p2, moved), _pixels(P2, corners), rtol=1e-4)
    # The corners of the new boxes are where the corners of the old ones have gone.
    np.testing.assert_allclose(box_corners(boxes).reshape(-1, 3), moved, atol=1e-4)
    heights = np.asarray(corners) @ plane[:3] + plane[3]
    np.testing.assert_allclose(moved @ ground[:3] + ground[3], FACTOR * heights, atol=1e-4)
    # By 90 degrees what is ahead (z) comes to the right (x), at the distance that it had.
    ahead = jnp.array([[0.0, 0.0, 10.0]])
    right = turn_and_scale(jnp.float32(np.pi / 2), jnp.float32(1), ahead, P2, plane, truth)[0]
    np.testing.assert_allclose(right, [[10.0, 0, 0]], atol=1e-5)


def test_the_camera_is_read_at_the_same_place() -> None:
    u, v = jnp.meshgrid(jnp.linspace(0, 1, 48), jnp.linspace(0, 1, 16))
    size = jnp.array([32.0, 96.0])
    points = jnp.zeros((1, 3))
    angle, factor = jnp.float32(np.radians(10)), jnp.float32(1.1)
    _, p2, plane, _ = turn_and_scale(angle, factor, points, P2, PLANE, jnp.zeros((1, 7)))
    got = jax.jit(partial(lift, TINY))(jnp.stack([u, v], axis=-1), plane, p2, size)
    x, z = grid_centres(TINY)
    c, s = np.cos(-angle), np.sin(-angle)
    # Where the cell's point was before: turned back, and smaller.
    was = np.stack([c * x + s * z, np.full_like(x, 1.1 * 1.6 - 1.0), -s * x + c * z], -1) / 1.1
    pixels = _pixels(P2, was.reshape(-1, 3)).reshape(*x.shape, 2) / [95.0, 31.0]
    inside = ((pixels > 0.01) & (pixels < 0.99)).all(axis=-1)
    assert inside.sum() > 100
    k = TINY.dense.heights.index(1.0)
    np.testing.assert_allclose(got[inside][:, 2 * k : 2 * k + 2], pixels[inside], atol=1e-3)


@pytest.mark.slow
def test_labels_that_leave_the_area_are_none() -> None:
    example, _ = make_example(TINY, a_frame())
    read = jax.jit(lambda a, f: make_inputs(TINY, example, turn=(a, f)))
    plain = make_inputs(TINY, example)
    same = read(jnp.float32(0), jnp.float32(1))
    np.testing.assert_allclose(same.bev, plain.bev, atol=1e-5)
    np.testing.assert_array_equal(same.truth_mask, plain.truth_mask)
    turned = read(jnp.float32(np.radians(40)), jnp.float32(1))
    # The car at (3.4, 14.6) goes to x = 12, the one at (-2.4, 9.4) to x = 4.2.
    assert turned.truth_mask.tolist() == [True, False, False, False]
    np.testing.assert_allclose(turned.truth[0, :3], [4.204, 1.6, 8.744], atol=1e-3)
    train = DetectorTrainConfig(flip=False, rotation=10.0, scaling=0.05)
    draw = jax.jit(lambda k: training_inputs(TINY, train, example, key=k)[0].truth)
    found = np.asarray(jax.vmap(draw)(jax.random.split(jax.random.key(0), 40)))[:, 0]
    change, turn = found[:, 3] / 4.2 - 1.0, np.degrees(found[:, 6] - 0.1)
    assert 0.04 < np.abs(change).max() <= 0.0501 and 8 < np.abs(turn).max() <= 10.001
    assert abs(np.corrcoef(change, turn)[0, 1]) < 0.4
    for bad in ({"rotation": 60.0}, {"scaling": -0.1}):
        with pytest.raises(ValueError, match="expected an angle up to 45"):
            dataclasses.replace(train, **bad)
