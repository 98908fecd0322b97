"""Bird's-eye-view maps and crops against plain loops."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from fusion.detection.geometry.bev import BevConfig, bev_maps, ground_to_unit, pad_points
from fusion.detection.network.crop import crop_and_resize

SMALL = BevConfig(x_range=(-4.0, 4.0), z_range=(0.0, 6.0), cell=0.5)
PLANE = np.array([0.02, -0.9997, 0.01, 1.6], np.float32)


def plain_maps(points: np.ndarray, plane: np.ndarray, config: BevConfig) -> np.ndarray:
    """One point at a time."""
    rows, columns = config.shape
    maps = np.zeros((rows, columns, config.n_slices + 1))
    counts = np.zeros((rows, columns))
    low, high = config.height_range
    thick = (high - low) / config.n_slices
    for x, y, z in points:
        row = int(np.floor((config.z_range[1] - z) / config.cell))
        column = int(np.floor((x - config.x_range[0]) / config.cell))
        height = plane[0] * x + plane[1] * y + plane[2] * z + plane[3]
        if not (0 <= row < rows and 0 <= column < columns and low <= height < high):
            continue
        s = int((height - low) / thick)
        maps[row, column, s] = max(maps[row, column, s], (height - low - s * thick) / thick)
        counts[row, column] += 1
    maps[..., -1] = np.minimum(1, np.log(counts + 1) / np.log(16))
    return maps


def test_maps_equal_one_point_at_a_time() -> None:
    rng = np.random.default_rng(0)
    clouds = [rng.uniform([-5, -1.5, -1], [5, 2.2, 7], (n, 3)) for n in (700, 300)]
    clouds[1][0, 1] = np.nan
    padded, masks = zip(*(pad_points(c, 800) for c in clouds), strict=True)
    plane = jnp.asarray(PLANE)
    batched = jax.jit(jax.vmap(lambda p, m: bev_maps(SMALL, p, m, plane)))
    got = batched(jnp.asarray(np.stack(padded)), jnp.asarray(np.stack(masks)))
    assert got.shape == (2, 12, 16, 6) and got.dtype == jnp.float32
    for cloud, map_ in zip(clouds, got, strict=True):
        good = cloud[~np.isnan(cloud).any(axis=1)]
        np.testing.assert_allclose(map_, plain_maps(good, PLANE, SMALL), atol=2e-5)
    assert got.min() == 0 and 0.9 < got.max() <= 1
    # Padding lies at the origin: had it counted, the cell there would be full.
    assert (got[1, :, :, -1] < 1).all()


def test_far_is_up_and_left_is_left() -> None:
    points, mask = pad_points(np.array([[-3.9, 1.0, 5.9]]), 4)
    maps = bev_maps(SMALL, jnp.asarray(points), jnp.asarray(mask), jnp.asarray(PLANE))
    assert np.argwhere(np.asarray(maps[..., -1])).tolist() == [[0, 0]]


def test_bad_areas_and_point_counts_are_named() -> None:
    assert BevConfig().shape == (700, 800)
    with pytest.raises(ValueError, match=r"x_range=\(0.0, 1.05\) holds 10.5 cells of 0.1 m"):
        BevConfig(x_range=(0.0, 1.05))
    with pytest.raises(ValueError, match=r"z_range=\(70.0, 0.0\): expected the lower bound first"):
        BevConfig(z_range=(70.0, 0.0))
    with pytest.raises(ValueError, match="n_slices=0"):
        BevConfig(n_slices=0)
    for n in (0, 9):
        with pytest.raises(ValueError, match=f"{n} points, expected 1 to 8"):
            pad_points(np.zeros((n, 3)), 8)


def plain_crop(features: np.ndarray, box: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    height, width, n = features.shape
    y = np.linspace(box[0], box[2], size[0]) if size[0] > 1 else np.array([(box[0] + box[2]) / 2])
    x = np.linspace(box[1], box[3], size[1]) if size[1] > 1 else np.array([(box[1] + box[3]) / 2])
    grid = np.stack(np.meshgrid(y * (height - 1), x * (width - 1), indexing="ij"))
    inside = (grid >= 0).all(0) & (grid[0] <= height - 1) & (grid[1] <= width - 1)
    channels = [map_coordinates(features[..., c], grid, order=1, mode="nearest") for c in range(n)]
    return np.where(inside[..., None], np.stack(channels, axis=-1), 0.0)


@pytest.mark.parametrize("size", [(3, 4), (1, 2)])
def test_crops_equal_scipy(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    features = rng.normal(size=(7, 9, 2)).astype(np.float32)
    boxes = rng.uniform(-0.3, 1.3, (12, 4)).astype(np.float32)
    boxes[0], boxes[1] = [0, 0, 1, 1], [0.5, 0.5, 0.5, 0.5]
    crop = jax.jit(partial(crop_and_resize, size=size))
    got = crop(jnp.asarray(features), jnp.asarray(boxes))
    expected = [plain_crop(features, box, size) for box in boxes.astype(np.float64)]
    np.testing.assert_allclose(got, np.stack(expected), atol=1e-5)


def test_crops_pass_gradients_and_refuse_no_size() -> None:
    features = jnp.arange(12.0).reshape(3, 4, 1)
    box = jnp.array([[0.25, 0.0, 0.75, 1.0]])
    slope = jax.grad(lambda f: crop_and_resize(f, box, (2, 4)).sum())(features)
    # Rows at 0.5 and 1.5: half of the first and last row, the whole middle one.
    np.testing.assert_allclose(slope[..., 0], np.outer([0.5, 1, 0.5], np.ones(4)), atol=1e-6)
    with pytest.raises(ValueError, match=r"size=\(0, 3\), expected at least one row"):
        crop_and_resize(features, box, (0, 3))


def test_ground_box_finds_its_cells() -> None:
    # A box that covers cells 2..4 along z (rows 7..9 from the top) and columns 6..9.
    box = jnp.array([[-1.0, 1.0, 1.0, 2.5]])
    unit = ground_to_unit(SMALL, box)
    rows, columns = SMALL.shape
    edges = np.asarray(unit[0]) * np.array([rows - 1, columns - 1, rows - 1, columns - 1])
    # Borders of cells lie half a cell before their centres.
    np.testing.assert_allclose(edges, [6.5, 5.5, 9.5, 9.5], atol=1e-5)


@pytest.mark.data
@pytest.mark.slow
def test_full_size_maps_of_a_real_frame(data_dir: Path) -> None:
    from fusion.detection.kitti.calibration import in_image, lidar_to_camera, project
    from fusion.detection.kitti.files import read_frame

    frame = read_frame(data_dir / "kitti", "000008")
    camera = lidar_to_camera(frame.calibration, frame.points[:, :3])
    pixels, depth = project(frame.calibration, camera)
    camera = camera[in_image(pixels, depth, *frame.image.shape[:2])]
    points, mask = pad_points(camera, 40_000)
    assert frame.plane is not None
    plane = frame.plane.astype(np.float32)
    maps = jax.jit(partial(bev_maps, BevConfig()))(
        jnp.asarray(points), jnp.asarray(mask), jnp.asarray(plane)
    )
    expected = plain_maps(points[mask].astype(np.float64), plane, BevConfig())
    # A point on the border of a cell or slice may fall on either side in float32.
    assert (np.abs(np.asarray(maps) - expected) > 1e-3).mean() < 1e-4
