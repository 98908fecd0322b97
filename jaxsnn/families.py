"""Families of maps with measured difficulty; seeds of training, validation and test apart.

A drawn map is kept only if drivers that learn nothing fail on it (`drivers.DRIVERS`: the blind one
below 10 %, both reflexes below 50 % success) and the planner finds a way with room to spare. So a
number on a family says something about learning.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsnn._checks import require, require_choice, require_whole
from jaxsnn.drivers import DRIVERS, drive
from jaxsnn.map_axes import hardened
from jaxsnn.maps import Number, make_map
from jaxsnn.planner import path_field
from jaxsnn.shapes import Corners, cup, regular
from jaxsnn.trials import success_rate
from jaxsnn.world import WorldParams

SPLITS = {"train": 0, "validation": 1_000_000, "test": 2_000_000}
"""First seed of each split; a million seeds each, so that none is ever in two of them."""
ROOM = 15.0
"""A path that keeps this distance from everything must exist [px]."""
ATTEMPTS = 200


class Difficulty(NamedTuple):
    """Success of drivers that learn nothing [%], and the shortest path with room [px]."""

    blind: float
    reflex_60: float
    reflex_100: float
    shortest: float


def difficulty(map: WorldParams, *, robots: int = 16, trials: int = 5) -> Difficulty:
    """Measure a map with the three drivers and the planner; always the same starts.

    Returns:
        Difficulty; `shortest` is the mean over the start circles, infinite without a path.
    """
    keys = jax.random.split(jax.random.key(20_170), robots)
    rates = {}
    for name, params in DRIVERS.items():
        params = jax.tree.map(jnp.float32, params)
        rates[name] = 100.0 * float(jnp.mean(success_rate(drive(params, map, keys=keys,
                                                                n_trials=trials))))  # fmt: skip
    drawn = np.asarray(map.start_probs) > 0
    centres = np.asarray(map.starts, np.float64)[drawn, :2]
    shortest = float(np.mean(path_field(map, clearance=ROOM).lengths(centres)))
    return Difficulty(**rates, shortest=shortest)


def is_admitted(measured: Difficulty) -> bool:
    """Blind below 10 %, both reflexes below 50 %, and a way that the planner knows.

    Example:
        >>> is_admitted(Difficulty(0.0, 20.0, 60.0, 500.0))
        False
    """
    reflexes = max(measured.reflex_60, measured.reflex_100)
    return measured.blind < 10.0 and reflexes < 50.0 and math.isfinite(measured.shortest)


def family_map(
    family: str,
    split: str,
    number: int,
    *,
    robots: int = 1,
    moving: int = 0,
    sonar_stuck: dict[int, Number] | None = None,
    sonar_noise: Number = 0.0,
    distance_noise: Number = 0.0,
    angle_noise: Number = 0.0,
) -> WorldParams:
    """Map `number` of a family: the first admitted one of the draws of its seed.

    What the options add is added to the admitted map: walls, obstacles that stand still, target and
    first start circle are the same with them and without.

    Args:
        family: "open" (one cup in an empty room), "cluttered" (small cups and convex obstacles),
            "detour" (one deep cup across the way and some obstacles) or "maze" (walls with lips and
            gaps on alternating sides).
        split: "train", "validation" or "test".
        number: 0 to 999,999; the same number gives the same map for ever.
        robots: start circles, the map's own and the nearest free places to it, one for each robot
            (`drivers.drive_together`); at most 8. More than two change the padding.
        moving: circles of 12 to 24 px that go to and fro by 2 to 6 px per step, at most 8; the
            same number gives the same ones for ever, and more of them begin with the fewer.
        sonar_stuck: failed sonars, `{index: what it reports [px]}`.
        sonar_noise: standard deviation of each sonar [px].
        distance_noise: standard deviation of the distance sensor [px].
        angle_noise: standard deviation of the angle sensor [deg].

    Raises:
        TypeError: a number is no whole number.
        ValueError: a name is unknown, a number or an option is out of range, no draw was admitted,
            or the map has no room for so many robots or moving obstacles.

    Example:
        >>> map = family_map("detour", "train", 0, moving=3, sonar_noise=5.0)
        >>> int(map.circle_mask.sum()), float(map.sonar_noise)
        (3, 5.0)
    """
    require_choice("family", family, tuple(FAMILIES))
    require_choice("split", split, tuple(SPLITS))
    require_whole("number", number, 0, "count from 0")
    require(number < 1_000_000, f"number={number}: expected less than 1,000,000; lower it")
    arguments, map = admitted_draw(family, split, number)
    given: dict[str, Any] = {
        "robots": robots, "moving": moving, "sonar_stuck": sonar_stuck, "sonar_noise": sonar_noise,
        "distance_noise": distance_noise, "angle_noise": angle_noise,
    }  # fmt: skip
    if given == _PLAIN:
        return map
    # A stream of its own: the draw of the map is what it is without it.
    rng = np.random.default_rng([*_seed(family, split, number), 1])
    return hardened(arguments, map, rng, **given)


_PLAIN = {
    "robots": 1, "moving": 0, "sonar_stuck": None, "sonar_noise": 0.0, "distance_noise": 0.0,
    "angle_noise": 0.0,
}  # fmt: skip


def _seed(family: str, split: str, number: int) -> list[int]:
    return [list(FAMILIES).index(family), SPLITS[split] + number]


@functools.lru_cache(maxsize=256)
def admitted_draw(family: str, split: str, number: int) -> tuple[dict[str, Any], WorldParams]:
    """The first admitted draw of a seed: its arguments of `make_map`, and the map.

    Raises:
        ValueError: no draw was admitted.
    """
    rng = np.random.default_rng(_seed(family, split, number))
    for _ in range(ATTEMPTS):
        arguments = FAMILIES[family](rng)
        try:
            map = make_map(**arguments)
        except ValueError:
            continue  # a start in an obstacle, an obstacle in a wall, no way through
        if is_admitted(difficulty(map)):
            return arguments, map
    raise ValueError(
        f"number={number}: expected an admitted {family} map within {ATTEMPTS} draws; take another"
    )


def _ends(rng: np.random.Generator, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Start and target, `least` or more apart, with room around them."""
    while True:
        start, target = rng.uniform([90, 90], [710, 510], (2, 2)).round()
        if np.hypot(*(target - start)) >= least:
            return start, target


