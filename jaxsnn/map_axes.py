"""What makes a map harder without a change of its walls: robots, moving obstacles, bad sensors.

`families.family_map` draws and admits a map first and adds these after that, so the geometry of a
map and its number belong together whatever else is switched on.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsnn import geometry
from jaxsnn._checks import require, require_whole
from jaxsnn.maps import make_map
from jaxsnn.planner import Obstacles, path_field
from jaxsnn.world import WorldParams

MOST = 8
"""Moving obstacles, or robots, of one map: the padding of circles that all maps share."""
PATROL_STEPS = 20
ATTEMPTS = 500
_GRID = 20.0  # of places where another robot may start [px]
_SHARE = 0.75  # of the first robot's way that another one has to go at least


def hardened(
    arguments: dict[str, Any],
    map: WorldParams,
    rng: np.random.Generator,
    *,
    robots: int = 1,
    moving: int = 0,
    **sensors: Any,
) -> WorldParams:
    """A map again, with more in it.

    Args:
        arguments: of `make_map`, from which `map` was made; without circles.
        map: the map.
        rng: draws the moving obstacles.
        robots: start circles, one for each robot (`world.reset(circle=i)`).
        moving: circles that go to and fro.
        sensors: `sonar_stuck`, `sonar_noise`, `distance_noise`, `angle_noise` of `make_map`.

    Raises:
        ValueError: a number is out of range, the map has no room for so many, or `make_map`
            refuses an option.
    """
    require_whole("robots", robots, 1, "start at least one")
    require_whole("moving", moving, 0, "count obstacles from 0")
    for name, given in (("robots", robots), ("moving", moving)):
        require(given <= MOST, f"{name}={given}: expected at most {MOST}; lower it")
    stuck = sensors.get("sonar_stuck")
    require(
        stuck is None or isinstance(stuck, dict),
        f"sonar_stuck={stuck!r}: expected {{index: what it reports [px]}}; write a dict",
    )
    starts = start_circles(map, robots)
    circles, velocities = patrols(map, starts, moving, rng)
    return make_map(
        **arguments
        | sensors
        | {
            "starts": starts,
            "max_starts": max(robots, len(map.starts)),
            "circles": circles,
            "circle_velocity": velocities,
            "patrol_steps": PATROL_STEPS if moving else 1,
        }
    )


def start_circles(map: WorldParams, robots: int) -> list[tuple[float, float, float]]:
    """The map's first start circle and the nearest free places to it, none of which overlap.

    From each of them a robot has to go three quarters of the first one's way or more.

    Raises:
        ValueError: the map has no room for so many.
    """
    first = np.asarray(map.starts, np.float64)[0]
    radius, body = float(first[2]), float(map.robot_radius)
    x0, y0, x1, y1 = np.asarray(map.bounds, np.float64)
    ticks = np.meshgrid(np.arange(x0, x1, _GRID), np.arange(y0, y1, _GRID))
    points = np.stack(ticks, axis=-1).reshape(-1, 2)
    field = path_field(map)
    free = field.obstacles.clearance(points, points) >= radius + body
    clear = np.hypot(*(points - field.target).T) > radius + field.arrival_radius
    points = points[free & clear]
    found, least = [first[:2]], _SHARE * float(field.lengths(first[None, :2])[0])
    for point in points[np.argsort(np.hypot(*(points - first[:2]).T), kind="stable")]:
        if len(found) == robots:
            break
        apart = min(float(np.hypot(*(point - other))) for other in found)
        if apart > 2.0 * (radius + body) and least <= field.lengths(point[None])[0] < np.inf:
            found.append(point)
    require(
        len(found) == robots,
        f"robots={robots}: expected at most {len(found)} on this map; lower it",
    )
    return [(float(x), float(y), radius) for x, y in found]


def patrols(
    map: WorldParams,
    starts: list[tuple[float, float, float]],
    moving: int,
    rng: np.random.Generator,
) -> tuple[list[tuple[float, float, float]], list[tuple[float, float]]]:
    """Circles and velocities of obstacles that pass by all that stands still, starts and target.

    Raises:
        ValueError: no room was found for so many.
    """
    still, body = Obstacles.of(map), float(map.robot_radius)
    target = (*np.asarray(map.target, np.float64), float(map.arrival_radius))
    kept = np.array([*starts, target])
    points = np.concatenate([kept[:, :2], kept[:, :2]], axis=1)
    circles: list[tuple[float, float, float]] = []
    velocities: list[tuple[float, float]] = []
    for _ in range(ATTEMPTS * moving):
        if len(circles) == moving:
            break
        radius, speed, way = rng.uniform([12.0, 2.0, -np.pi], [24.0, 6.0, np.pi]).round(1)
        begin = rng.uniform(still.bounds[:2], still.bounds[2:]).round()
        velocity = (speed * np.array([np.cos(way), np.sin(way)])).round(2)
        ends = begin[None], (begin + PATROL_STEPS * velocity)[None]
        gap = geometry.segment_distance(*ends, points)[0] - kept[:, 2]
        if still.clearance(*ends)[0] > radius and (gap > radius + 2.0 * body).all():
            circles.append((float(begin[0]), float(begin[1]), float(radius)))
            velocities.append((float(velocity[0]), float(velocity[1])))
    require(
        len(circles) == moving,
        f"moving={moving}: expected at most {len(circles)} on this map; lower it",
    )
    return circles, velocities
