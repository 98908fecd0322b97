"""Shortest ways over a whole map, on the host, and maps that carry theirs for a reward."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from jaxsnn._checks import require, require_positive
from jaxsnn.config import NetworkConfig
from jaxsnn.planner import Obstacles, path_field
from jaxsnn.way import WayLength
from jaxsnn.world import WorldParams


def way_length(
    map: WorldParams,
    *,
    cell: int | float = 10.0,
    clearance: int | float | None = None,
    margin: int | float = 1.0,
    price: int | float = 0.0,
) -> WayLength:
    """Shortest ways from the points of a grid, over its neighbours in 16 directions; on the host.

    Args:
        map: one map; moving obstacles are left out.
        cell: distance of neighbouring points [px]; at most half the thickness of walls grown by
            the clearance, so that no way and no value leads through one.
        clearance: distance to keep from obstacles [px]; the robot's radius by default.
        margin: width of the strip along obstacles in which a way is dearer [px].
        price: how much dearer it is at the obstacle; falls to nothing at the strip's end. With 0
            ways are shortest, else lengths are costs, and ways keep to the middle of gaps.

    Returns:
        WayLength; lengths are up to 5 % longer than those of the planner.

    Raises:
        ValueError: `cell` or `margin` is not positive, or `price` is negative.
    """
    require_positive("cell", cell, "give pixels; 10 suits walls of 18 pixels")
    require_positive("margin", margin, "give pixels")
    require_positive("price", price, "0 leaves it out", zero=True)
    x0, y0, x1, y1 = np.asarray(map.bounds, np.float64)
    columns, rows = (int(np.ceil((b - a) / cell)) + 1 for a, b in ((x0, x1), (y0, y1)))
    xs, ys = x0 + cell * np.arange(columns), y0 + cell * np.arange(rows)
    points = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
    radius = float(map.robot_radius) if clearance is None else float(clearance)
    gaps = Obstacles.of(map).clearance(points, points).reshape(columns, rows)
    free = gaps >= radius
    dearer = 1.0 + price * np.clip(1.0 - (gaps - radius) / margin, 0.0, 1.0)
    number = np.arange(columns * rows).reshape(columns, rows)
    begin, end, length = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)):
        low, high = max(0, -dy), rows - max(0, dy)
        here = np.s_[: columns - dx, low:high]
        there = np.s_[dx:, low + dy : high + dy]
        both = free[here] & free[there]
        begin.append(number[here][both])
        end.append(number[there][both])
        mean = 0.5 * (dearer[here][both] + dearer[there][both])
        length.append(cell * np.hypot(dx, dy) * mean)
    size = columns * rows
    edges = (np.concatenate(length), (np.concatenate(begin), np.concatenate(end)))
    gap = np.hypot(*(points - np.asarray(map.target, np.float64)).T)
    arrived = np.flatnonzero((gap <= float(map.arrival_radius)) & free.reshape(-1))
    if not len(arrived):  # the circle lies between the points
        arrived = np.flatnonzero(gap == gap[free.reshape(-1)].min())
    ways = csgraph.dijkstra(
        sparse.csr_matrix(edges, shape=(size, size)), directed=False, indices=arrived, min_only=True
    )
    grid = ways.reshape(columns, rows)
    nearest = ndimage.distance_transform_edt(
        ~np.isfinite(grid), return_distances=False, return_indices=True
    )
    return WayLength(
        lengths=jnp.asarray(grid[tuple(nearest)], jnp.float32),
        origin=jnp.asarray([x0, y0], jnp.float32),
        cell=jnp.float32(cell),
    )


def training_map(config: NetworkConfig, map: WorldParams) -> WorldParams:
    """The map as a network learns on it: with what its config asks for, else as it is.

    Its ways for `guidance="way"` and `shaping="way"`, starts all over it for `starts="anywhere"`.
    Test on the map itself.

    Returns:
        WorldParams.
    """
    if "way" in (config.guidance, config.shaping) and map.way is None:
        map = with_way(map)
    return with_starts_anywhere(map) if config.starts == "anywhere" else map


def with_starts_anywhere(map: WorldParams, *, spacing: int | float = 40.0) -> WorldParams:
    """The map with start circles all over it, so that a few trials meet many situations.

    Args:
        map: one map; moving obstacles are left out.
        spacing: distance of the centres, which fill a grid; circles have half of it as radius
            [px]. One that does not leave the robot's radius free or touches the arrival circle is
            not among them.

    Returns:
        WorldParams; headings are towards the target, plus or minus any angle.

    Raises:
        ValueError: no circle is free.

    Source: exploring starts, Sutton and Barto (2018), section 5.3.
    """
    require_positive("spacing", spacing, "give pixels")
    x0, y0, x1, y1 = np.asarray(map.bounds, np.float64)
    radius = 0.5 * spacing
    lines = np.arange(x0 + radius, x1, spacing), np.arange(y0 + radius, y1, spacing)
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 2)
    room = Obstacles.of(map).clearance(points, points)
    gap = np.hypot(*(points - np.asarray(map.target, np.float64)).T)
    apart = gap - radius > float(map.arrival_radius)
    free = (room >= radius + float(map.robot_radius)) & apart
    free &= np.isfinite(path_field(map).lengths(points))
    require(
        bool(free.any()),
        f"spacing={spacing}: expected a free circle of half that radius; lower it",
    )
    starts = np.column_stack([points[free], np.full(free.sum(), radius)])
    return map._replace(
        starts=jnp.asarray(starts, jnp.float32),
        start_probs=jnp.full(len(starts), 1.0 / len(starts), jnp.float32),
        heading_spread=jnp.float32(180.0),
    )


def with_way(
    map: WorldParams, *, margin: int | float = 60.0, price: int | float = 3.0
) -> WorldParams:
    """The map with its shortest ways, for rewards that tell the turn onto them.

    Args:
        map: one map; moving obstacles are left out of the ways.
        margin, price: how far ways keep from obstacles, see `way_length`.

    Returns:
        WorldParams whose readings carry `way_turn`.

    Raises:
        ValueError: as `way_length`.
    """
    return map._replace(way=way_length(map, margin=margin, price=price))
