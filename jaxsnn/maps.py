"""Make maps on the host: obstacles that are checked before anything is compiled.

`make_map` turns polygons and circles into `jaxsnn.world.WorldParams` and refuses a map that
no robot could run on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxsnn import geometry
from jaxsnn.planner import Obstacles, path_field
from jaxsnn.world import WorldParams

Number = int | float
Point = Sequence[Number]
Polygon = Sequence[Point] | np.ndarray


def _positive(name: str, value: Number, *, zero: bool = False) -> float:
    if not math.isfinite(value) or value < 0 or (value == 0 and not zero):
        kind = "a finite number >= 0" if zero else "a finite number > 0"
        raise ValueError(f"{name}={value}: expected {kind}; check its unit")
    return float(value)


def _rows(name: str, values: Any, width: int) -> np.ndarray:
    """Values as float64 `[n, width]`, n = 0 allowed."""
    try:
        rows = np.asarray(values, np.float64) if len(values) else np.zeros((0, width))
        rows = rows.reshape(1, -1) if rows.ndim == 1 else rows
    except ValueError:
        rows = np.zeros((0, 0))
    if rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"{name}={values}: expected {width} numbers in each row; check them")
    if not np.isfinite(rows).all():
        raise ValueError(f"{name}={rows.tolist()}: expected finite numbers; one is not finite")
    return rows


def _pad(name: str, rows: np.ndarray, size: int, fill: float = 0.0) -> np.ndarray:
    if len(rows) > size:
        raise ValueError(f"{name}=<{len(rows)}>: expected at most max_{name} = {size}; raise it")
    padding = np.full((size - len(rows), *rows.shape[1:]), fill)
    return np.concatenate([rows, padding])


def make_map(
    polygons: Sequence[Polygon] = (),
    circles: Sequence[Point] = (),
    *,
    bounds: Point = (0.0, 0.0, 800.0, 600.0),
    target: Point,
    starts: Sequence[Point],
    start_probs: Point | None = None,
    arrival_radius: Number = 35.0,
    heading_spread: Number = 45.0,
    speed: Number = 15.0,
    robot_radius: Number = 6.0,
    sonar_angles: Point = (60.0, 30.0, 0.0, -30.0, -60.0),
    sonar_range: Number = 300.0,
    distance_range: Number = 800.0,
    polygon_velocity: Sequence[Point] | None = None,
    circle_velocity: Sequence[Point] | None = None,
    patrol_steps: int = 1,
    sonar_noise: Number = 0.0,
    distance_noise: Number = 0.0,
    angle_noise: Number = 0.0,
    sonar_stuck: dict[int, Number] | None = None,
    max_segments: int = 40,
    max_circles: int = 8,
    max_starts: int = 2,
) -> WorldParams:
    """A checked map, padded so that maps of different obstacles share one compiled program.

    Args:
        polygons: obstacles as corners (x, y) in order around them [px]; they may be concave.
        circles: round obstacles (x, y, radius) [px].
        bounds: walls (x0, y0, x1, y1) [px].
        target: (x, y) [px].
        starts: start circles (x, y, radius) [px].
        start_probs: how often each start circle is drawn; equal shares by default.
        arrival_radius: the robot's centre within this of the target has arrived [px].
        heading_spread: start headings are towards the target plus or minus this [deg].
        speed: path per control step [px].
        robot_radius: radius of the disc robot [px].
        sonar_angles: directions of the sonars from the heading, leftmost first, an odd number
            of them [deg]; networks take it as `NetworkConfig.n_sonars`.
        sonar_range: range of the sonars [px].
        distance_range: range of the distance sensor [px].
        polygon_velocity: motion of each polygon [px per step]; all stand still by default.
        circle_velocity: motion of each circle [px per step].
        patrol_steps: whole steps after which moving obstacles turn back.
        sonar_noise: standard deviation of each sonar [px].
        distance_noise: standard deviation of the distance sensor [px].
        angle_noise: standard deviation of the angle sensor [deg].
        sonar_stuck: failed sonars, `{index: what it reports [px]}`.
        max_segments: room for sides of polygons.
        max_circles: room for circles.
        max_starts: room for start circles.

    Returns:
        WorldParams, float32.

    Raises:
        ValueError: a degenerate polygon, an obstacle outside the walls, a start circle in which the
            robot would touch an obstacle or already stand at the target, a target that cannot be
            reached, or a constant out of range. The message names the value and the fix.
    """
    walls = _rows("bounds", bounds, 4)
    if len(walls) != 1 or walls[0, 0] >= walls[0, 2] or walls[0, 1] >= walls[0, 3]:
        raise ValueError(
            f"bounds={list(bounds)}: expected (x0, y0, x1, y1) with x0 < x1, y0 < y1; reorder"
        )
    x0, y0, x1, y1 = walls[0]
    shapes = [geometry.check_polygon(p, f"polygon {i}") for i, p in enumerate(polygons)]
    rounds = _rows("circles", circles, 3)
    for i, shape in enumerate(shapes):
        if (shape < [x0, y0]).any() or (shape > [x1, y1]).any():
            raise ValueError(
                f"polygon {i}={shape.tolist()}: expected inside {walls[0].tolist()}; clip it"
            )
    for i, (cx, cy, r) in enumerate(rounds):
        _positive(f"radius of circle {i}", r)
        if not (x0 <= cx <= x1 and y0 <= cy <= y1):
            raise ValueError(
                f"circle {i}=({cx:g}, {cy:g}, {r:g}): expected its centre inside the walls; move it"
            )
    for name, value in (
        ("arrival_radius", arrival_radius),
        ("speed", speed),
        ("robot_radius", robot_radius),
        ("sonar_range", sonar_range),
        ("distance_range", distance_range),
    ):
        _positive(name, value)
    for name, value in (
        ("heading_spread", heading_spread),
        ("sonar_noise", sonar_noise),
        ("distance_noise", distance_noise),
        ("angle_noise", angle_noise),
    ):
        _positive(name, value, zero=True)
    if patrol_steps != int(patrol_steps) or patrol_steps < 1:
        raise ValueError(
            f"patrol_steps={patrol_steps}: expected a whole number of steps >= 1; round it"
        )
    n_sonars = len(sonar_angles)
    if n_sonars < 3 or n_sonars % 2 == 0 or not np.isfinite(sonar_angles).all():
        raise ValueError(
            f"sonar_angles={list(sonar_angles)}: expected an odd number of finite angles, 3 or "
            "more; one per sonar, the middle one ahead"
        )
    goal = _rows("target", target, 2)
    begin = _rows("starts", starts, 3)
    if not len(begin) or (begin[:, 2] < 0).any():
        raise ValueError(
            f"starts={begin.tolist()}: expected at least one (x, y, radius >= 0); add one"
        )
    probs = np.full(len(begin), 1.0) if start_probs is None else np.asarray(start_probs, np.float64)
    if probs.shape != (len(begin),) or not (probs >= 0).all() or not probs.sum() > 0:
        raise ValueError(
            f"start_probs={probs.tolist()}: expected one number >= 0 for each of the {len(begin)} "
            "start circles, not all zero; leave them out for equal shares"
        )
    failed, stuck = np.zeros(n_sonars, bool), np.zeros(n_sonars)
    for index, value in (sonar_stuck or {}).items():
        if not 0 <= index < n_sonars or not 0.0 <= value <= sonar_range:
            raise ValueError(
                f"sonar_stuck={{{index}: {value}}}: expected a sonar 0..{n_sonars - 1} and a value "
                f"in [0, {sonar_range:g}]; change it"
            )
        failed[index], stuck[index] = True, value

    def velocities(name: str, given: Sequence[Point] | None, n: int) -> np.ndarray:
        rows = np.zeros((n, 2)) if given is None else _rows(name, given, 2)
        if len(rows) != n:
            raise ValueError(f"{name}=<{len(rows)} rows>: expected {n}; give one for each obstacle")
        return rows

    drift = velocities("polygon_velocity", polygon_velocity, len(shapes))
    roll = velocities("circle_velocity", circle_velocity, len(rounds))
    sides = [geometry.polygon_segments(shape) for shape in shapes]
    segments = np.concatenate(sides) if sides else np.zeros((0, 4))
    repeats = [len(side) for side in sides]
    side_drift = np.repeat(drift, repeats, axis=0) if sides else np.zeros((0, 2))

    def floats(values: Any) -> Array:
        return jnp.asarray(np.asarray(values), jnp.float32)

    params = WorldParams(
        segments=floats(_pad("segments", segments, max_segments)),
        segment_mask=jnp.arange(max_segments) < len(segments),
        circles=floats(_pad("circles", rounds, max_circles)),
        circle_mask=jnp.arange(max_circles) < len(rounds),
        bounds=floats(walls[0]),
        target=floats(goal[0]),
        arrival_radius=floats(arrival_radius),
        starts=floats(_pad("starts", begin, max_starts)),
        start_probs=floats(_pad("starts", probs / probs.sum(), max_starts)),
        heading_spread=floats(heading_spread),
        speed=floats(speed),
        robot_radius=floats(robot_radius),
        sonar_angles=floats(sonar_angles),
        sonar_range=floats(sonar_range),
        distance_range=floats(distance_range),
        segment_velocity=floats(_pad("segments", side_drift, max_segments)),
        circle_velocity=floats(_pad("circles", roll, max_circles)),
        patrol_steps=floats(patrol_steps),
        sonar_noise=floats(sonar_noise),
        distance_noise=floats(distance_noise),
        angle_noise=floats(angle_noise),
        sonar_failed=jnp.asarray(failed),
        sonar_stuck=floats(stuck),
    )
    _check_starts(params, segments, rounds, begin, goal[0], probs)
    return params


def _check_starts(
    params: WorldParams,
    segments: np.ndarray,
    circles: np.ndarray,
    starts: np.ndarray,
    target: np.ndarray,
    probs: np.ndarray,
) -> None:
    """Every start is free and leads to the target; moving obstacles count where they begin."""
    everything = Obstacles(segments, circles, np.asarray(params.bounds, np.float64))
    radius = float(params.robot_radius)
    room = float(everything.clearance(target[None], target[None])[0])
    if room <= 0:
        raise ValueError(
            f"target={target.tolist()}: expected outside of obstacles, it is unreachable; move it"
        )
    field = path_field(params)
    for i, ((x, y, r), p) in enumerate(zip(starts, probs, strict=True)):
        centre = np.array([[x, y]])
        room = float(everything.clearance(centre, centre)[0])
        if room < r + radius:
            raise ValueError(
                f"start circle {i}=({x:g}, {y:g}, {r:g}): expected {r + radius:g} px free around "
                f"its centre for a robot of radius {radius:g}, {room:.1f} px are; move or shrink it"
            )
        gap = float(np.hypot(*(centre[0] - target)))
        if gap - r <= float(params.arrival_radius):
            raise ValueError(
                f"start circle {i}=({x:g}, {y:g}, {r:g}): expected outside the target's arrival "
                "circle; move one of them or make arrival_radius smaller"
            )
        if p > 0 and not math.isfinite(field.lengths(centre)[0]):
            raise ValueError(
                f"target={target.tolist()}: expected a way to it, it is unreachable from start "
                f"circle {i} at ({x:g}, {y:g}) for a robot of radius {radius:g}; open a gap"
            )


def stack_maps(maps: Sequence[WorldParams]) -> WorldParams:
    """Maps of equal padding as one WorldParams with a leading axis, ready for `jax.vmap`."""
    if not maps:
        raise ValueError("maps=[]: expected at least one map; give one")
    # On the host: stacking on the device would compile once for each shape.
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *maps)
