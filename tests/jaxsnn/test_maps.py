"""Maps that are refused, maps that are drawn, and shortest paths with known lengths."""

from __future__ import annotations

import math
from typing import Any

import jax
import numpy as np
import pytest
import shapely

from jaxsnn import maps, planner, random_maps, world

BOX = [(350.0, 200.0), (450.0, 200.0), (450.0, 400.0), (350.0, 400.0)]
FREE: dict[str, Any] = {"target": (700, 300), "starts": [(100, 300, 20)]}


def test_padding_and_defaults_of_the_source() -> None:
    params = maps.make_map([BOX], [(600, 100, 30)], **FREE)
    assert params.segment_mask.sum() == 4
    assert params.circle_mask.sum() == 1
    assert params.segments.shape == (40, 4)
    assert float(params.speed) == 15.0
    assert float(params.sonar_range) == 300.0
    assert float(params.distance_range) == 800.0
    np.testing.assert_allclose(params.start_probs, [1.0, 0.0])


CLOSED_RING = [
    [(600.0, 200.0), (800.0, 200.0), (800.0, 220.0), (600.0, 220.0)],
    [(600.0, 380.0), (800.0, 380.0), (800.0, 400.0), (600.0, 400.0)],
    [(600.0, 220.0), (610.0, 220.0), (610.0, 380.0), (600.0, 380.0)],
]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"starts": [(400, 300, 20)]}, "start circle 0=.* -1.0 px are; move or shrink it"),
        ({"starts": [(320, 300, 30)]}, "expected 36 px free around its centre .* 30.0 px are"),
        ({"starts": [(20, 300, 20)]}, "start circle 0=.* expected 26 px free"),
        ({"starts": [(660, 300, 20)]}, "outside the target's arrival circle"),
        ({"starts": []}, "at least one"),
        ({"target": (400, 300)}, r"target=\[400.0, 300.0\]: expected outside of obstacles"),
        ({"polygons": CLOSED_RING}, "unreachable from start circle 0"),
        ({"polygons": [[(0, 0), (10, 10), (20, 20)]]}, "polygon 0=.* it has area 0"),
        ({"polygons": [[(700, 500), (900, 500), (700, 550)]]}, "polygon 0=.* expected inside"),
        ({"circles": [(500, 500, 0)]}, "radius of circle 0=0"),
        ({"circles": [(500, 500, -3)]}, "radius of circle 0=-3"),
        (
            {"circles": [(500, 500, 20)] * 9},
            "circles=<9>: expected at most max_circles = 8; raise it",
        ),
        ({"circles": [(float("nan"), 500, 20)]}, "not finite"),
        ({"bounds": (0, 0, -800, 600)}, "x0 < x1"),
        ({"speed": 0.0}, "speed=0.0: expected a finite number > 0"),
        ({"robot_radius": float("nan")}, "robot_radius=nan"),
        ({"sonar_noise": -1.0}, "sonar_noise=-1.0: expected a finite number >= 0"),
        ({"patrol_steps": 0}, "patrol_steps=0: expected a whole number"),
        ({"sonar_angles": (0.0, 1.0)}, "expected an odd number of finite angles"),
        ({"sonar_stuck": {5: 100.0}}, "expected a sonar 0..4"),
        ({"sonar_stuck": {2: 400.0}}, r"value in \[0, 300\]"),
        ({"start_probs": (0.0,)}, "not all zero"),
        ({"polygon_velocity": [(1, 0), (2, 0)]}, "<2 rows>: expected 1"),
    ],
)
def test_bad_maps_are_refused_with_the_fix(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"polygons": [BOX], **FREE, **change}
    with pytest.raises(ValueError, match=message):
        maps.make_map(**arguments)


def test_a_gap_as_wide_as_the_robot_decides_whether_the_target_can_be_reached() -> None:
    def ring(gap: float) -> list[Any]:
        return [*CLOSED_RING[:2], [(600, 220), (610, 220), (610, 380 - gap), (600, 380 - gap)]]

    maps.make_map(ring(12.1), **FREE)
    with pytest.raises(ValueError, match="unreachable"):
        maps.make_map(ring(11.9), **FREE)


