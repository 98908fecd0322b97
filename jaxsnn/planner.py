"""Shortest collision-free paths on a map, on the host: the unit of the path ratio.

`path_field` builds a visibility graph over the obstacles, grown by the robot's radius, and
plans from everywhere to the target; a `PathField` then answers for any start at once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from jaxsnn import geometry
from jaxsnn.world import WorldParams

Point = Sequence[int | float] | np.ndarray

# Kept between a planned path and the exact reach of an obstacle, so that rounding cannot block it
# [px].
_SLACK = 1e-3
# Corners of the polygon that stands for a grown circle, and the largest turn at a grown corner.
_CIRCLE_CORNERS = 24
_CORNER_TURN = math.radians(30.0)


@dataclasses.dataclass(frozen=True)
class Obstacles:
    """Obstacles and walls of one map in float64, as the host checks them."""

    segments: np.ndarray  # [s, 4]
    circles: np.ndarray  # [c, 3]
    bounds: np.ndarray  # [4]

    @classmethod
    def of(cls, params: WorldParams) -> Obstacles:
        """What stands still on a map."""
        still = np.asarray(params.segment_mask) & ~np.any(np.asarray(params.segment_velocity), 1)
        rest = np.asarray(params.circle_mask) & ~np.any(np.asarray(params.circle_velocity), 1)
        return cls(
            segments=np.asarray(params.segments, np.float64)[still],
            circles=np.asarray(params.circles, np.float64)[rest],
            bounds=np.asarray(params.bounds, np.float64),
        )

    def loops(self) -> list[np.ndarray]:
        """The polygons again, each a run of sides that closes."""
        corners = self.segments[:, :2]
        ends = self.segments[:, 2:]
        loops: list[np.ndarray] = []
        first = 0
        for i in range(len(corners)):
            if np.allclose(ends[i], corners[first], atol=1e-4):
                loops.append(corners[first : i + 1])
                first = i + 1
        return loops

    def clearance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Distance of each straight line a-b `[n, 2]` to what is nearest, negative inside."""
        room = np.min(
            [
                np.minimum(a, b)[:, 0] - self.bounds[0],
                np.minimum(a, b)[:, 1] - self.bounds[1],
                self.bounds[2] - np.maximum(a, b)[:, 0],
                self.bounds[3] - np.maximum(a, b)[:, 1],
            ],
            axis=0,
        )
        if len(self.segments):
            room = np.minimum(room, geometry.segment_distance(a, b, self.segments).min(axis=1))
            inside = np.any([geometry.inside_polygon(a, p) for p in self.loops()], axis=0)
            room = np.where(inside, -1.0, room)
        if len(self.circles):
            points = np.concatenate([self.circles[:, :2], self.circles[:, :2]], axis=1)
            gap = geometry.segment_distance(a, b, points) - self.circles[None, :, 2]
            room = np.minimum(room, gap.min(axis=1))
        return np.asarray(room)


def _nodes(obstacles: Obstacles, radius: float) -> np.ndarray:
    """Corners of polygons around the obstacles grown by `radius`: where shortest paths bend."""
    reach = radius + _SLACK
    nodes: list[np.ndarray] = []
    for loop in obstacles.loops():
        x, y = loop.T
        if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) < 0:
            loop = loop[::-1]
        ahead = np.roll(loop, -1, axis=0) - loop
        after = np.arctan2(-ahead[:, 0], ahead[:, 1])  # outward normal of the side that leaves
        before = np.roll(after, 1)
        turns = np.mod(after - before + np.pi, 2 * np.pi) - np.pi
        for corner, start, turn in zip(loop, before, turns, strict=True):
            if turn <= 1e-6:
                continue  # no shortest path bends at a reflex corner
            pieces = max(1, math.ceil(turn / _CORNER_TURN))
            half = 0.5 * turn / pieces
            angles = start + half * (2 * np.arange(pieces) + 1)
            arm = reach / math.cos(half)
            nodes.append(corner + arm * np.stack([np.cos(angles), np.sin(angles)], axis=1))
    half = math.pi / _CIRCLE_CORNERS
    angles = half * (2 * np.arange(_CIRCLE_CORNERS) + 1)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for cx, cy, r in obstacles.circles:
        nodes.append(np.array([cx, cy]) + (r + reach) / math.cos(half) * ring)
    if not nodes:
        return np.zeros((0, 2))
    points = np.concatenate(nodes)
    return points[obstacles.clearance(points, points) >= radius]


