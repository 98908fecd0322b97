"""Rewards, which motor they are for, and the sign with which a synapse gets them.

Index 0 is the left motor, 1 the right one. The left motor turns the robot to the right.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsnn._checks import concrete, require, require_choice, require_finite, require_positive
from jaxsnn.sensor_intervals import angle_region


class RewardParams(NamedTuple):
    """Constants of section 2.2.2.

    Attributes:
        collision, arrival: `R_col`, `R_arr`, for all synapses.
        d_safe: an obstacle nearer than this is rewarded [px].
        k: the constant of Eq. 2.9; 0.3 with the additive rule, 1.3 with the multiplicative one.
        d_target: `d_tar`, the target's vicinity [px].
        r3_base: what Eq. 2.10 adds at the rim of the vicinity.
        opponent: what the motor that `r3` is not for gets, as a multiple of `-r3`; 0 is the source.
            (`r1` and `r2` are opposite by Eq. 2.9; with 1, so is the reward for the target.)
        target_near_obstacle: factor on `r3` while an obstacle is within `d_safe`; 1 is the source.
            With 0, avoidance goes first; a wide vicinity of the target needs that, or the target
            pulls the robot through what is in between.
        goal_angle: turn [deg] at which nothing is left to learn, see `scale_by_remaining_turn`;
            infinite in the source.
        commit: with 1, an obstacle that is nearest straight ahead rewards the turn that the robot
            makes anyway, whichever it is. The source names only obstacles on the right and on the
            left; before a wall the nearer side is a matter of chance, and what one step teaches the
            next one takes back.
    """

    collision: float | Array = -2.0
    arrival: float | Array = 2.0
    d_safe: float | Array = 100.0
    k: float | Array = 1.3
    d_target: float | Array = 200.0
    r3_base: float | Array = 1.0
    opponent: float | Array = 0.0
    target_near_obstacle: float | Array = 1.0
    goal_angle: float | Array = math.inf
    commit: float | Array = 0.0


def reward_params(rule: str, **changes: float) -> RewardParams:
    """The constants that the source gives for "additive" or "multiplicative" learning.

    Example:
        >>> reward_params("additive").k
        0.3
    """
    require_choice("rule", rule, ("additive", "multiplicative"))
    return RewardParams(k=0.3 if rule == "additive" else 1.3)._replace(**changes)


def check_rewards(params: RewardParams) -> None:
    """Refuse ranges that are not positive and rewards that are not finite.

    Raises:
        ValueError: names the parameter and the fix.
    """
    for name in ("d_safe", "d_target"):
        require_positive(name, getattr(params, name), "give it in pixels")
    goal = concrete(params.goal_angle)
    require(
        goal is None or bool((goal > 0).all()),
        f"goal_angle={goal}: expected degrees > 0; give infinity for a reward without an end",
    )
    for name in ("collision", "arrival", "k", "r3_base", "opponent", "target_near_obstacle"):
        require_finite(name, getattr(params, name), "give a number")


def avoidance_rewards(params: RewardParams, d: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    r"""`r_1` and `r_2` for an obstacle at distance `d`; zero beyond `d_safe`.

    .. math:: r_1(d) = \frac{d_{safe} - d}{d_{safe}} + k, \qquad r_2(d) = -r_1(d),
              \qquad d < d_{safe}

    Source: Shim (2020), Eq. 2.9.

    Example:
        >>> avoidance_rewards(RewardParams(k=0.5), jnp.array([50.0, 100.0])).tolist()
        [[1.0, -1.0], [0.0, -0.0]]
    """
    r1 = jnp.where(d < params.d_safe, (params.d_safe - d) / params.d_safe + params.k, 0.0)
    return jnp.stack([r1, -r1], axis=-1)


def target_reward(params: RewardParams, d: Float[Array, "*n"]) -> Float[Array, "*n"]:
    r"""`r_3` for a target at distance `d`; zero outside its vicinity.

    .. math:: r_3(d) = \frac{d_{tar} - d}{d_{tar}} + 1, \qquad d < d_{tar}

    Source: Shim (2020), Eq. 2.10.

    Example:
        >>> target_reward(RewardParams(), jnp.array([100.0, 200.0])).tolist()
        [1.5, 0.0]
    """
    near = (params.d_target - d) / params.d_target + params.r3_base
    return jnp.where(d < params.d_target, near, 0.0)


def motor_rewards(
    params: RewardParams,
    sonar: Float[Array, " n_sonar"],
    distance: Float[Array, ""],
    angle: Float[Array, ""],
    steering: Float[Array, ""] | None = None,
) -> Float[Array, "2"]:
    """What the synapses of the left and of the right motor get while the robot is under way.

    The nearest obstacle within `d_safe` on the right: `r_2` to the left motor's synapses, `r_1` to
    the right motor's (which turns the robot left); on the left: the other way round. Then `r_3` to
    the left motor's synapses when the target is in region 2 (right), to the right motor's when it
    is in region 4 (left).

    Args:
        params: RewardParams.
        sonar: readings [px], from left to right, an odd number of them.
        distance: to the target [px].
        angle: from the heading to the target [deg], positive to the left.
        steering: what the robot does [deg], positive to the left; only `commit` asks for it.

    Returns:
        Reward for the left and the right motor's synapses, `[2]`.

    Source:
        Shim (2020), sections 2.2.2.2 and 2.2.2.3. The text does not say on which side an obstacle
        straight ahead is: here on the side where the other sonars see nearer; with a tie, on none.
    """
    half = sonar.shape[0] // 2
    left, right = jnp.min(sonar[:half]), jnp.min(sonar[half + 1 :])
    r1, r2 = avoidance_rewards(params, jnp.min(sonar))
    for_right = jnp.stack([r2, r1])
    zero = jnp.zeros_like(for_right)
    avoid = jnp.where(right < left, for_right, jnp.where(left < right, for_right[::-1], zero))
    if steering is not None:
        ahead = sonar[half] <= jnp.minimum(left, right)
        onwards = jnp.where(steering >= 0, for_right, for_right[::-1])
        avoid = jnp.where(ahead & (params.commit > 0), onwards, avoid)
    share = jnp.where(jnp.min(sonar) < params.d_safe, params.target_near_obstacle, 1.0)
    r3 = share * target_reward(params, distance)
    region = angle_region(angle)
    on_right, on_left = region == 1, region == 3
    other = -params.opponent * r3
    to_left = jnp.where(on_right, r3, jnp.where(on_left, other, 0.0))
    to_right = jnp.where(on_left, r3, jnp.where(on_right, other, 0.0))
    return avoid + jnp.stack([to_left, to_right])


def scale_by_remaining_turn(
    params: RewardParams, reward: Float[Array, "2"], steering: Float[Array, ""]
) -> Float[Array, "2"]:
    r"""A reward for turning, scaled by the turn that is left to the goal: a prediction error.

    .. math:: r \leftarrow r \, \mathrm{clip}\left(1 - \frac{s \theta}{\theta_{goal}}, -1, 1\right),
              \qquad s = \mathrm{sign}(r_{right} - r_{left})

    The source rewards a turn for as long as an obstacle is near, whatever the robot does, and what
    is rewarded grows without end. Here the turn settles at :math:`\theta_{goal}`, since a wider one
    is pushed back. Rewards that are the same for both motors stay as they are.

    Args:
        params: RewardParams; `goal_angle` [deg], infinite for the source.
        reward: for the synapses of the left and of the right motor.
        steering: turn that goes with it [deg], positive to the left.

    Source: Ours; the delta rule of Widrow and Hoff (1960) with the sign of the source's rewards.

    Example:
        >>> params = RewardParams(goal_angle=60.0)
        >>> scale_by_remaining_turn(params, jnp.array([-1.0, 1.0]), jnp.asarray(45.0)).tolist()
        [-0.25, 0.25]
    """
    side = jnp.sign(reward[1] - reward[0])
    return reward * jnp.clip(1.0 - side * steering / params.goal_angle, -1.0, 1.0)


def terminal_reward(
    params: RewardParams, collided: Bool[Array, ""], arrived: Bool[Array, ""]
) -> Float[Array, ""]:
    """`R_col`, `R_arr` or 0, for the whole network (section 2.2.2.1).

    Returns:
        The reward `[]`.
    """
    return jnp.where(collided, params.collision, jnp.where(arrived, params.arrival, 0.0))


def synapse_signs(
    pre: Float[Array, " n_pre"], hidden: Float[Array, " n_hidden"]
) -> tuple[Float[Array, "n_pre n_hidden"], Float[Array, " n_hidden"]]:
    """Factor on a reward for each synapse of the two layers: fine-grained rewards as a product.

    A synapse works for its motor when the number of inhibitory synapses from it to the motor,
    itself included, is even. So the first layer gets `s_pre s_hidden r` and the second
    `s_hidden r`, with `s` = +1 for excitatory neurons and -1 for inhibitory ones:

    ====  ============  ============
    path  first         second
    ====  ============  ============
    I-I   `+r`          `-r`
    I-E   `-r`          `+r`
    E-I   `-r`          `-r`
    E-E   `+r`          `+r`
    ====  ============  ============

    A reward acts on the magnitude of a weight: `-r` weakens an inhibitory synapse, too.

    Source: Shim (2020), section 2.3.2.

    Example:
        >>> first, second = synapse_signs(jnp.array([1.0, -1.0]), jnp.array([1.0, -1.0]))
        >>> first.tolist(), second.tolist()
        ([[1.0, -1.0], [-1.0, 1.0]], [1.0, -1.0])
    """
    require(pre.ndim == 1 and hidden.ndim == 1, "signs are one number per neuron")
    return pre[:, None] * hidden[None, :], hidden
