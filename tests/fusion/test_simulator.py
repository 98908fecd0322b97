"""Simulated frames: ray casting by marching, labels against pixels and points, what hides."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.detection.geometry.overlaps import image_iou
from fusion.detection.geometry.planes import height_above
from fusion.detection.kitti.calibration import in_image, lidar_to_camera, project
from fusion.detection.kitti.objects import Objects
from fusion.detection.simulator.frames import SimulatedFrame, simulate_frames, split_layouts
from fusion.detection.simulator.labels import image_boxes, labels_of, visibility_of
from fusion.detection.simulator.layouts import (
    Layout,
    compose,
    generated_layout,
    keep_apart,
    read_layouts,
)
from fusion.detection.simulator.raycast import GROUND, SKY, cast
from fusion.detection.simulator.rendering import (
    SIZES,
    Readings,
    SensorConfig,
    nominal_calibration,
    rays,
    render,
)
from fusion.detection.simulator.scene import KINDS, Scene, SceneConfig, build_scene

SCENES = SceneConfig()
SENSORS = SIZES["tiny"]
CALIBRATION = nominal_calibration(SENSORS.scale)
BEAMS = rays(SENSORS, CALIBRATION)
N = 8  # frames rendered at once everywhere here, so that one program is compiled


def layout(*rows: tuple[str, float, float, float], look_alike: tuple[bool, ...] = ()) -> Layout:
    """Things of usual size given as class, x, z, rotation."""
    sizes = {"Car": (1.5, 1.6, 4.0), "Truck": (3.5, 2.6, 9.0), "Pedestrian": (1.8, 0.6, 0.8)}
    return Layout(
        np.array([r[0] for r in rows], "<U14"),
        np.array([sizes[r[0]] for r in rows]),
        np.array([r[1:3] for r in rows]),
        np.array([r[3] for r in rows]),
        np.array(look_alike or [False] * len(rows)),
    )


def scene_of(things: Layout, **changes: np.ndarray) -> Scene:
    """The scene of `things` by day, without hidden cars and without houses, with changed fields."""
    config = dataclasses.replace(SCENES, dark_paint=0.0, low_contrast=0.0, night=0.0)
    scene = build_scene(config, things, rng=np.random.default_rng(4))
    nothing = np.arange(len(scene.kind)) >= len(things)
    bare = scene._replace(
        kind=np.where(nothing, len(KINDS) - 1, scene.kind).astype(np.int32),
        parts=np.where(nothing[:, None, None], 0.0, scene.parts).astype(np.float32),
    )
    return bare._replace(**changes)


def read(*scenes: Scene) -> list[Readings]:
    """Readings of up to N scenes, all with the same key."""
    padded = [*scenes] + [scenes[-1]] * (N - len(scenes))
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *padded)
    keys = jnp.stack([jax.random.key(0)] * N)
    found = jax.device_get(render(SENSORS, stacked, BEAMS, keys=keys))
    return [Readings(*(leaf[i] for leaf in found)) for i in range(len(scenes))]


@pytest.fixture(scope="module")
def frames() -> list[SimulatedFrame]:
    """Eight frames of the fitted model."""
    return list(simulate_frames(SCENES, SENSORS, [(i, i, ()) for i in range(N)], seed=0, chunk=N))


def labels(frame: SimulatedFrame) -> Objects:
    return labels_of(frame.scene, frame.seen, CALIBRATION, SENSORS.height, SENSORS.width)


def test_ray_casting_agrees_with_marching() -> None:
    """Walk along each ray in small steps until a point lies inside a part, in plain numpy."""
    scene = scene_of(layout(("Car", -2.0, 9.0, 0.4), ("Truck", 5.0, 16.0, -1.2)))
    rng = np.random.default_rng(0)
    origin = np.array([0.1, -0.2, -0.3])
    directions = rng.normal([0.1, 0.03, 1.0], [0.35, 0.06, 0.01], (400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = jax.device_get(
        jax.jit(cast)(scene, jnp.asarray(origin, jnp.float32), jnp.asarray(directions, jnp.float32))
    )
    step = 0.01
    t = np.arange(0.0, 30.0, step)
    points = origin + t[:, None, None] * directions  # [T, R, 3]
    first = np.full(400, np.inf)
    for i in range(2):
        away = points - scene.place[i]
        c, s = scene.turn[i]
        a, c_ = away[..., 0] * c - away[..., 2] * s, away[..., 0] * s + away[..., 2] * c
        up = -away[..., 1]
        for h0, h1, x0, x1, x0t, x1t, w, wt in scene.parts[i]:
            k = (up - h0) / (h1 - h0)
            inside = (k >= 0) & (k <= 1) & (np.abs(c_) <= w + k * (wt - w))
            inside &= (a >= x0 + k * (x0t - x0)) & (a <= x1 + k * (x1t - x1))
            first = np.minimum(first, np.where(inside.any(0), t[inside.argmax(0)], np.inf))
    body = hits.body >= 0
    assert 60 < body.sum() < 350
    # A ray that only grazes an edge may be missed by the walk.
    assert (np.isfinite(first) & (hits.distance < 29.9) & ~body).sum() <= 2
    both = np.isfinite(first) & body
    assert both.sum() > 0.95 * body[hits.distance < 29.9].sum()
    late = first[both] - hits.distance[both]
    assert np.mean((late > -2e-3) & (late < 2 * step)) > 0.99
    np.testing.assert_allclose(np.linalg.norm(hits.normal, axis=1), 1.0, atol=1e-5)
    assert (np.sum(hits.normal * directions, axis=1)[body] < 1e-6).all()  # towards the sensor
    ground = hits.body == GROUND
    place = origin + hits.distance[ground, None] * directions[ground]
    np.testing.assert_allclose(height_above(scene.plane, place), 0.0, atol=2e-3)
    assert np.isinf(hits.distance[hits.body == SKY]).all()
    # A step out of the surface is outside, a step in is inside: the distance changes its sign.
    at = origin + hits.distance[both, None] * directions[both]
    assert (np.sum((at + 1e-2 * hits.normal[both] - origin) ** 2, 1) < np.sum((at - origin) ** 2, 1)
            ).all()  # fmt: skip


def test_points_of_an_object_lie_in_its_box_and_on_its_pixels(frames: list[SimulatedFrame]) -> None:
    counted = on_pixels = inside_total = 0
    for frame in frames:
        r, objects = frame.readings, labels(frame)
        rows = np.flatnonzero(frame.seen.label >= 0)
        assert len(objects) == len(rows)
        camera = lidar_to_camera(CALIBRATION, r.points[:, :3])
        pixels, depth = project(CALIBRATION, camera)
        shown = in_image(pixels, depth, SENSORS.height, SENSORS.width) & r.mask
        for i, slot in enumerate(rows):
            mine = r.mask & (r.point_owner == slot)
            assert mine.sum() == frame.seen.points[slot]
            away = camera[mine] - objects.location[i]
            h, w, length = objects.dimensions[i]
            c, s = np.cos(objects.rotation_y[i]), np.sin(objects.rotation_y[i])
            a, b = away[:, 0] * c - away[:, 2] * s, away[:, 0] * s + away[:, 2] * c
            margin = 0.1  # five times the range noise
            assert (np.abs(a) < length / 2 + margin).all() and (np.abs(b) < w / 2 + margin).all()
            assert (away[:, 1] < margin).all() and (away[:, 1] > -h - margin).all()
            inside_total += len(away)
            # Where the camera sees that far, the pixel or its neighbour shows the same object.
            for u, v in pixels[mine & shown].astype(int):
                near = r.owner[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
                counted += 1
                before = r.depth[v, u] < objects.location[i, 2] - length
                on_pixels += bool((near == slot).any()) or before
    assert inside_total > 1000 and on_pixels > 0.98 * counted > 500
    # No point belongs to an empty slot, and padding is empty.
    assert all((f.readings.points[~f.readings.mask] == 0).all() for f in frames)


def test_image_boxes_surround_the_pixels(frames: list[SimulatedFrame]) -> None:
    overlaps = []
    for frame in frames:
        objects = labels(frame)
        for i, slot in enumerate(np.flatnonzero(frame.seen.label >= 0)):
            v, u = np.nonzero(frame.readings.owner == slot)
            left, top, right, bottom = objects.bbox[i]
            assert (u + 1 >= left).all() and (u <= right).all()
            assert (v + 1 >= top).all() and (v <= bottom).all()
            whole = objects.occluded[i] == 0 and objects.truncated[i] == 0
            if whole and bottom - top > 8 and objects.type[i] == "Car":
                tight = np.array([u.min(), v.min(), u.max() + 1.0, v.max() + 1.0])
                overlaps.append(float(image_iou(tight, objects.bbox[i])))
            assert frame.seen.pixels[slot] == pytest.approx(len(u)) and len(u) > 0
            x, _, z = objects.location[i]
            turned = np.mod(objects.rotation_y[i] - objects.alpha[i], 2 * np.pi)
            assert turned == pytest.approx(np.mod(np.arctan2(x, z), 2 * np.pi), abs=1e-6)
    assert len(overlaps) > 5 and min(overlaps) > 0.6 and np.mean(overlaps) > 0.8


def test_truncation_by_hand() -> None:
    turn, size = np.tile([1.0, 0.0], (4, 1)), np.tile([1.5, 1.6, 4.0], (4, 1))
    focal, centre = CALIBRATION.p2[0, 0], CALIBRATION.p2[0, 2]
    # In the middle; half out on the right; behind the camera; through the camera.
    edge = (SENSORS.width - centre) / focal * 20.0
    place = np.array([[0.0, 1.7, 20], [edge, 1.7, 20], [0.0, 1.7, -9], [2.5, 1.7, 1.0]])
    boxes, truncated = image_boxes(CALIBRATION, place, turn, size, SENSORS.height, SENSORS.width)
    assert truncated[0] == 0.0 and truncated[2] == 1.0 and truncated[3] > 0.5
    # The box's front, 19.2 m away, is the wider face: half of 4 m more or less.
    assert truncated[1] == pytest.approx(0.5, abs=0.04)
    assert boxes[1, 2] == SENSORS.width and (boxes[2] == 0).all()
    wide = focal * 4.0 / 19.2
    assert boxes[0, 2] - boxes[0, 0] == pytest.approx(wide, rel=1e-3)


def test_occlusion_follows_visible_share() -> None:
    # Heading along z. Alone; behind a truck and a bit to the side; all behind it.
    ahead = -np.pi / 2
    truck = ("Truck", 0.0, 14.0, ahead)
    scenes = [
        scene_of(layout(("Car", 0.0, 30.0, ahead))),
        scene_of(layout(("Car", 4.1, 30.0, ahead), truck)),
        scene_of(layout(("Car", 0.0, 30.0, ahead), truck)),
    ]
    levels, shares = [], []
    for scene, readings in zip(scenes, read(*scenes), strict=True):
        seen = visibility_of(scene, readings, 2)
        found = labels_of(scene, seen, CALIBRATION, SENSORS.height, SENSORS.width)
        shares.append(seen.share[0])
        levels.append(found.occluded[found.type == "Car"].tolist())
    assert shares[0] == 1.0 and 0.05 < shares[1] < 0.95 and shares[2] == 0.0
    assert levels[0] == [0] and levels[1][0] in (1, 2) and levels[2] == []  # out of sight: no label


def test_each_sensor_sees_what_the_other_does_not() -> None:
    car = layout(("Car", 0.0, 36.0, 0.7), ("Car", 2.0, 12.0, 0.7))
    base = scene_of(car)
    n = len(base.kind)
    cars = np.arange(n) < 2

    def painted(reflectivity: float, **changes: np.ndarray) -> Scene:
        light = np.where(cars, reflectivity, 0.0).astype(np.float32)
        return base._replace(reflectivity=light, **changes)

    white = np.where(cars[:, None], [[0.9, 0.9, 0.9]], 0.0).astype(np.float32)
    bush = np.where(cars, KINDS.index("bush"), base.kind).astype(np.int32)
    green = np.where(cars[:, None], [[0.15, 0.4, 0.1]], 0.0).astype(np.float32)
    hidden = np.where(cars, 1.0, 0.0).astype(np.float32)
    empty_ = base._replace(parts=np.zeros_like(base.parts))
    scenes = [
        painted(0.5, paint=white),
        painted(0.03, paint=white),
        painted(0.5, paint=white, low_contrast=hidden),
        painted(0.5, kind=bush, paint=green),
        empty_,
    ]
    bright, dark, plain, alike, nothing = read(*scenes)
    points = [int((r.point_owner == 0).sum()) for r in (bright, dark, plain, alike)]
    # Dark paint is lost to the lidar and not to the camera.
    assert points[0] > 15 and points[1] <= 0.2 * points[0]
    np.testing.assert_allclose(bright.image, dark.image, atol=1e-6)
    # A car in the colour of the road is lost to the camera and not to the lidar (glass returns as
    # little from it, so the points are the same ones).
    at = bright.owner == 1  # the near one
    assert points[2] == points[0] and at.sum() > 100

    def stands_out(r: Readings) -> float:
        return float(np.abs(r.image - nothing.image)[at].mean())

    assert stands_out(plain) < 0.35 * stands_out(bright)
    # A bush in the shape of a car: where both return, the lidar measures the same ranges.
    both = bright.mask & alike.mask & (bright.point_owner >= 0)
    np.testing.assert_array_equal(bright.points[both], alike.points[both])
    green_excess = (alike.image[..., 1] - alike.image[..., 0])[at].mean()
    assert green_excess > 0.08 > abs((bright.image[..., 1] - bright.image[..., 0])[at].mean())
    # At night the picture says next to nothing, and the scan is the same.
    dim = np.array([base.light[0], 0.04], np.float32)
    (night,) = read(painted(0.5, paint=white, light=dim))
    assert night.image.mean() < 0.1 * bright.image.mean()
    np.testing.assert_array_equal(night.points, bright.points)


def test_a_frame_depends_on_its_seed_and_index_only(frames: list[SimulatedFrame]) -> None:
    (again,) = simulate_frames(SCENES, SENSORS, [(5, 5, ())], seed=0, chunk=N)
    for a, b in zip(again.readings, frames[5].readings, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(frames[4].readings.points, frames[5].readings.points)


def test_fitted_layouts_have_the_moments_of_the_labels() -> None:
    rng = np.random.default_rng(0)
    drawn = [generated_layout(rng) for _ in range(400)]
    vehicle = [np.isin(d.type, ("Car", "Van", "Truck")) for d in drawn]
    n = np.array([v.sum() for v in vehicle])
    assert 3.8 < n.mean() < 5.0 and 6 < n.var() < 16
    z = np.concatenate([d.ground[v, 1] for d, v in zip(drawn, vehicle, strict=True)])
    assert 25 < z.mean() < 31 and 13 < z.std() < 18
    size = np.concatenate([d.size[d.type == "Car"] for d in drawn])
    np.testing.assert_allclose(size.mean(axis=0), [1.53, 1.63, 3.88], atol=0.05)
    yaw = np.concatenate([d.rotation_y[d.type == "Car"] for d in drawn])
    along = np.abs(np.mod(yaw, np.pi) - np.pi / 2) < 0.3
    assert 0.70 < along.mean() < 0.85
    assert all(len(keep_apart(d)) == len(d) for d in drawn[:20])


def test_look_alikes_stand_where_cars_stand() -> None:
    rng = np.random.default_rng(1)
    base = layout(("Car", 3.0, 12.0, 0.2), ("Pedestrian", -4.0, 9.0, 0.0))
    other = layout(("Car", 3.5, 12.5, 0.2), ("Car", -3.0, 25.0, 1.0), ("Truck", 9.0, 40.0, 0.0))
    scenes = [compose(rng, base, other, max_objects=5, max_look_alikes=4) for _ in range(20)]
    for scene in scenes:
        # The one that would run into the base's car is left out, and trucks have no look-alikes.
        assert scene.type.tolist() == ["Pedestrian", "Car", "Car"]
        assert scene.look_alike.tolist() == [False, False, True]
    mirrored = np.array([s.ground[1, 0] < 0 for s in scenes])
    assert 3 < mirrored.sum() < 17
    straight, turned = scenes[int(mirrored.argmin())], scenes[int(mirrored.argmax())]
    assert straight.rotation_y[1] == pytest.approx(0.2)
    assert turned.rotation_y[1] == pytest.approx(np.pi - 0.2)
    none = compose(rng, base, other, max_objects=1, max_look_alikes=0)
    assert none.type.tolist() == ["Pedestrian"]  # the nearest


def test_lists_do_not_share_layouts() -> None:
    pool = [layout(("Car", 0.0, 10.0 + i, 0.0)) for i in range(11)]
    parts = split_layouts(pool, (8, 0, 2), seed=0)
    assert parts[1] == [] and len(parts[0]) + len(parts[2]) == 11 and len(parts[2]) >= 1
    ids = [{id(x) for x in p} for p in parts]
    assert ids[0].isdisjoint(ids[2])
    with pytest.raises(ValueError, match="1 layouts, expected at least 2"):
        split_layouts(pool[:1], (8, 0, 2), seed=0)
    with pytest.raises(ValueError, match="100 frames of one list would share 1, expected at most"):
        split_layouts(pool[:2], (8, 100, 0), seed=0)


def test_bad_input_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"night is 1\.2, expected a share"):
        SceneConfig(night=1.2)
    with pytest.raises(ValueError, match="width is 0, expected at least 1"):
        SensorConfig(width=0)
    with pytest.raises(ValueError, match="scale is 0"):
        nominal_calibration(0.0)
    with pytest.raises(ValueError, match="2 things in the layout, expected at most 1"):
        build_scene(
            SceneConfig(max_objects=1, max_look_alikes=0),
            layout(("Car", 0.0, 9.0, 0.0), ("Car", 0.0, 19.0, 0.0)),
            rng=np.random.default_rng(0),
        )
    with pytest.raises(FileNotFoundError, match="expected a folder"):
        read_layouts(tmp_path / "none")
    with pytest.raises(ValueError, match="no object with a 3D box"):
        read_layouts(tmp_path)


@pytest.mark.data
def test_layouts_of_real_labels_make_scenes(data_dir: Path) -> None:
    layouts = read_layouts(data_dir / "kitti" / "training" / "label_2")
    assert len(layouts) >= 20
    rng = np.random.default_rng(0)
    for i in range(len(layouts)):
        room = {"max_objects": SCENES.max_objects, "max_look_alikes": SCENES.max_look_alikes}
        things = compose(rng, layouts[i], layouts[i - 1], **room)
        scene = build_scene(SCENES, things, rng=rng)
        n = len(things)
        np.testing.assert_allclose(height_above(scene.plane, scene.place[:n]), 0.0, atol=1e-4)
        assert np.isfinite(np.concatenate([leaf.ravel() for leaf in scene])).all()