@dataclasses.dataclass(frozen=True)
class PathField:
    """Shortest collision-free paths to the target of one map, from anywhere."""

    nodes: np.ndarray  # [n, 2] where paths bend [px]
    to_target: np.ndarray  # [n] length from there to the arrival circle [px]
    following: np.ndarray  # [n] next node on the way, -1 = the target
    target: np.ndarray  # [2]
    arrival_radius: float
    radius: float
    obstacles: Obstacles

    def _last_leg(self, points: np.ndarray) -> np.ndarray:
        """Length of the straight line to the arrival circle, `inf` where it is blocked."""
        offset = points - self.target
        gap = np.hypot(offset[:, 0], offset[:, 1])
        end = (
            self.target
            + offset * np.minimum(1.0, self.arrival_radius / np.maximum(gap, 1e-12))[:, None]
        )
        free = self.obstacles.clearance(points, end) >= self.radius
        return np.where(free, np.maximum(gap - self.arrival_radius, 0.0), np.inf)

    def lengths(self, starts: np.ndarray) -> np.ndarray:
        """Length [px] of the shortest path from each start `[n, 2]`, `inf` if there is none."""
        starts = np.asarray(starts, np.float64)
        return np.array([self._from(start)[0] for start in starts])

    def path(self, start: Point) -> np.ndarray:
        """Way points `[k, 2]` from a start to the centre of the target.

        Raises:
            ValueError: there is no path.
        """
        start = np.asarray(start, np.float64)
        length, node = self._from(start)
        if not math.isfinite(length):
            raise ValueError(
                f"start={start.tolist()}: expected a path to the target; choose another start"
            )
        points = [start]
        while node >= 0:
            points.append(self.nodes[node])
            node = int(self.following[node])
        return np.stack([*points, self.target])

    def _from(self, start: np.ndarray) -> tuple[float, int]:
        direct = float(self._last_leg(start[None])[0])
        if math.isfinite(direct) or not len(self.nodes):
            return direct, -1
        offset = self.nodes - start
        total = np.hypot(offset[:, 0], offset[:, 1]) + self.to_target
        # Nearest first: the first free line is the answer, so few of them are checked.
        order = np.argsort(total)
        for chunk in np.array_split(order, max(1, len(order) // 16)):
            chunk = chunk[np.isfinite(total[chunk])]
            if not len(chunk):
                break
            a = np.broadcast_to(start, (len(chunk), 2))
            free = self.obstacles.clearance(a, self.nodes[chunk]) >= self.radius
            if free.any():
                best = int(chunk[int(np.argmax(free))])
                return float(total[best]), best
        return math.inf, -1


def path_field(params: WorldParams, *, clearance: int | float | None = None) -> PathField:
    """Plan from everywhere: a visibility graph over the grown obstacles, and Dijkstra from the
    target.

    Args:
        params: one map. Moving obstacles are left out, since they give way.
        clearance: distance to keep from walls and obstacles [px]; the robot's radius by default.

    Returns:
        PathField. Round corners are planned around polygons that touch them from outside, so a
        length is an upper bound, too long by less than 1 px for each obstacle that the path bends
        around.
    """
    obstacles = Obstacles.of(params)
    radius = float(params.robot_radius) if clearance is None else float(clearance)
    nodes = _nodes(obstacles, radius)
    field = PathField(
        nodes=nodes,
        to_target=np.full(len(nodes), np.inf),
        following=np.full(len(nodes), -1),
        target=np.asarray(params.target, np.float64),
        arrival_radius=float(params.arrival_radius),
        radius=radius,
        obstacles=obstacles,
    )
    if not len(nodes):
        return field
    i, j = np.triu_indices(len(nodes), 1)
    free = obstacles.clearance(nodes[i], nodes[j]) >= radius
    edges = np.full((len(nodes), len(nodes)), np.inf)
    lengths = np.hypot(*(nodes[i] - nodes[j]).T)
    edges[i[free], j[free]] = lengths[free]
    edges = np.minimum(edges, edges.T)

    to_target = field._last_leg(nodes)
    following = np.full(len(nodes), -1)
    open_nodes = np.ones(len(nodes), bool)
    for _ in range(len(nodes)):
        here = int(np.argmin(np.where(open_nodes, to_target, np.inf)))
        if not (open_nodes[here] and math.isfinite(to_target[here])):
            break
        open_nodes[here] = False
        through = to_target[here] + edges[here]
        shorter = open_nodes & (through < to_target)
        to_target = np.where(shorter, through, to_target)
        following[shorter] = here
    return dataclasses.replace(field, to_target=to_target, following=following)


def shortest_path(
    params: WorldParams, start: Point, *, clearance: int | float | None = None
) -> tuple[float, np.ndarray]:
    """Length [px] and way points `[k, 2]` of the shortest collision-free path from one start.

    Raises:
        ValueError: the start is not free, or there is no path.

    >>> from jaxsnn import scenarios
    >>> length, _ = shortest_path(scenarios.scenario(1), (90.0, 300.0))
    >>> round(length)
    275
    """
    check_pose(params, start)
    field = path_field(params, clearance=clearance)
    points = field.path(start)
    return float(field.lengths(np.asarray([start]))[0]), points


def check_pose(params: WorldParams, position: Point) -> None:
    """Refuse a position where the robot would stand in an obstacle or in a wall.

    Raises:
        ValueError: the position is not finite, or nearer to something than the robot's radius.
    """
    point = np.asarray(position, np.float64)
    if point.shape != (2,) or not np.isfinite(point).all():
        raise ValueError(f"position={position!r}: expected two finite numbers (x, y); check it")
    room = float(Obstacles.of(params).clearance(point[None], point[None])[0])
    radius = float(params.robot_radius)
    if room < radius:
        where = "inside an obstacle or wall" if room < 0 else f"{room:.1f} px from the nearest one"
        raise ValueError(
            f"position={point.tolist()}: expected {radius:g} px free for the robot, it would be "
            f"{where}; move it"
        )
