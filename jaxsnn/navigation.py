"""The robot world as an environment for reinforcement learning: observation, action, reward.

`start_robot` and `drive_robot` are one robot's episode; `navigation_env` and `brax_env` wrap them,
and `gymnax_pair` has the signatures of gymnax.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxsnn import world
from jaxsnn._checks import require_whole, typed_key
from jaxsnn.ppo_config import Env, Transition
from jaxsnn.way import WayLength, remaining_way

# A full action turns the robot by this much [deg].
STEERING_SCALE = 45.0


class Drive(NamedTuple):
    """What one control step of a robot gives a learner."""

    robot: world.WorldState
    obs: Float[Array, "o"]
    reward: Float[Array, ""]
    outcome: world.Outcome


class _Navigation(NamedTuple):
    robot: world.WorldState
    length: Array  # path so far [px]
    start: Array  # [2]


def observation_size(params: world.WorldParams) -> int:
    """Numbers in an observation on this map: its sonars, the distance, two for the angle."""
    return params.sonar_angles.shape[-1] + 3


def observation(params: world.WorldParams, reading: world.Reading) -> Float[Array, "o"]:
    """Readings in [-1, 1]: sonars, the distance, and sine and cosine of the angle."""
    angle = jnp.deg2rad(reading.angle)
    rest = [reading.distance / params.distance_range, jnp.sin(angle), jnp.cos(angle)]
    return jnp.concatenate([reading.sonar / params.sonar_range, jnp.stack(rest)])


def navigation_reward(
    params: world.WorldParams,
    before: world.WorldState,
    after: world.WorldState,
    outcome: world.Outcome,
    way: WayLength | None = None,
) -> Float[Array, ""]:
    r"""Arrival +2, collision -2, and one for each 100 px that the target comes nearer.

    .. math:: r = 2\,[\text{arrived}] - 2\,[\text{collided}] + (d_t - d_{t+1}) / 100

    Args:
        params: the map.
        before, after: the robot before and after the step.
        outcome: of the step.
        way: takes `d` along the shortest way. Without it `d` is the straight distance, whose sum is
            the distance covered towards the target: every detour has to be paid for first.
    """

    def distance(state: world.WorldState) -> Array:
        if way is not None:
            return remaining_way(way, state.x, state.y)
        return jnp.hypot(params.target[0] - state.x, params.target[1] - state.y)

    ends = jnp.where(outcome.arrived, 2.0, 0.0) - jnp.where(outcome.collided, 2.0, 0.0)
    progress = (distance(before) - distance(after)) / 100.0
    return ends.astype(progress.dtype) + progress


def start_robot(
    params: world.WorldParams, *, key: Key[Array, ""]
) -> tuple[world.WorldState, Float[Array, "o"]]:
    """A robot in a start circle, and its first observation."""
    robot = world.reset(params, key=key)
    return robot, observation(params, world.observe(params, robot))


def drive_robot(
    params: world.WorldParams,
    robot: world.WorldState,
    action: Float[Array, "1"],
    way: WayLength | None = None,
) -> Drive:
    """One control step of 15 pixels; an action of 1 (and beyond) steers 45 degrees to the left."""
    steering = STEERING_SCALE * jnp.clip(action[0], -1.0, 1.0)
    after, outcome = world.step(params, robot, steering)
    return Drive(
        robot=after,
        obs=observation(params, world.observe(params, after)),
        reward=navigation_reward(params, robot, after, outcome, way),
        outcome=outcome,
    )


def navigation_env(
    params: world.WorldParams, *, max_steps: int = 200, way: WayLength | None = None
) -> Env:
    """The robot world as an `Env`; an action of 1 steers 45 degrees to the left.

    Args:
        params: the map.
        way: from `ways.way_length`; the reward counts progress along the shortest way instead of
            the straight distance.
        max_steps: a trial that has not ended after so many control steps is truncated.

    Raises:
        ValueError: `max_steps` is below 1.
    """
    require_whole("max_steps", max_steps, 1, "allow at least one control step")

    def reset(key: Array) -> tuple[_Navigation, Array]:
        robot, obs = start_robot(params, key=key)
        start = jnp.stack([robot.x, robot.y])
        return _Navigation(robot, jnp.zeros_like(robot.x), start), obs

    def step(state: _Navigation, action: Array) -> Transition:
        made = drive_robot(params, state.robot, action, way)
        terminated = made.outcome.arrived | made.outcome.collided
        moved = jnp.hypot(made.robot.x - state.robot.x, made.robot.y - state.robot.y)
        return Transition(
            state=state._replace(robot=made.robot, length=state.length + moved),
            obs=made.obs,
            reward=made.reward,
            terminated=terminated,
            truncated=(made.robot.t >= max_steps) & ~terminated,
            success=made.outcome.arrived,
        )

    return Env(reset, step, action_size=1)


class GymnaxPair(NamedTuple):
    """The two functions that learners written for gymnax call; both are pure.

    Attributes:
        reset: `(key, params) -> (obs, state)`.
        step: `(key, state, action, params) -> (obs, state, reward, done, info)`.
    """

    reset: Callable[..., tuple[Array, Any]]
    step: Callable[..., tuple[Array, Any, Array, Array, dict[str, Array]]]


def gymnax_pair(*, max_steps: int = 200, way: WayLength | None = None) -> GymnaxPair:
    """The robot world as gymnax has its environments (gymnax itself is not needed).

    `params` of the two functions is the map, so that jit and vmap go over maps as well. `step`
    begins the next episode by itself: after an end, `obs` and `state` are those of a fresh start
    from `key`, while `reward`, `done` and `info` are of the step that ended. `info` says whether
    the robot has `arrived`, whether the limit of steps `truncated` the episode, and `discount`, 0
    after arrival or collision alone, so that a learner may look beyond the limit. Keys may be raw,
    as most of these learners have them.

    Args:
        max_steps, way: as for `navigation_env`.

    Raises:
        ValueError, TypeError: `max_steps` is no whole number above 0.

    Example:
        >>> from jaxsnn import scenario
        >>> env, key = gymnax_pair(max_steps=50), jax.random.key(0)
        >>> obs, state = env.reset(key, scenario(1))
        >>> obs, state, reward, done, info = env.step(key, state, jnp.zeros(1), scenario(1))
        >>> obs.shape, bool(done), float(info["discount"])
        ((8,), False, 1.0)
    """
    require_whole("max_steps", max_steps, 1, "allow at least one control step")

    def reset(key: Array, params: world.WorldParams) -> tuple[Array, _Navigation]:
        state, obs = navigation_env(params, max_steps=max_steps, way=way).reset(typed_key(key))
        return obs, state

    def step(
        key: Array,
        state: _Navigation,
        action: Float[Array, "1"],
        params: world.WorldParams,
    ) -> tuple[Array, _Navigation, Array, Array, dict[str, Array]]:
        made = navigation_env(params, max_steps=max_steps, way=way).step(state, action)
        done = made.terminated | made.truncated
        obs, after = jax.tree.map(
            lambda fresh, old: jnp.where(done, fresh, old),
            reset(key, params), (made.obs, made.state),
        )  # fmt: skip
        info = {
            "arrived": made.success,
            "truncated": made.truncated,
            "discount": 1.0 - made.terminated.astype(made.reward.dtype),
        }
        return obs, after, made.reward, done, info

    return GymnaxPair(reset, step)
