"""The robot world as gymnasium environments, one robot or many; the one file with gymnasium.

gymnasium is not installed with the package: `pip install gymnasium`. Observation, action and reward
are those of `jaxsnn.navigation.navigation_env`; the step is compiled at the first call.

>>> from jaxsnn import scenario
>>> from jaxsnn.gym_env import RobotEnv  # doctest: +SKIP
>>> env = RobotEnv(scenario(1))  # doctest: +SKIP
>>> obs, info = env.reset(seed=0)  # doctest: +SKIP
"""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

from jaxsnn import navigation
from jaxsnn._checks import require_whole
from jaxsnn.way import WayLength
from jaxsnn.world import WorldParams


def _spaces(params: WorldParams) -> tuple[spaces.Box, spaces.Box]:
    size = (navigation.observation_size(params),)
    # A sonar in an obstacle's way reads no more than its range; sine and cosine are within 1.
    return spaces.Box(-1.0, 1.0, size, np.float32), spaces.Box(-1.0, 1.0, (1,), np.float32)


def _info(made: Any) -> dict[str, Any]:
    return {"arrived": made.success, "path": made.state.length}


class RobotEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One robot on one map; an action of 1 steers 45 degrees to the left.

    Args:
        params: the map.
        max_steps: control steps after which an episode is truncated.
        way: from `ways.way_length`: the reward counts progress along the shortest way.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as the base class has it

    def __init__(
        self, params: WorldParams, *, max_steps: int = 200, way: WayLength | None = None
    ) -> None:
        env = navigation.navigation_env(params, max_steps=max_steps, way=way)
        self.observation_space, self.action_space = _spaces(params)
        self._reset, self._step = jax.jit(env.reset), jax.jit(env.step)
        self._state: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A robot in a start circle; the same seed gives the same episodes from here on."""
        super().reset(seed=seed)
        number = int(self.np_random.integers(2**31))
        self._state, obs = self._reset(jax.random.key(number))
        return np.asarray(obs), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step of 15 pixels."""
        made = self._step(self._state, jnp.asarray(action, jnp.float32))
        self._state = made.state
        info = {name: value.item() for name, value in _info(made).items()}
        flags = bool(made.terminated), bool(made.truncated)
        return np.asarray(made.obs), float(made.reward), *flags, info


class RobotVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many robots on one map in one compiled step; who ends starts anew in the next step.

    Args:
        params: the map.
        robots: how many.
        max_steps, way: as for `RobotEnv`.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        params: WorldParams,
        robots: int,
        *,
        max_steps: int = 200,
        way: WayLength | None = None,
    ) -> None:
        require_whole("robots", robots, 1, "ask for at least one")
        env = navigation.navigation_env(params, max_steps=max_steps, way=way)
        self.num_envs = robots
        self.single_observation_space, self.single_action_space = _spaces(params)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, robots)
        self.action_space = batch(self.single_action_space, robots)

        def advance(state: Any, ended: jax.Array, actions: jax.Array, keys: jax.Array) -> Any:
            made = jax.vmap(env.step)(state, actions)
            fresh = jax.vmap(env.reset)(keys)

            def chosen(new: jax.Array, old: jax.Array) -> jax.Array:
                shape = ended.shape + (1,) * (old.ndim - 1)
                return jnp.where(ended.reshape(shape), new, old)

            state, obs = jax.tree.map(chosen, fresh, (made.state, made.obs))
            going = ~ended
            return made._replace(
                state=state,
                obs=obs,
                reward=jnp.where(going, made.reward, 0.0),
                terminated=made.terminated & going,
                truncated=made.truncated & going,
                success=made.success & going,
            )

        self._reset, self._advance = jax.jit(jax.vmap(env.reset)), jax.jit(advance)
        self._state: Any = None
        self._ended = jnp.zeros(robots, bool)

    def _keys(self) -> jax.Array:
        number = int(self.np_random.integers(2**31))
        return jax.random.split(jax.random.key(number), self.num_envs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """All robots in their start circles."""
        if seed is not None:
            self._np_random = np.random.default_rng(seed)
        self._state, obs = self._reset(self._keys())
        self._ended = jnp.zeros(self.num_envs, bool)
        return np.asarray(obs), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of all robots; one that has ended begins its next episode."""
        given = jnp.asarray(actions, jnp.float32)
        made = self._advance(self._state, self._ended, given, self._keys())
        self._state, self._ended = made.state, made.terminated | made.truncated
        info = {name: np.asarray(value) for name, value in _info(made).items()}
        flags = np.asarray(made.terminated), np.asarray(made.truncated)
        return np.asarray(made.obs), np.asarray(made.reward, np.float64), *flags, info