def _across(
    rng: np.random.Generator,
    start: np.ndarray,
    target: np.ndarray,
    width: tuple[int, int],
    arms: tuple[int, int],
) -> Corners:
    """A cup across the straight way, open to the start."""
    way = target - start
    towards = math.atan2(way[1], way[0]) + rng.uniform(-0.3, 0.3)
    base = start + way * rng.uniform(0.45, 0.65)
    both = (float(rng.uniform(*arms)), float(rng.uniform(*arms)))
    return cup((base[0], base[1]), towards, float(rng.uniform(*width)), both)


def _clutter(
    rng: np.random.Generator, n: int, taken: list[tuple[np.ndarray, float]]
) -> list[Corners]:
    """Up to `n` convex obstacles that leave start and target free."""
    found: list[Corners] = []
    for _ in range(n):
        radius = float(rng.uniform(20, 42))
        centre = rng.uniform([radius, radius], [800 - radius, 600 - radius])
        if all(np.hypot(*(centre - c)) > radius + r for c, r in taken):
            x, y = centre.round(1).tolist()
            found.append(regular(x, y, radius, int(rng.integers(3, 6))))
    return found


def _map(polygons: list[Corners], start: np.ndarray, target: np.ndarray) -> dict[str, Any]:
    return {
        "polygons": polygons,
        "target": target.tolist(),
        "starts": [(*start.tolist(), 30.0)],
        "max_segments": 40,
    }


def _open(rng: np.random.Generator) -> dict[str, Any]:
    start, target = _ends(rng, 350.0)
    return _map([_across(rng, start, target, (150, 280), (40, 140))], start, target)


def _detour(rng: np.random.Generator) -> dict[str, Any]:
    start, target = _ends(rng, 400.0)
    wall = _across(rng, start, target, (180, 320), (60, 180))
    free = [(start, 75.0), (target, 80.0)]
    return _map([wall, *_clutter(rng, int(rng.integers(2, 5)), free)], start, target)


def _cluttered(rng: np.random.Generator) -> dict[str, Any]:
    start, target = _ends(rng, 350.0)
    cups = [_across(rng, start, target, (120, 200), (30, 90))]
    for _ in range(2):
        way = rng.uniform(-math.pi, math.pi)
        base = rng.uniform([100, 100], [700, 500])
        arms = (float(rng.uniform(20, 60)), float(rng.uniform(20, 60)))
        cups.append(cup((base[0], base[1]), way, float(rng.uniform(60, 120)), arms))
    free = [(start, 75.0), (target, 80.0)]
    return _map([*cups, *_clutter(rng, int(rng.integers(2, 5)), free)], start, target)


def _maze(rng: np.random.Generator) -> dict[str, Any]:
    """Two walls with lips towards the start, gaps on alternating sides, start and target apart."""
    start = np.array([80.0, rng.uniform(120, 480)]).round()
    target = np.array([720.0, rng.uniform(120, 480)]).round()
    up = bool(rng.integers(2))
    walls: list[Corners] = []
    for i in range(2):
        x = float(round(250 + 250 * i + rng.uniform(-30, 30)))
        gap = float(round(rng.uniform(100, 190)))
        lip = float(round(rng.uniform(40, 120)))
        t = 20.0
        wall = [(x, 600.0), (x, gap + t), (x - lip, gap + t), (x - lip, gap), (x + t, gap),
                (x + t, 600.0)]  # fmt: skip
        walls.append(wall if (i % 2 == 0) == up else [(a, 600.0 - b) for a, b in wall])
    if rng.random() < 0.5:  # from the right to the left
        walls = [[(800.0 - a, b) for a, b in wall] for wall in walls]
        start, target = np.array([800.0, 0.0]) + start * [-1, 1], target * [-1, 1] + [800.0, 0.0]
    return _map(walls, start, target)


FAMILIES: dict[str, Callable[[np.random.Generator], dict[str, Any]]] = {
    "open": _open,
    "cluttered": _cluttered,
    "detour": _detour,
    "maze": _maze,
}
"""Family -> a draw of arguments of `make_map`."""
