"""How far it still is to the target along the shortest way, as a function that can be traced.

Distance along the way is the potential that shapes a reward without favouring what is optimal
without it: it leads round obstacles, where the straight distance leads into a cup and keeps the
robot there. A learner sees it in training only, never in its sensors.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from jaxsnn._checks import require_positive
from jaxsnn.planner import Obstacles
from jaxsnn.world import WorldParams


class WayLength(NamedTuple):
    """Length of the shortest way on the points of a grid; made by `way_length`.

    Attributes:
        lengths: from each point to the arrival circle, `[columns, rows]` [px]. A point where the
            robot cannot stand has the length of the nearest one where it can.
        origin: of the grid, `[2]` [px].
        cell: distance of neighbouring points [px].
    """

    lengths: Float[Array, "columns rows"]
    origin: Float[Array, "2"]
    cell: Float[Array, ""]


def way_length(
    map: WorldParams, *, cell: int | float = 10.0, clearance: int | float | None = None
) -> WayLength:
    """Shortest ways from the points of a grid, over its neighbours in 16 directions; on the host.

    Args:
        map: one map; moving obstacles are left out.
        cell: distance of neighbouring points [px]; at most half the thickness of walls grown by
            the clearance, so that no way and no value leads through one.
        clearance: distance to keep from obstacles [px]; the robot's radius by default.

    Returns:
        WayLength; lengths are up to 5 % longer than those of the planner.

    Raises:
        ValueError: `cell` is not positive.
    """
    require_positive("cell", cell, "give pixels; 10 suits walls of 18 pixels")
    x0, y0, x1, y1 = np.asarray(map.bounds, np.float64)
    columns, rows = (int(np.ceil((b - a) / cell)) + 1 for a, b in ((x0, x1), (y0, y1)))
    xs, ys = x0 + cell * np.arange(columns), y0 + cell * np.arange(rows)
    points = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
    radius = float(map.robot_radius) if clearance is None else float(clearance)
    free = (Obstacles.of(map).clearance(points, points) >= radius).reshape(columns, rows)
    number = np.arange(columns * rows).reshape(columns, rows)
    begin, end, length = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)):
        low, high = max(0, -dy), rows - max(0, dy)
        here = np.s_[: columns - dx, low:high]
        there = np.s_[dx:, low + dy : high + dy]
        both = free[here] & free[there]
        begin.append(number[here][both])
        end.append(number[there][both])
        length.append(np.full(int(both.sum()), cell * np.hypot(dx, dy)))
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


def remaining_way(way: WayLength, x: Float[Array, ""], y: Float[Array, ""]) -> Float[Array, ""]:
    """Length of the way from a position, bilinear between the points of the grid [px]."""
    columns, rows = way.lengths.shape
    u = jnp.clip((x - way.origin[0]) / way.cell, 0.0, columns - 1.001)
    v = jnp.clip((y - way.origin[1]) / way.cell, 0.0, rows - 1.001)
    left, bottom = jnp.floor(u), jnp.floor(v)
    i, j = left.astype(jnp.int32), bottom.astype(jnp.int32)
    a, b = u - left, v - bottom
    low = (1.0 - b) * way.lengths[i, j] + b * way.lengths[i, j + 1]
    high = (1.0 - b) * way.lengths[i + 1, j] + b * way.lengths[i + 1, j + 1]
    return (1.0 - a) * low + a * high
