"""Polygons that maps are built of: boxes, regular polygons, cups."""

from __future__ import annotations

import math

import numpy as np

Number = int | float
Corners = list[tuple[Number, Number]]


def box(x: Number, y: Number, width: Number, height: Number) -> Corners:
    """Corners of an upright rectangle around (x, y)."""
    w, h = width / 2, height / 2
    return [(x - w, y - h), (x + w, y - h), (x + w, y + h), (x - w, y + h)]


def regular(x: Number, y: Number, radius: Number, corners: int) -> Corners:
    """Corners of a regular polygon that stands on a side."""
    first = -math.pi / 2 + math.pi / corners
    angles = [first + 2 * math.pi * i / corners for i in range(corners)]
    return [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles]


def mirrored(corners: Corners, centre: tuple[Number, Number] = (400.0, 300.0)) -> Corners:
    """The polygon turned by 180 degrees about a point."""
    return [(2 * centre[0] - x, 2 * centre[1] - y) for x, y in corners]


def cup(
    base: tuple[Number, Number],
    towards: Number,
    width: Number,
    arms: tuple[Number, Number],
    thickness: Number = 18.0,
) -> Corners:
    """A U of three walls, open towards where a robot comes from.

    Args:
        base: middle of the inner side of the base [px].
        towards: direction in which the robot runs into it [rad].
        width: of the base, inside [px].
        arms: length of the arms on the left and on the right of that direction [px].
        thickness: of the walls [px].
    """
    ahead = np.array([math.cos(towards), math.sin(towards)])
    left = np.array([-ahead[1], ahead[0]])
    half, outer = width / 2, width / 2 + thickness
    points = [(thickness, -outer), (thickness, outer), (-arms[0], outer), (-arms[0], half),
              (0.0, half), (0.0, -half), (-arms[1], -half), (-arms[1], -outer)]  # fmt: skip
    return _rounded([np.asarray(base, float) + a * ahead + b * left for a, b in points])


def _rounded(points: list[np.ndarray]) -> Corners:
    """Whole pixels, so that a map can be written down."""
    return [(float(round(x)), float(round(y))) for x, y in points]
