"""The robot world as an environment for reinforcement learning: observation, action, reward."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn import world
from jaxsnn.ppo import Env, Transition

__all__ = [
    "OBSERVATION_SIZE",
    "STEERING_SCALE",
    "navigation_env",
    "navigation_reward",
    "observation",
]

OBSERVATION_SIZE = world.N_SONARS + 3
# A full action turns the robot by this much [deg].
STEERING_SCALE = 45.0


class _Navigation(NamedTuple):
    robot: world.State
    length: Array  # path so far [px]
    start: Array  # [2]


def observation(reading: world.Reading, params: world.Params) -> Float[Array, "8"]:
    """Readings in [-1, 1]: five sonars, the distance, and sine and cosine of the angle."""
    angle = jnp.deg2rad(reading.angle)
    rest = [reading.distance / params.distance_range, jnp.sin(angle), jnp.cos(angle)]
    return jnp.concatenate([reading.sonar / params.sonar_range, jnp.stack(rest)])


def navigation_reward(
    before: world.State, after: world.State, outcome: world.Outcome, params: world.Params
) -> Float[Array, ""]:
    r"""Arrival +2, collision -2, and one for each 100 px that the target comes nearer.

    .. math:: r = 2\,[\text{arrived}] - 2\,[\text{collided}] + (d_t - d_{t+1}) / 100

    The last term sums to the distance covered towards the target and so favours no detour.
    """

    def distance(state: world.State) -> Array:
        return jnp.hypot(params.target[0] - state.x, params.target[1] - state.y)

    ends = jnp.where(outcome.arrived, 2.0, 0.0) - jnp.where(outcome.collided, 2.0, 0.0)
    progress = (distance(before) - distance(after)) / 100.0
    return ends.astype(progress.dtype) + progress


def navigation_env(params: world.Params, *, max_steps: int = 200) -> Env:
    """The robot world as an `Env`; an action of 1 steers 45 degrees to the left.

    Args:
        params: the map.
        max_steps: a trial that has not ended after so many control steps is truncated.

    Raises:
        ValueError: `max_steps` is below 1.
    """
    if max_steps < 1:
        raise ValueError(f"max_steps = {max_steps} must be at least 1")

    def reset(key: Array) -> tuple[_Navigation, Array]:
        robot = world.reset(key, params)
        obs = observation(world.observe(robot, params), params)
        start = jnp.stack([robot.x, robot.y])
        return _Navigation(robot, jnp.zeros_like(robot.x), start), obs

    def step(state: _Navigation, action: Array) -> Transition:
        steering = STEERING_SCALE * jnp.clip(action[0], -1.0, 1.0)
        robot, outcome = world.step(state.robot, steering, params)
        terminated = outcome.arrived | outcome.collided
        moved = jnp.hypot(robot.x - state.robot.x, robot.y - state.robot.y)
        return Transition(
            state=state._replace(robot=robot, length=state.length + moved),
            obs=observation(world.observe(robot, params), params),
            reward=navigation_reward(state.robot, robot, outcome, params),
            terminated=terminated,
            truncated=(robot.t >= max_steps) & ~terminated,
            success=outcome.arrived,
        )

    return Env(reset, step, action_size=1)
