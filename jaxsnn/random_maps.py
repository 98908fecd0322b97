"""Random maps: drawn until the planner can solve one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from jaxsnn._checks import require_key
from jaxsnn.maps import Number, Polygon, make_map
from jaxsnn.planner import path_field
from jaxsnn.world import WorldParams


def random_map(
    *,
    key: Key[Array, ""],
    n_obstacles: tuple[int, int] = (4, 8),
    obstacle_radius: tuple[Number, Number] = (25.0, 55.0),
    size: tuple[Number, Number] = (800.0, 600.0),
    min_distance: Number = 250.0,
    start_radius: Number = 30.0,
    clearance: Number = 20.0,
    attempts: int = 1000,
    **constants: Any,
) -> WorldParams:
    """A random map that a robot can solve: triangles to hexagons and circles, one start, one
    target.

    Args:
        key: typed PRNG key; the same key gives the same map.
        n_obstacles: fewest and most obstacles.
        obstacle_radius: smallest and largest radius of the circle around an obstacle [px].
        size: width and height of the walled plane [px].
        min_distance: least distance between the start circle's centre and the target [px].
        start_radius: radius of the start circle [px].
        clearance: a path that keeps this distance from everything must exist [px].
        attempts: draws before giving up.
        **constants: passed on to `make_map`.

    Returns:
        WorldParams with the padding of `make_map`.

    Raises:
        ValueError: no solvable map within `attempts`, or the ranges are impossible.

    Example:
        >>> import jax
        >>> map = random_map(key=jax.random.key(0))
        >>> map.target.shape, bool(map.circle_mask.any() | map.segment_mask.any())
        ((2,), True)
    """
    require_key(key)
    if not 0 <= n_obstacles[0] <= n_obstacles[1]:
        raise ValueError(
            f"n_obstacles={n_obstacles}: expected (fewest, most) with 0 <= fewest <= most; reorder"
        )
    if not 0 < obstacle_radius[0] <= obstacle_radius[1]:
        raise ValueError(
            f"obstacle_radius={obstacle_radius}: expected (smallest, largest), > 0; reorder them"
        )
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel().tolist())
    arrival = float(constants.get("arrival_radius", 35.0))
    margin = 2.0 * clearance + start_radius
    if min(size) <= 2.0 * margin:
        raise ValueError(
            f"size={size}: expected room for a start circle {margin:g} px from the walls; raise it"
        )
    low, high = np.full(2, margin), np.asarray(size) - margin
    for _ in range(attempts):
        target = rng.uniform(low, high)
        start = rng.uniform(low, high)
        if np.hypot(*(target - start)) < min_distance:
            continue
        polygons: list[Polygon] = []
        circles: list[Sequence[float]] = []
        taken = [(*start, start_radius + clearance), (*target, arrival + clearance)]
        for _ in range(int(rng.integers(n_obstacles[0], n_obstacles[1] + 1))):
            radius = float(rng.uniform(*obstacle_radius))
            centre = rng.uniform(np.full(2, radius), np.asarray(size) - radius)
            if any(math.hypot(centre[0] - x, centre[1] - y) < radius + r for x, y, r in taken):
                continue
            corners = int(rng.integers(2, 7))
            if corners == 2:
                circles.append((*centre, radius))
            else:
                phase = rng.uniform(0, 2 * np.pi)
                steps = (np.arange(corners) + rng.uniform(-0.25, 0.25, corners)) / corners
                angles = phase + 2 * np.pi * steps
                ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
                polygons.append((centre + radius * ring).tolist())
            # Obstacles may touch: only start and target must stay clear, the planner judges the
            # rest.
        if len(polygons) + len(circles) < n_obstacles[0]:
            continue
        try:
            params = make_map(
                polygons,
                circles,
                bounds=(0.0, 0.0, *size),
                target=target.tolist(),
                starts=[(*start, start_radius)],
                **constants,
            )
        except ValueError as error:
            if "unreachable" not in str(error):
                raise
            continue
        if math.isfinite(path_field(params, clearance=clearance).lengths(start[None])[0]):
            return params
    raise ValueError(
        f"attempts={attempts}: expected a solvable map among them with {n_obstacles=}, "
        f"min_distance = {min_distance}; ask for fewer or smaller obstacles"
    )
