"""Scenarios 1-3, rebuilt from the text; their drawings are lost.

What the text fixes (Shim & Li 2017, section 2.5): a closed environment; Scenario 1 with the target
in the centre and start circles at the left and right; Scenario 2 with obstacles of varying shapes
and again a left and a right start circle; Scenario 3 with more obstacles and one start circle in
the bottom-right corner. All else is ours, fixed before anything was tuned on it: the 800 x 600
plane (the distance sensor reaches 800), the obstacles, the targets of Scenarios 2 and 3, the start
headings. The tables of the source give one hint: its best network needs 46, 62 and 54 steering
movements. The shortest paths here grow in the same order (mean 275, 376 and 345 pixels).
"""

from __future__ import annotations

import functools

import jax

from jaxsnn.maps import make_map
from jaxsnn.shapes import box, mirrored, regular
from jaxsnn.world import WorldParams

NAMES = {1: "Scenario 1", 2: "Scenario 2", 3: "Scenario 3"}
# A trial that has not ended after this many control steps has failed; about three times what the
# source's slowest network needs (N_mv = 75).
MAX_STEPS = 200


def _scenario_1() -> WorldParams:
    """Target in the centre, four equal boxes, an open lane from either side."""
    return make_map(
        polygons=[box(x, y, 80, 80) for x in (250, 550) for y in (150, 450)],
        target=(400, 300),
        starts=[(90, 300, 40), (710, 300, 40)],
    )


def _scenario_2() -> WorldParams:
    """Obstacles of varying shapes between two lower start circles and a target further up."""
    return make_map(
        polygons=[
            [(140, 400), (240, 430), (160, 500)],
            regular(270, 255, 38, 6),
            [(560, 420), (660, 420), (660, 445), (585, 445), (585, 520), (560, 520)],
            regular(545, 270, 40, 5),
            box(400, 90, 120, 40),
        ],
        circles=[(400, 310, 35)],
        target=(400, 470),
        starts=[(90, 200, 40), (710, 200, 40)],
    )


def _scenario_3() -> WorldParams:
    """More obstacles, one start circle in the bottom-right corner."""
    return make_map(
        polygons=[
            box(560, 400, 70, 50),
            [(395, 130), (465, 100), (450, 180)],
            regular(255, 215, 40, 6),
            [(220, 390), (320, 390), (320, 415), (245, 415), (245, 480), (220, 480)],
            regular(660, 290, 34, 5),
            box(400, 480, 90, 40),
            box(110, 300, 50, 120),
        ],
        circles=[(565, 190, 26), (250, 80, 35), (690, 480, 40)],
        target=(400, 300),
        starts=[(710, 90, 40)],
    )


_SCENARIOS = {1: _scenario_1, 2: _scenario_2, 3: _scenario_3}


@functools.cache
def scenario(number: int) -> WorldParams:
    """The map of Scenario 1, 2 or 3.

    Returns:
        WorldParams with the padding of `make_map`.

    Raises:
        ValueError: there is no such scenario.

    >>> float(scenario(3).starts[0, 0]), float(scenario(3).starts[0, 1])
    (710.0, 90.0)
    """
    if number not in _SCENARIOS:
        raise ValueError(f"number={number!r}: expected one of {sorted(_SCENARIOS)}; choose one")
    # Concrete arrays even when a user asks for the map inside a function that is being traced.
    with jax.ensure_compile_time_eval():
        return _SCENARIOS[number]()


def _detour_1() -> WorldParams:
    """Target in the centre; before each start a wall with a lip, the way round is one-sided."""
    wall = [(258, 600), (258, 165), (142, 165), (142, 145), (278, 145), (278, 600)]
    hook = [(float(x), float(y)) for x, y in wall]
    block = box(110, 500, 60, 50)
    return make_map(
        polygons=[hook, mirrored(hook), block, mirrored(block)],
        target=(400, 300),
        starts=[(90, 300, 40), (710, 300, 40)],
    )


def _detour_2() -> WorldParams:
    """Obstacles of varying shapes, lower starts; a cup of its own across each straight way."""
    return make_map(
        polygons=[
            [(314, 208), (187, 372), (84, 293), (95, 279), (184, 347), (289, 212), (232, 168),
             (243, 154)],
            [(648, 343), (470, 236), (546, 110), (561, 119), (495, 230), (642, 318), (703, 217),
             (718, 226)],
            [(590, 500), (650, 470), (645, 540)],
            regular(400, 60, 26, 5),
            regular(170, 520, 28, 6),
        ],
        circles=[(400, 250, 25)],
        target=(400, 480),
        starts=[(90, 100, 40), (710, 100, 40)],
    )  # fmt: skip


def _detour_3() -> WorldParams:
    """More obstacles, one start circle in the bottom-right corner, a deep cup before it."""
    return make_map(
        polygons=[
            [(527, 403), (380, 191), (553, 71), (564, 86), (405, 196), (532, 378), (630, 310),
             (641, 324)],
            regular(200, 190, 36, 6),
            [(200, 490), (300, 490), (300, 510), (220, 510), (220, 560), (200, 560)],
            regular(720, 330, 28, 5),
            box(480, 510, 80, 36),
            box(100, 320, 46, 110),
        ],
        circles=[(250, 70, 30), (690, 490, 36)],
        target=(330, 400),
        starts=[(710, 90, 40)],
    )  # fmt: skip


_DETOURS = {1: _detour_1, 2: _detour_2, 3: _detour_3}


@functools.cache
def detour(number: int) -> WorldParams:
    """D1, D2 or D3: Scenarios 1 to 3 read so that the straight way fails.

    What the text fixes is kept (target, start circles, kinds of obstacles). Drivers that learn
    nothing, blind or with a reflex at 60 or 100 pixels, do not get through (`jaxsnn.drivers`), and
    the shortest paths are nearer to the length of the source's trials, N_mv times 15 pixels.

    Returns:
        WorldParams with the padding of `make_map`.

    Raises:
        ValueError: there is no such map.

    Example:
        >>> detour(1).target.tolist()
        [400.0, 300.0]
    """
    if number not in _DETOURS:
        raise ValueError(f"number={number!r}: expected one of {sorted(_DETOURS)}; choose one")
    with jax.ensure_compile_time_eval():
        return _DETOURS[number]()