def test_poses_are_checked() -> None:
    params = maps.make_map([BOX], **FREE)
    planner.check_pose(params, (340.0, 300.0))
    for position, message in (
        ((345.0, 300.0), "5.0 px from the nearest"),
        ((400.0, 300.0), "inside an obstacle"),
        ((-5.0, 300.0), "inside an obstacle or wall"),
        ((float("nan"), 0.0), "two finite numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            planner.check_pose(params, position)


def test_shortest_path_without_obstacles_is_straight() -> None:
    params = maps.make_map(target=(700, 300), starts=[(100, 300, 0)])
    length, points = planner.shortest_path(params, (100.0, 300.0))
    assert length == pytest.approx(600.0 - 35.0)
    np.testing.assert_allclose(points, [[100, 300], [700, 300]])


def test_shortest_path_around_a_box_and_a_circle() -> None:
    """Closed forms for a disc of radius 6: straight, an arc around what is in the way, straight."""
    params = maps.make_map(circles=[(400, 300, 94)], target=(700, 300), starts=[(100, 300, 0)])
    length, _ = planner.shortest_path(params, (100.0, 300.0))
    tangent = math.sqrt(300.0**2 - 100.0**2)
    exact = 2 * tangent + 100.0 * (math.pi - 2 * math.acos(100.0 / 300.0)) - 35.0
    assert exact <= length <= exact + 1.0

    params = maps.make_map([BOX], target=(700, 300), starts=[(100, 300, 0)])
    length, _ = planner.shortest_path(params, (100.0, 300.0))
    far = math.hypot(250.0, 100.0)  # from the start to the corner (350, 200)
    tangent = math.sqrt(far**2 - 6.0**2)
    turn = math.atan2(100.0, 250.0) + math.asin(6.0 / far)
    exact = 2 * (tangent + 6.0 * turn) + 100.0 - 35.0
    assert exact <= length <= exact + 1.0


@pytest.mark.parametrize("seed", range(3))
def test_random_maps_are_solvable_and_their_paths_are_free(seed: int) -> None:
    params = random_maps.random_map(key=jax.random.key(seed))
    still = planner.Obstacles.of(params)
    shapes = [shapely.Polygon(loop) for loop in still.loops()]
    assert 4 <= len(shapes) + len(still.circles) <= 8
    start = np.asarray(params.starts)[0, :2].astype(float)
    length, points = planner.shortest_path(params, start.tolist(), clearance=20.0)
    line = shapely.LineString(points)
    assert length == pytest.approx(line.length - 35.0, rel=1e-9)
    assert shapely.distance(line, shapely.box(0, 0, 800, 600).exterior) >= 20.0 - 1e-6
    for shape in shapes:
        assert line.distance(shape) >= 20.0 - 1e-6
    for x, y, r in still.circles:
        assert line.distance(shapely.Point(x, y)) - r >= 20.0 - 1e-6
    straight = float(np.hypot(*(start - np.asarray(params.target)))) - 35.0
    assert length >= straight - 1e-6
    # More room can only make the way longer.
    assert planner.shortest_path(params, start.tolist())[0] <= length + 1.0


def test_random_map_is_a_function_of_its_key_and_stacks() -> None:
    one, again, other = (random_maps.random_map(key=jax.random.key(k)) for k in (3, 3, 4))
    for a, b in zip(one, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one.target, other.target)
    both = maps.stack_maps([one, other])
    assert both.segments.shape == (2, 40, 4)
    np.testing.assert_array_equal(both.target[1], other.target)


def test_random_map_says_when_it_cannot() -> None:
    with pytest.raises(ValueError, match="fewer or smaller obstacles"):
        random_maps.random_map(key=jax.random.key(0), min_distance=5000, attempts=20)
    with pytest.raises(ValueError, match="n_obstacles"):
        random_maps.random_map(key=jax.random.key(0), n_obstacles=(5, 2))
    with pytest.raises(ValueError, match="at least one map"):
        maps.stack_maps([])


def test_path_lengths_of_many_starts_shrink_towards_the_target() -> None:
    params = maps.make_map([BOX], **FREE)
    field = planner.path_field(params)
    lengths = field.lengths(np.array([[100.0, 300.0], [200.0, 300.0], [690.0, 310.0]]))
    assert lengths[0] > lengths[1] > lengths[2] == 0.0
    assert isinstance(params, world.WorldParams)
