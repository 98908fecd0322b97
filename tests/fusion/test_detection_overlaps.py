"""Overlaps against shapely, in numpy and inside jit, and their properties."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.detection.geometry.overlaps import (
    box3d_iou,
    ground_iou,
    image_iou,
    rotated_intersection,
)


def polygon(box: np.ndarray) -> shapely.Polygon:
    x, z, length, width, yaw = box
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length / 2, width / 2]
    # Heading (cos, -sin) in (x, z), the side axis (sin, cos).
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return shapely.Polygon(corners @ turn + [x, z])


def random_boxes(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.uniform([-2, -2, 0.2, 0.2, -4], [2, 2, 5, 3, 4], (n, 5))


@pytest.fixture(scope="module")
def pairs() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Random pairs and the awkward ones: same, turned by 90 degrees, inside, touching, sliding."""
    rng = np.random.default_rng(0)
    a, b = random_boxes(rng, 240), random_boxes(rng, 240)
    b[:40] = a[:40]
    b[20:40, 4] += np.pi / 2
    b[40:60] = a[40:60] * [1, 1, 0.5, 0.5, 1]
    heading = np.stack([np.cos(a[:, 4]), -np.sin(a[:, 4])], axis=1)
    b[60:100] = a[60:100]
    b[60:80, :2] += heading[60:80] * a[60:80, 2:3]  # touching end to end
    b[80:100, :2] += heading[80:100] * 0.3 * a[80:100, 2:3]  # same sides, moved along
    inter = np.array([polygon(p).intersection(polygon(q)).area for p, q in zip(a, b, strict=True)])
    union = np.array([polygon(p).union(polygon(q)).area for p, q in zip(a, b, strict=True)])
    return a, b, inter, union


def test_rotated_overlap_equals_shapely(
    pairs: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    a, b, inter, union = pairs
    np.testing.assert_allclose(rotated_intersection(a, b), inter, atol=1e-12)
    np.testing.assert_allclose(ground_iou(a, b), inter / union, atol=1e-12)
    np.testing.assert_allclose(ground_iou(b, a), inter / union, atol=1e-12)


def test_inside_jit_at_float32(
    pairs: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    a, b, inter, union = pairs
    # 40 m away, where float32 coordinates are coarse.
    far = np.array([40.0, 40, 0, 0, 0])
    got = jax.jit(ground_iou)(jnp.asarray(a + far, jnp.float32), jnp.asarray(b + far, jnp.float32))
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, inter / union, atol=3e-4)
    table = ground_iou(a[:4, None], b[None, :6])
    assert table.shape == (4, 6)
    np.testing.assert_allclose(table[2, 2], inter[2] / union[2], atol=1e-12)


def test_gradient_follows_the_shared_edge() -> None:
    # Two equal upright squares of side 2, one moved by t: shared area 2 (2 - t).
    def shared(t: jax.Array) -> jax.Array:
        moved = jnp.stack([t, jnp.zeros_like(t), *jnp.array([2.0, 2.0, 0.0])])
        return rotated_intersection(moved, jnp.array([0.0, 0.0, 2.0, 2.0, 0.0]))

    np.testing.assert_allclose(jax.grad(shared)(jnp.float32(0.7)), -2.0, rtol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-10, 10), st.floats(-3.2, 3.2))
def test_moving_both_boxes_changes_nothing(seed: int, shift: float, turn: float) -> None:
    a, b = random_boxes(np.random.default_rng(seed), 8).reshape(2, 4, 5)
    before = ground_iou(a, b)
    c, s = np.cos(turn), np.sin(turn)
    for box in (a, b):
        x, z = box[:, 0].copy(), box[:, 1].copy()
        box[:, 0], box[:, 1] = c * x + s * z + shift, c * z - s * x - shift
        box[:, 4] += turn
    np.testing.assert_allclose(ground_iou(a, b), before, atol=1e-10)
    assert ((before >= 0) & (before <= 1)).all()


def test_upright_and_3d_overlap() -> None:
    rng = np.random.default_rng(1)
    corner = rng.uniform(0, 4, (60, 2, 2))
    boxes = np.concatenate([corner, corner + rng.uniform(0.5, 4, (60, 2, 2))], axis=2)
    a, b = boxes[:, 0], boxes[:, 1]
    polys = [[shapely.box(*box) for box in row] for row in boxes]
    inter = np.array([p.intersection(q).area for p, q in polys])
    np.testing.assert_allclose(image_iou(a, b), inter / [p.union(q).area for p, q in polys])
    np.testing.assert_allclose(image_iou(a, b, over="first"), inter / [p.area for p, _ in polys])
    assert image_iou(a[0] * 0, b[0] * 0) == 0
    with pytest.raises(ValueError, match="over='second', expected 'union' or 'first'"):
        image_iou(a, b, over="second")

    # One box raised by a quarter of its height, and turned by half a circle: 0.75 / 1.25.
    box = np.array([1.0, 1.7, 20.0, 4.0, 1.6, 1.5, 0.4])
    raised = box + np.array([0, -0.375, 0, 0, 0, 0, np.pi])
    np.testing.assert_allclose(box3d_iou(box, raised), 0.6, atol=1e-12)
    assert box3d_iou(box, box + np.array([0, -1.5, 0, 0, 0, 0, 0])) == 0
