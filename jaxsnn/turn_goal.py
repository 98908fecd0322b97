"""A graded reward: what turn a reading asks for, from all sonars, the angle and the last turns.

The source rewards one of two directions by the nearest obstacle alone. Here every sonar counts in
proportion to how near its obstacle is, the side that was chosen last counts as well, so that a wall
straight ahead does not turn the robot to and fro, and no turn towards the target is asked for while
something stands in the way on that side: the robot goes along it.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn._checks import require_finite, require_positive
from jaxsnn.world import Reading


class TurnGoalParams(NamedTuple):
    """Constants of the graded reward; the reading "guided" has those chosen on validation maps.

    Attributes:
        side, diagonal, front: distance at which the outer, inner and front sonars ask for a turn
            away [px].
        blocked: no turn towards the target while a sonar on its side reads less [px].
        avoid, towards: size of the turns away and towards the target, at most [deg].
        commitment: weight of the recent turns in the choice of the side.
        memory: share of the recent turn that is kept at each step.
        avoid_weight, target_weight, straight_weight: reward for each of the three goals.
        scale: error at which the reward is full [deg].
    """

    side: float | Array = 100.0
    diagonal: float | Array = 100.0
    front: float | Array = 100.0
    blocked: float | Array = 100.0
    avoid: float | Array = 60.0
    towards: float | Array = 60.0
    commitment: float | Array = 1.0
    memory: float | Array = 0.7
    avoid_weight: float | Array = 2.0
    target_weight: float | Array = 2.0
    straight_weight: float | Array = 1.0
    scale: float | Array = 60.0


def check_turn_goal(params: TurnGoalParams) -> None:
    """Refuse constants that ask for no turn.

    Raises:
        ValueError: names the constant, its value and the fix.
    """
    for name in ("side", "diagonal", "front", "scale"):
        require_positive(name, getattr(params, name), "give pixels (scale: degrees)")
    for name in ("blocked", "avoid", "towards", "avoid_weight", "target_weight", "straight_weight"):
        require_positive(name, getattr(params, name), "0 leaves it out", zero=True)
    for name in ("commitment", "memory"):
        require_finite(name, getattr(params, name), "give a number >= 0")


def turn_goal(
    params: TurnGoalParams, reading: Reading, recent_turn: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    r"""The turn that a reading asks for [deg], positive to the left, and what it is worth.

    .. math:: p_i = \max(0, 1 - s_i / d_i), \qquad
        g = \begin{cases} A\,\mathrm{sign}(p_{right} - p_{left} + c\,\bar\theta / 60) &
        \max_i p_i > 0 \\ \mathrm{clip}(\beta, -G, G) & \text{else, 0 if blocked} \end{cases}

    with the largest `p` of each side, :math:`c` the commitment and :math:`\bar\theta` the recent
    turn.

    Args:
        params: TurnGoalParams.
        reading: sonars, the middle one ahead, distance and angle.
        recent_turn: leaky mean of the last turns [deg].
    """
    half = reading.sonar.shape[0] // 2
    between = [params.diagonal] * (half - 1)
    reach = jnp.stack([params.side, *between, params.front, *between, params.side]).astype(
        reading.sonar.dtype
    )
    near = jnp.maximum(0.0, 1.0 - reading.sonar / reach)
    push = jnp.max(near[half + 1 :]) - jnp.max(near[:half])
    push = push + params.commitment * recent_turn / 60.0
    away = jnp.where(push < 0, -params.avoid, params.avoid)
    ahead = jnp.clip(reading.angle, -params.towards, params.towards)
    left_blocked = jnp.min(reading.sonar[:half]) < params.blocked
    right_blocked = jnp.min(reading.sonar[half + 1 :]) < params.blocked
    shut = ((ahead > 0) & left_blocked) | ((ahead < 0) & right_blocked)
    ahead = jnp.where(shut, 0.0, ahead)
    avoiding = jnp.max(near) > 0
    weight = jnp.where(ahead != 0, params.target_weight, params.straight_weight)
    return (
        jnp.where(avoiding, away, ahead),
        jnp.where(avoiding, params.avoid_weight, weight),
    )


def update_recent_turn(
    params: TurnGoalParams, recent: Float[Array, ""], turn: Float[Array, ""]
) -> Float[Array, ""]:
    r"""The leaky mean of the turns after one more [deg].

    .. math:: \bar\theta \leftarrow m \bar\theta + (1 - m)\,\mathrm{clip}(\theta, -60, 60)

    with :math:`m` the `memory`.
    """
    return params.memory * recent + (1.0 - params.memory) * jnp.clip(turn, -60.0, 60.0)


def turn_reward(
    params: TurnGoalParams,
    reading: Reading,
    recent_turn: Float[Array, ""],
    turn: Float[Array, ""],
) -> Float[Array, "2"]:
    r"""Reward of the left and the right motor's synapses for a turn: the error that is left.

    .. math:: r_{right} = -r_{left} = k\,\mathrm{clip}((g - \theta) / \text{scale}, -1, 1)

    Args:
        params: TurnGoalParams.
        reading: what the network saw.
        recent_turn: leaky mean of the turns before this one [deg].
        turn: what the motors ask for now, before it is cut off [deg].

    Source: ours; the delta rule of Widrow and Hoff (1960).
    """
    return _error_reward(params, *turn_goal(params, reading, recent_turn), turn)


def way_reward(
    params: TurnGoalParams, reading: Reading, turn: Float[Array, ""]
) -> Float[Array, "2"]:
    r"""Reward of the left and the right motor's synapses from a trainer that knows the map.

    .. math:: r_{right} = -r_{left} = k\,\mathrm{clip}((\mathrm{clip}(\beta, -G, G) - \theta)
              / \text{scale}, -1, 1)

    with :math:`\beta` the turn onto the shortest way, G `towards` and k `target_weight`. The way is
    not among what the network senses: weights, once frozen, drive by the sensors alone.

    Args:
        params: TurnGoalParams.
        reading: with `way_turn`, of a map made by `ways.with_way`.
        turn: what the motors ask for now, before it is cut off [deg].

    Raises:
        ValueError: the map has no ways.

    Source: ours; the delta rule of Widrow and Hoff (1960).
    """
    if reading.way_turn is None:
        raise ValueError(
            "map.way=None: expected a map with its shortest ways for guidance='way'; learn on "
            "ways.with_way(map)"
        )
    goal = jnp.clip(reading.way_turn, -params.towards, params.towards)
    return _error_reward(params, goal, params.target_weight, turn)


def _error_reward(
    params: TurnGoalParams, goal: Array, weight: float | Array, turn: Array
) -> Float[Array, "2"]:
    """What is left of the turn to its goal, for the right motor and against the left one."""
    error = weight * jnp.clip((goal - turn) / params.scale, -1.0, 1.0)
    return jnp.stack([-error, error])
