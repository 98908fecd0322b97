"""Anchors, encodings and suppression against plain code, shapely and each other."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from fusion.detection.geometry.anchors import (
    AnchorConfig,
    anchor_grid,
    cluster_sizes,
    select_anchors,
)
from fusion.detection.geometry.bev import BevConfig, pad_points
from fusion.detection.geometry.encodings import (
    anchor_ground,
    angle_vector,
    box3d_to_anchor,
    box3d_to_box4c,
    box4c_to_box3d,
    box_corners,
    decode_offsets,
    encode_offsets,
    ground_box,
    project_boxes,
    resolve_heading,
)
from fusion.detection.geometry.suppression import nms, pairwise

PLANE = jnp.array([0.02, -0.9997, 0.01, 1.6])


@pytest.fixture(scope="module")
def boxes() -> np.ndarray:
    rng = np.random.default_rng(0)
    low, high = [-20, 1, 5, 3, 1.2, 1.3, -3.1], [20, 2, 60, 5, 2, 2, 3.1]
    return rng.uniform(low, high, (64, 7)).astype(np.float32)


def ground_polygon(corners: np.ndarray) -> shapely.Polygon:
    return shapely.Polygon(corners[:4][:, [0, 2]])


def test_corners_and_overlap_agree_with_shapely(boxes: np.ndarray) -> None:
    corners = np.asarray(box_corners(jnp.asarray(boxes)))
    _, y, _, length, width, height, yaw = boxes.astype(np.float64).T
    np.testing.assert_allclose(corners.mean(axis=1)[:, [0, 2]], boxes[:, [0, 2]], atol=1e-4)
    np.testing.assert_allclose(corners[:, :4, 1], np.tile(y[:, None], 4), atol=1e-5)
    np.testing.assert_allclose(corners[:, 4:, 1], np.tile((y - height)[:, None], 4), atol=1e-5)
    # The front face looks along the heading (cos, -sin).
    front = corners[:, [0, 1]].mean(axis=1)[:, [0, 2]] - boxes[:, [0, 2]]
    heading = np.stack([np.cos(yaw), -np.sin(yaw)], axis=1) * (length / 2)[:, None]
    np.testing.assert_allclose(front, heading, atol=1e-4)
    near = boxes.copy()
    near[:, [0, 2]] = 0.1 * near[:, [0, 2]]
    polygons = [ground_polygon(c) for c in np.asarray(box_corners(jnp.asarray(near)), np.float64)]
    expected = [
        [p.intersection(q).area / p.union(q).area for q in polygons[:8]] for p in polygons[:8]
    ]
    ground = ground_box(jnp.asarray(near[:8]))
    np.testing.assert_allclose(pairwise(ground, ground, "rotated"), expected, atol=1e-4)
    area = np.array([p.area for p in polygons])
    np.testing.assert_allclose(area, length * width, rtol=1e-4)


def test_anchor_encodes_and_decodes(boxes: np.ndarray) -> None:
    exact = box3d_to_anchor(jnp.asarray(boxes), square=True)
    quarter = np.round(boxes[:, 6] / (np.pi / 2)) % 2 == 1
    dx = np.where(quarter, boxes[:, 4], boxes[:, 3])
    np.testing.assert_allclose(exact[:, 3], dx, rtol=1e-5)
    around = box3d_to_anchor(jnp.asarray(boxes))
    corners = np.asarray(box_corners(jnp.asarray(boxes)))
    bounds = np.concatenate([corners[:, :4].min(1)[:, [0, 2]], corners[:, :4].max(1)[:, [0, 2]]], 1)
    np.testing.assert_allclose(anchor_ground(around), bounds, atol=1e-3)
    anchors = jnp.asarray(np.roll(np.asarray(exact), 1, axis=0))
    offsets = encode_offsets(anchors, exact)
    np.testing.assert_allclose(decode_offsets(anchors, offsets), exact, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(encode_offsets(exact, exact), 0.0, atol=1e-6)


def test_four_corners_come_back(boxes: np.ndarray) -> None:
    code = box3d_to_box4c(jnp.asarray(boxes), PLANE)
    back = box4c_to_box3d(code, PLANE)
    np.testing.assert_allclose(back[:, :6], boxes[:, :6], atol=1e-3)
    turn = np.asarray(back[:, 6]) - boxes[:, 6]
    np.testing.assert_allclose(np.abs(np.sin(turn)), 0.0, atol=1e-3)
    heading = resolve_heading(back[:, 6], 3.0 * angle_vector(jnp.asarray(boxes[:, 6])))
    np.testing.assert_allclose(np.cos(np.asarray(heading) - boxes[:, 6]), 1.0, atol=1e-5)
    assert (np.asarray(heading) >= -np.pi).all() and (np.asarray(heading) < np.pi).all()
    # Numbering: turned back to the nearest quarter, the first corner is the one at (+x, +z).
    quarter = np.round(boxes[:, 6] / (np.pi / 2))
    t = boxes[:, 6] - quarter * (np.pi / 2)
    dx, dz = np.asarray(code[:, 0]) - boxes[:, 0], np.asarray(code[:, 4]) - boxes[:, 2]
    sides = np.where(quarter % 2 == 1, boxes[:, [4, 3]].T, boxes[:, [3, 4]].T) / 2
    np.testing.assert_allclose(np.cos(t) * dx - np.sin(t) * dz, sides[0], atol=1e-4)
    np.testing.assert_allclose(np.sin(t) * dx + np.cos(t) * dz, sides[1], atol=1e-4)
    heights = np.asarray(code[:, 8:])
    np.testing.assert_allclose(heights[:, 1] - heights[:, 0], boxes[:, 5], rtol=1e-4)


def test_crooked_corners_give_the_box_around_them_along_their_longer_axis() -> None:
    rng = np.random.default_rng(5)
    square = np.array([[2.0, 1], [2, -1], [-2, -1], [-2, 1]])
    crooked = square[None] + rng.uniform(-0.6, 0.6, (50, 4, 2))
    code = np.concatenate([crooked[..., 0], crooked[..., 1], np.tile([0.1, 1.6], (50, 1))], axis=1)
    level = jnp.array([0.0, -1.0, 0.0, 1.6])
    got = np.asarray(box4c_to_box3d(jnp.asarray(code, jnp.float32), level))
    for corners, box in zip(crooked, got, strict=True):
        heading = (corners[0] + corners[1] - corners[2] - corners[3]) / 2
        heading = heading / np.linalg.norm(heading)
        side = np.array([-heading[1], heading[0]])
        along, across = corners @ heading, corners @ side
        middle = heading * (along.min() + along.max()) / 2
        middle = middle + side * (across.min() + across.max()) / 2
        np.testing.assert_allclose(box[[0, 2]], middle, atol=1e-5)
        np.testing.assert_allclose(box[[3, 4]], [np.ptp(along), np.ptp(across)], rtol=1e-5)
        np.testing.assert_allclose(box[6], -np.arctan2(heading[1], heading[0]), atol=1e-5)
        # Why AVOD's shift across the heading is no shift: seen from the rear midpoint the
        # extremes are opposite.
        rear = (corners[2] + corners[3]) / 2 @ side
        np.testing.assert_allclose(across.min() + across.max() - 2 * rear, 0.0, atol=1e-12)
    np.testing.assert_allclose(got[:, 1], 1.5, atol=1e-6)


def test_projected_boxes_hold_the_corners(boxes: np.ndarray) -> None:
    p2 = np.array([[700.0, 0, 600, 40], [0, 700, 180, 0.2], [0, 0, 1, 0.003]], np.float32)
    corners = np.asarray(box_corners(jnp.asarray(boxes)))
    got = project_boxes(jnp.asarray(corners), jnp.asarray(p2), 375.0, 1242.0)
    flat = corners.reshape(-1, 3) @ p2[:, :3].T + p2[:, 3]
    pixels = (flat[:, :2] / flat[:, 2:]).reshape(-1, 8, 2) / [1241, 374]
    low, high = pixels.min(axis=1), pixels.max(axis=1)
    expected = np.stack([low[:, 1], low[:, 0], high[:, 1], high[:, 0]], axis=1)
    np.testing.assert_allclose(got, expected, rtol=1e-3, atol=1e-4)


def plain_nms(overlap: np.ndarray, scores: np.ndarray, limit: float, k: int) -> list[int]:
    kept: list[int] = []
    for i in np.argsort(-scores, kind="stable"):
        if all(overlap[i, j] <= limit for j in kept):
            kept.append(int(i))
    return kept[:k]


@pytest.mark.parametrize("overlap", ["upright", "rotated"])
def test_suppression_equals_one_box_at_a_time(overlap: str) -> None:
    rng = np.random.default_rng(2)
    run = jax.jit(
        partial(nms, iou_threshold=0.3, max_output=12, max_candidates=48, overlap=overlap)
    )
    for n_real in (48, 30, 3, 0):
        if overlap == "upright":
            corner = rng.uniform(0, 10, (48, 2))
            boxes = np.concatenate([corner, corner + rng.uniform(1, 5, (48, 2))], axis=1)
        else:
            boxes = rng.uniform([0, 0, 2, 1, -3], [10, 10, 5, 2, 3], (48, 5))
        scores = rng.permutation(48).astype(np.float32)
        mask = np.arange(48) < n_real
        both = jnp.asarray(boxes, jnp.float32)
        table = np.asarray(pairwise(both, both, overlap))
        expected = plain_nms(table[:n_real, :n_real], scores[:n_real], 0.3, 12)
        index, found = run(jnp.asarray(boxes, jnp.float32), jnp.asarray(scores), jnp.asarray(mask))
        assert np.asarray(index)[np.asarray(found)].tolist() == expected
        assert found.sum() == len(expected) and index.shape == (12,)


def test_suppression_keeps_shapes_and_names_bad_options() -> None:
    boxes = jnp.array([[0.0, 0, 1, 1], [5, 5, 6, 6]])
    scores = jnp.array([jnp.nan, 0.5])
    index, found = nms(boxes, scores, jnp.array([True, True]), iou_threshold=0.5, max_output=4)
    assert index.tolist() == [1, 0, 0, 0] and found.tolist() == [True, False, False, False]
    with pytest.raises(ValueError, match="max_output=0"):
        nms(boxes, scores, scores > 0, iou_threshold=0.5, max_output=0)
    with pytest.raises(ValueError, match="overlap='round', expected 'upright' or 'rotated'"):
        pairwise(boxes, boxes, "round")
    with pytest.raises(ValueError, match="boxes have 4 and 4 columns, expected 5"):
        pairwise(boxes, boxes, "rotated")


def test_sizes_are_the_centres_of_clusters() -> None:
    rng = np.random.default_rng(3)
    true = np.array([[3.5, 1.6, 1.5], [4.3, 1.7, 1.6], [10.0, 2.5, 3.0]])
    sizes = np.concatenate([c + rng.normal(0, 0.03, (50, 3)) for c in true])
    centres = cluster_sizes(sizes, 3)
    means = sizes.reshape(3, 50, 3).mean(axis=1)
    np.testing.assert_allclose(centres, means, atol=1e-12)
    # A fixed point of Lloyd's step, also where the clusters are not apart.
    blob = rng.normal([4, 1.6, 1.5], 0.3, (200, 3))
    centres = cluster_sizes(blob, 2)
    nearest = ((blob[:, None] - centres) ** 2).sum(axis=2).argmin(axis=1)
    np.testing.assert_allclose(centres, [blob[nearest == i].mean(axis=0) for i in (0, 1)])
    with pytest.raises(ValueError, match="2 clusters of 1 different sizes"):
        cluster_sizes(np.ones((5, 3)), 2)


AREA = BevConfig(x_range=(-5.0, 5.0), z_range=(0.0, 10.0), cell=0.25)
ANCHORS = AnchorConfig(sizes=((3.5, 1.5, 1.5), (4.0, 2.0, 1.6)), stride=1.0, max_anchors=200)


def test_grid_stands_on_the_ground() -> None:
    grid = np.asarray(anchor_grid(ANCHORS, AREA, PLANE))
    assert grid.shape == (10 * 10 * 4, 6)
    np.testing.assert_allclose(grid[:, :3] @ np.asarray(PLANE)[:3] + PLANE[3], 0.0, atol=1e-4)
    assert sorted({tuple(np.round(r, 2)) for r in grid[:, 3:].tolist()}) == [
        (1.5, 1.5, 3.5), (2.0, 1.6, 4.0), (3.5, 1.5, 1.5), (4.0, 1.6, 2.0)
    ]  # fmt: skip
    assert grid[:, 0].min() == -4.5 and grid[:, 2].max() == 9.5
    full = jax.eval_shape(
        lambda p: anchor_grid(AnchorConfig(((4.0, 2.0, 1.0),) * 2), BevConfig(), p), PLANE
    )
    assert full.shape == (89_600, 6)
    for wrong in ({"sizes": ()}, {"sizes": ((1.0, 2.0, 0.0),)}):
        with pytest.raises(ValueError, match="sizes="):
            AnchorConfig(**wrong)
    with pytest.raises(ValueError, match=r"stride=0\.0"):
        AnchorConfig(sizes=((1.0, 1.0, 1.0),), stride=0.0)


@pytest.mark.parametrize("size", [200, 20])
def test_only_anchors_over_points_are_kept(size: int) -> None:
    rng = np.random.default_rng(4)
    plane = np.asarray(PLANE)
    height = np.array([1.0, 0.1, 2.5, 0.5, 0.7, 1.2])  # the second is ground, the third a tree
    x, z = rng.uniform(-4, 4, 6), rng.uniform(1, 9, 6)
    y = -(plane[0] * x + plane[2] * z + plane[3] - height) / plane[1]
    points, mask = pad_points(np.stack([x, y, z], axis=1), 8)
    grid = anchor_grid(ANCHORS, AREA, PLANE)
    config = AnchorConfig(sizes=ANCHORS.sizes, stride=1.0, max_anchors=size, fill=False)
    got = jax.jit(partial(select_anchors, config, AREA))(
        grid, jnp.asarray(points), jnp.asarray(mask), PLANE
    )
    # By hand: cells that hold a point, anchors whose rounded borders hold such a cell.
    cells = np.zeros(AREA.shape, bool)
    for i in (0, 3, 4, 5):
        cells[int((10 - z[i]) / 0.25), int((x[i] + 5) / 0.25)] = True
    expected = []
    for i, (ax, _, az, dx, _, dz) in enumerate(np.asarray(grid, np.float64)):
        t, b = (np.clip(np.round((10 - az + s * dz / 2) / 0.25), 0, 40) for s in (-1, 1))
        le, r = (np.clip(np.round((ax + s * dx / 2 + 5) / 0.25), 0, 40) for s in (-1, 1))
        if cells[int(t) : int(b), int(le) : int(r)].any():
            expected.append(i)
    assert 20 < len(expected) < 200
    assert int(got.n_occupied) == len(expected)
    assert np.asarray(got.grid_index)[np.asarray(got.mask)].tolist() == expected[:size]
    np.testing.assert_array_equal(got.boxes, np.asarray(grid)[np.asarray(got.grid_index)])


def test_a_dead_lidar_leaves_anchors_everywhere() -> None:
    grid = anchor_grid(ANCHORS, AREA, PLANE)
    nothing = jnp.zeros((4, 3)), jnp.zeros(4, bool)
    got = jax.jit(partial(select_anchors, ANCHORS, AREA))(grid, *nothing, PLANE)
    assert int(got.n_occupied) == 0
    kept = np.asarray(got.boxes)[np.asarray(got.mask)]
    assert len(kept) == 200
    # Half of the places, each with all its sizes and rotations.
    assert len({tuple(r) for r in kept[:, [0, 2]].tolist()}) == 50
    assert len({tuple(r) for r in kept[:, 3:].tolist()}) == 4


def test_spare_slots_stand_evenly_where_the_lidar_is_blind() -> None:
    """Half of the view is lost; before, no anchor was left there."""
    plane = np.asarray(PLANE)
    x, z = (g.ravel() for g in np.meshgrid(np.arange(-4.5, 0, 0.5), np.arange(1, 9, 0.5)))
    y = -(plane[0] * x + plane[2] * z + plane[3] - 1.0) / plane[1]
    points, mask = pad_points(np.stack([x, y, z], axis=1), 200)
    grid = anchor_grid(ANCHORS, AREA, PLANE)
    config = AnchorConfig(sizes=ANCHORS.sizes, stride=1.0, max_anchors=360)
    select = jax.jit(partial(select_anchors, config, AREA))
    got = select(grid, jnp.asarray(points), jnp.asarray(mask), PLANE)
    bare = dataclasses.replace(config, fill=False)
    occupied = select_anchors(bare, AREA, grid, jnp.asarray(points), jnp.asarray(mask), PLANE)
    kept, held = (np.asarray(a.grid_index)[np.asarray(a.mask)].tolist() for a in (got, occupied))
    assert set(held) <= set(kept) and kept == sorted(set(kept)) and 320 < len(kept) <= 360
    assert int(got.n_occupied) == int(occupied.n_occupied) == len(held)
    # Every car in the blind half has a place within a metre and a half.
    places = np.asarray(got.boxes)[np.asarray(got.mask)][:, [0, 2]]
    blind = np.stack(np.meshgrid(np.arange(1.5, 4.6, 0.5), np.arange(0.5, 9.6, 0.5)), -1)
    away = np.linalg.norm(blind.reshape(-1, 1, 2) - places[None], axis=2).min(axis=1)
    assert away.max() < 1.5


@pytest.mark.data
def test_sizes_of_real_cars(data_dir: Path) -> None:
    from fusion.detection.kitti.files import frame_names, read_labels

    folder = data_dir / "kitti" / "training" / "label_2"
    sizes = []
    for name in frame_names(folder):
        labels = read_labels(folder / f"{name}.txt")
        sizes.append(labels.dimensions[labels.type == "Car"][:, [2, 1, 0]])
    small, large = cluster_sizes(np.concatenate(sizes), 2)
    assert 3.3 < small[0] < 3.8 < large[0] < 4.6
    assert 1.4 < small[1] < large[1] < 1.9
