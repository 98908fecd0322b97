"""Scenarios 1-3, rebuilt from the text; their drawings are lost.

What the text fixes (Shim & Li 2017, section 2.5): a closed environment; Scenario 1 with the target
in the centre and start circles at the left and right; Scenario 2 with obstacles of varying shapes
and again a left and a right start circle; Scenario 3 with more obstacles and one start circle in
the bottom-right corner. All else is ours, fixed before anything was tuned on it: the 800 x 600
plane (the distance sensor reaches 800), the obstacles, the targets of Scenarios 2 and 3, the start
headings. The tables of the source give one hint: its best network needs 46, 62 and 54 steering
movements. The shortest paths here grow in the same order (mean 275, 377 and 345 pixels).
"""

from __future__ import annotations

import functools
import math

import jax

from jaxsnn.maps import make_map
from jaxsnn.world import Params

__all__ = ["MAX_STEPS", "NAMES", "scenario"]

NAMES = {1: "Scenario 1", 2: "Scenario 2", 3: "Scenario 3"}
# A trial that has not ended after this many control steps has failed; about three times what the
# source's slowest network needs (N_mv = 75).
MAX_STEPS = 200


def _box(x: int, y: int, width: int, height: int) -> list[tuple[float, float]]:
    """Corners of an upright rectangle around (x, y)."""
    w, h = width / 2, height / 2
    return [(x - w, y - h), (x + w, y - h), (x + w, y + h), (x - w, y + h)]


def _regular(x: int, y: int, radius: int, corners: int) -> list[tuple[float, float]]:
    """Corners of a regular polygon that stands on a side."""
    first = -math.pi / 2 + math.pi / corners
    angles = [first + 2 * math.pi * i / corners for i in range(corners)]
    return [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles]


def _scenario_1() -> Params:
    """Target in the centre, four equal boxes, an open lane from either side."""
    return make_map(
        polygons=[_box(x, y, 80, 80) for x in (250, 550) for y in (150, 450)],
        target=(400, 300),
        starts=[(90, 300, 40), (710, 300, 40)],
    )


def _scenario_2() -> Params:
    """Obstacles of varying shapes between two lower start circles and a target further up."""
    return make_map(
        polygons=[
            [(140, 400), (240, 430), (160, 500)],
            _regular(270, 255, 38, 6),
            [(560, 420), (660, 420), (660, 445), (585, 445), (585, 520), (560, 520)],
            _regular(545, 270, 40, 5),
            _box(400, 90, 120, 40),
        ],
        circles=[(400, 310, 35)],
        target=(400, 470),
        starts=[(90, 200, 40), (710, 200, 40)],
    )


def _scenario_3() -> Params:
    """More obstacles, one start circle in the bottom-right corner."""
    return make_map(
        polygons=[
            _box(560, 400, 70, 50),
            [(395, 130), (465, 100), (450, 180)],
            _regular(255, 215, 40, 6),
            [(220, 390), (320, 390), (320, 415), (245, 415), (245, 480), (220, 480)],
            _regular(660, 290, 34, 5),
            _box(400, 480, 90, 40),
            _box(110, 300, 50, 120),
        ],
        circles=[(565, 190, 26), (250, 80, 35), (690, 480, 40)],
        target=(400, 300),
        starts=[(710, 90, 40)],
    )


_SCENARIOS = {1: _scenario_1, 2: _scenario_2, 3: _scenario_3}


@functools.cache
def scenario(number: int) -> Params:
    """The map of Scenario 1, 2 or 3.

    Raises:
        ValueError: there is no such scenario.

    >>> float(scenario(3).starts[0, 0]), float(scenario(3).starts[0, 1])
    (710.0, 90.0)
    """
    if number not in _SCENARIOS:
        raise ValueError(f"scenario {number!r} does not exist; choose one of {sorted(_SCENARIOS)}")
    # Concrete arrays even when a user asks for the map inside a function that is being traced.
    with jax.ensure_compile_time_eval():
        return _SCENARIOS[number]()
