"""How far it still is to the target along the shortest way, as a function that can be traced.

Distance along the way is the potential that shapes a reward without favouring what is optimal
without it: it leads round obstacles, where the straight distance leads into a cup and keeps the
robot there. A learner sees it in training only, never in its sensors.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class WayLength(NamedTuple):
    """Length of the shortest way on the points of a grid; made by `ways.way_length`.

    Attributes:
        lengths: from each point to the arrival circle, `[columns, rows]` [px]. A point where the
            robot cannot stand has the length of the nearest one where it can.
        origin: of the grid, `[2]` [px].
        cell: distance of neighbouring points [px].
    """

    lengths: Float[Array, "columns rows"]
    origin: Float[Array, "2"]
    cell: Float[Array, ""]


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


def turn_onto_way(
    way: WayLength,
    x: Float[Array, ""],
    y: Float[Array, ""],
    heading: Float[Array, ""],
    *,
    reach: float = 15.0,
) -> Float[Array, ""]:
    r"""The turn after which a robot heads along the shortest way [deg], positive to the left.

    .. math:: \beta = \operatorname{atan2}(u \times g,\, u \cdot g), \qquad g = -\nabla L(x, y)

    with L the remaining way, its gradient by central differences over `reach` [px] on either side,
    and u the unit heading; 0 where the way has no direction, as inside the arrival circle.

    Example:
        >>> grid = jnp.broadcast_to(jnp.arange(9.0)[:, None] * 10.0, (9, 9))
        >>> way = WayLength(grid, jnp.zeros(2), jnp.float32(10.0))
        >>> at = jnp.float32(40.0)
        >>> round(float(turn_onto_way(way, at, at, jnp.float32(jnp.pi / 2))))
        90
    """
    right, left = remaining_way(way, x + reach, y), remaining_way(way, x - reach, y)
    above, below = remaining_way(way, x, y + reach), remaining_way(way, x, y - reach)
    gx, gy = left - right, below - above
    c, s = jnp.cos(heading), jnp.sin(heading)
    turn = jnp.rad2deg(jnp.arctan2(c * gy - s * gx, c * gx + s * gy))
    return jnp.where(jnp.hypot(gx, gy) > 1e-3 * reach, turn, 0.0)
