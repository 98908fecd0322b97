"""Rays, moving discs and polygons in the plane: what the robot world needs to see and to bump.

Two halves. The first is pure JAX, written for one ray or one disc against an array of obstacles,
and meant to be vmapped: distances along a ray, and the fraction of a straight move at which a disc
first touches an obstacle. The second runs on the host with numpy, when a map is made: it says
whether a polygon is one, and whether a point lies inside it.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Polygon = Sequence[Sequence[int | float]] | np.ndarray


def _cross(a: Float[Array, "... 2"], b: Float[Array, "... 2"]) -> Float[Array, "..."]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def ray_segments(
    origin: Float[Array, "2"], direction: Float[Array, "2"], segments: Float[Array, "s 4"]
) -> Float[Array, "s"]:
    r"""Distance along a ray to each segment, infinite where the ray misses.

    .. math:: o + t\,u = a + s\,(b - a), \quad t \ge 0,\; 0 \le s \le 1

    Symbols: :math:`o` is `origin` and :math:`u` the unit vector `direction`; :math:`a, b` are
    the ends of a row `(ax, ay, bx, by)` of `segments`. All lengths share one unit.

    Returns:
        :math:`t` for each segment, `inf` for a miss. A ray along the segment's own line misses
        it: the neighbouring sides of a closed polygon report that contact.
    """
    start = segments[:, :2] - origin[None, :]
    edge = segments[:, 2:] - segments[:, :2]
    u = jnp.broadcast_to(direction[None, :], start.shape)
    slope = _cross(u, edge)
    safe = jnp.where(slope == 0, jnp.ones_like(slope), slope)
    t = _cross(start, edge) / safe
    s = _cross(start, u) / safe
    hit = (slope != 0) & (t >= 0) & (s >= 0) & (s <= 1)
    return jnp.where(hit, t, jnp.inf)


def _safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """The root of what is positive, else 0, with slope 0 there: a miss must not give NaN slopes."""
    positive = x > 0
    return jnp.where(
        positive, jnp.sqrt(jnp.where(positive, x, jnp.ones_like(x))), jnp.zeros_like(x)
    )


def ray_circles(
    origin: Float[Array, "2"], direction: Float[Array, "2"], circles: Float[Array, "c 3"]
) -> Float[Array, "c"]:
    r"""Distance along a ray to each circle, infinite where the ray misses, 0 from inside.

    .. math:: t = -b - \sqrt{b^2 - c}, \quad b = (o - m) \cdot u,\; c = |o - m|^2 - \rho^2

    Symbols: :math:`o` is `origin`, :math:`u` the unit vector `direction`, a row of `circles`
    is centre and radius :math:`(m_x, m_y, \rho)`.
    """
    offset = origin[None, :] - circles[:, :2]
    b = offset @ direction
    # The perpendicular distance keeps more digits than b^2 - c does in single precision.
    side = _cross(offset, jnp.broadcast_to(direction[None, :], offset.shape))
    gap = circles[:, 2] ** 2 - side**2
    root = _safe_sqrt(gap)
    inside = jnp.sum(offset**2, axis=1) <= circles[:, 2] ** 2
    t = jnp.where((gap >= 0) & (b < 0), -b - root, jnp.inf)
    return jnp.where(inside, jnp.zeros_like(t), t)


def ray_box(
    origin: Float[Array, "2"], direction: Float[Array, "2"], bounds: Float[Array, "4"]
) -> Float[Array, ""]:
    """Distance along a ray that starts inside the rectangle `(x0, y0, x1, y1)` to its wall."""
    wall = jnp.where(direction > 0, bounds[2:], bounds[:2])
    safe = jnp.where(direction == 0, jnp.ones_like(direction), direction)
    t = jnp.where(direction == 0, jnp.inf, (wall - origin) / safe)
    return jnp.maximum(jnp.min(t), 0.0)


def disc_circle_contact(
    centre: Float[Array, "2"],
    move: Float[Array, "c 2"],
    circles: Float[Array, "c 2"],
    reach: Float[Array, "c"],
) -> Float[Array, "c"]:
    r"""Fraction of a straight move at which a point comes within `reach` of each centre.

    .. math:: |p + t\,d - m|^2 = \rho^2, \quad 0 \le t

    Symbols: :math:`p` is `centre`, :math:`d` the row of `move` (relative to that circle, so
    obstacles may move too), :math:`m` the row of `circles`, :math:`\rho` is `reach`: the radius
    of the disc plus that of the circle.

    Returns:
        :math:`t`, `inf` if there is no contact within the move (:math:`t > 1`). A disc that
        already touches is stopped at 0 when it moves inwards, and free when it moves away.
    """
    offset = centre[None, :] - circles
    a = jnp.sum(move**2, axis=1)
    b = jnp.sum(offset * move, axis=1)
    c = jnp.sum(offset**2, axis=1) - reach**2
    discriminant = b**2 - a * c
    root = _safe_sqrt(discriminant)
    # c / (root - b) is the near root without the cancellation of (-b - root) / a.
    depth = jnp.where(b < 0, root - b, jnp.ones_like(b))
    t = jnp.maximum(c, 0.0) / depth
    hit = (b < 0) & ((discriminant >= 0) | (c <= 0)) & (t <= 1)
    return jnp.where(hit, t, jnp.inf)


def disc_segment_contact(
    centre: Float[Array, "2"],
    move: Float[Array, "s 2"],
    radius: Float[Array, ""],
    segments: Float[Array, "s 4"],
) -> Float[Array, "s"]:
    r"""Fraction of a straight move at which a disc first touches each side of closed polygons.

    .. math:: |\sigma| - t\,\nu = r \quad \text{or} \quad |p + t\,d - a| = r

    Symbols: :math:`\sigma` is the signed distance of `centre` :math:`p` from the side's line and
    :math:`\nu` the speed towards it; :math:`a` is the first end of the side; :math:`r` is
    `radius`;
    :math:`d` the row of `move`, relative to that side.

    Only the first corner of each side is tested: in a closed polygon it is the last one's second.

    Returns:
        :math:`t` in [0, 1], `inf` for no contact.
    """
    start = segments[:, :2]
    edge = segments[:, 2:] - start
    length = _safe_sqrt(jnp.sum(edge**2, axis=1))
    unit = edge / jnp.where(length > 0, length, jnp.ones_like(length))[:, None]
    offset = centre[None, :] - start
    distance = _cross(unit, offset)
    towards = _cross(unit, move) * jnp.where(distance < 0, -1.0, 1.0).astype(move.dtype)
    approaching = towards < 0
    speed = jnp.where(approaching, -towards, jnp.ones_like(towards))
    t = jnp.maximum(jnp.abs(distance) - radius, 0.0) / speed
    along = jnp.sum(offset * unit, axis=1) + t * jnp.sum(move * unit, axis=1)
    over = approaching & (t <= 1) & (along >= 0) & (along <= length)
    face = jnp.where(over, t, jnp.inf)
    corner = disc_circle_contact(centre, move, start, jnp.broadcast_to(radius, length.shape))
    return jnp.minimum(face, corner)


def disc_box_contact(
    centre: Float[Array, "2"],
    move: Float[Array, "2"],
    radius: Float[Array, ""],
    bounds: Float[Array, "4"],
) -> Float[Array, ""]:
    """Fraction of a straight move at which a disc inside a rectangle touches a wall, or `inf`."""
    room = jnp.where(move > 0, bounds[2:] - radius - centre, bounds[:2] + radius - centre)
    safe = jnp.where(move == 0, jnp.ones_like(move), move)
    t = jnp.where(move == 0, jnp.inf, jnp.maximum(room / safe, 0.0))
    first = jnp.min(t)
    return jnp.where(first <= 1, first, jnp.inf)


# --- host side: numpy, used when a map is made -------------------------------------------------


def polygon_segments(polygon: Polygon) -> np.ndarray:
    """The sides `(ax, ay, bx, by)` of a closed polygon `[k, 2]`, as `[k, 4]`."""
    points = np.asarray(polygon, dtype=np.float64)
    return np.concatenate([points, np.roll(points, -1, axis=0)], axis=1)


def inside_polygon(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """For each point `[n, 2]`: is it inside the polygon `[k, 2]` (even-odd rule)?"""
    sides = polygon_segments(polygon)
    px, py = points[:, :1], points[:, 1:]
    ax, ay, bx, by = (sides[None, :, i] for i in range(4))
    spans = (ay > py) != (by > py)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = ax + (py - ay) * (bx - ax) / (by - ay)
    return np.asarray(np.sum(spans & (px < crossing), axis=1) % 2 == 1)


def segment_distance(a: np.ndarray, b: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Distance between the segments a-b `[n, 2]` and each row of `segments`: `[n, s]`."""

    def point_to(p: np.ndarray, q0: np.ndarray, q1: np.ndarray) -> np.ndarray:
        edge = q1 - q0
        square = np.sum(edge**2, axis=-1)
        t = np.sum((p - q0) * edge, axis=-1) / np.where(square > 0, square, 1.0)
        foot = q0 + np.clip(t, 0.0, 1.0)[..., None] * edge
        return np.asarray(np.hypot(*np.moveaxis(p - foot, -1, 0)))

    def turn(o: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return np.asarray(
            (p[..., 0] - o[..., 0]) * (q[..., 1] - o[..., 1])
            - (p[..., 1] - o[..., 1]) * (q[..., 0] - o[..., 0])
        )

    a, b = a[:, None, :], b[:, None, :]
    c, d = segments[None, :, :2], segments[None, :, 2:]
    gap = np.minimum(
        np.minimum(point_to(a, c, d), point_to(b, c, d)),
        np.minimum(point_to(c, a, b), point_to(d, a, b)),
    )
    crossing = (turn(a, b, c) * turn(a, b, d) < 0) & (turn(c, d, a) * turn(c, d, b) < 0)
    return np.where(crossing, 0.0, gap)


def check_polygon(polygon: Polygon, name: str) -> np.ndarray:
    """The polygon as `[k, 2]` float64, or a ValueError that says why it is none.

    Raises:
        ValueError: fewer than three corners, a value that is not finite, two equal corners in a
            row,
            no area, or sides that cross.
    """
    points = np.asarray(polygon, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
        raise ValueError(
            f"{name}=<shape {points.shape}>: expected at least three corners (x, y), "
            "without repeating the first one at the end"
        )
    if not np.isfinite(points).all():
        raise ValueError(f"{name}={points.tolist()}: expected finite corners; one is not finite")
    sides = polygon_segments(points)
    lengths = np.hypot(sides[:, 2] - sides[:, 0], sides[:, 3] - sides[:, 1])
    if lengths.min() < 1e-3:
        corner = points[int(lengths.argmin())].tolist()
        raise ValueError(
            f"{name}={points.tolist()}: expected each corner once, it repeats its corner {corner}; "
            "leave the second one out"
        )
    x, y = points.T
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))
    if area < 1e-6 * lengths.max() ** 2:
        raise ValueError(
            f"{name}={points.tolist()}: expected an area, it has area {area:.3g}; move a corner"
        )
    n = len(points)
    gaps = segment_distance(sides[:, :2], sides[:, 2:], sides)
    for i in range(n):
        for j in range(i + 2, n):
            if (i, j) != (0, n - 1) and gaps[i, j] < 1e-9:
                raise ValueError(
                    f"{name}={points.tolist()}: expected a simple polygon, it crosses itself (side "
                    f"{i} meets side {j}); list the corners in order around the obstacle"
                )
    return points
