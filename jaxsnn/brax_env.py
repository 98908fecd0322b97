"""The robot world as a brax `Env`: brax's wrappers and learners run on it; the one file with
brax.

One robot is one environment; brax's wrappers vmap it. The observation, the reward and the meaning
of an action are those of `jaxsnn.navigation.navigation_env`. Importing brax takes seconds and
prints two lines to stdout, so nothing else in the package imports this module.

>>> from jaxsnn import scenarios
>>> from jaxsnn.brax_env import NavigationEnv  # doctest: +SKIP
>>> env = NavigationEnv(scenarios.scenario(1))  # doctest: +SKIP
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper
from brax.envs.wrappers.training import (
    DomainRandomizationVmapWrapper,
    EpisodeWrapper,
    VmapWrapper,
)
from jaxtyping import Array

from jaxsnn import navigation, world
from jaxsnn._checks import require, typed_key
from jaxsnn.maps import stack_maps


class PipelineState(NamedTuple):
    """What a robot carries: its pose, and a key for its sensors' noise as raw words.

    brax's wrappers select between states with `where` after a reshape, which typed keys do not
    take.
    """

    robot: world.WorldState  # its key replaced by words [2] uint32
    params: world.WorldParams


def _pack(robot: world.WorldState) -> world.WorldState:
    return robot._replace(key=jax.random.key_data(robot.key))


def _unpack(robot: world.WorldState) -> world.WorldState:
    return robot._replace(key=jax.random.wrap_key_data(robot.key))


class NavigationEnv(Env):
    """One robot on one map.

    Observation `[sonars + 3]`: `jaxsnn.navigation.observation`. Action `[1]` in [-1, 1]: 1 steers
    45 degrees to the left. Reward: `jaxsnn.navigation.navigation_reward`. `done` is 1.0
    after arrival, collision or a state that is not finite; `metrics` say which. The limit on
    steps is brax's `episode_length`.

    Args:
        params: the map; it travels in `pipeline_state` and may be changed there.

    Attributes:
        sys: the map under the name by which brax's domain randomization changes it.
    """

    def __init__(self, params: world.WorldParams) -> None:
        self.sys = params

    @property
    def params(self) -> world.WorldParams:
        """The map."""
        return self.sys

    def reset(self, rng: jax.Array) -> State:
        """A robot in a start circle; `rng` may be a raw or a typed key."""
        robot, obs = navigation.start_robot(self.params, key=typed_key(rng))
        zero = jnp.zeros((), jnp.float32)
        return State(
            pipeline_state=PipelineState(_pack(robot), self.params),
            obs=obs,
            reward=zero,
            done=zero,
            metrics={"arrived": zero, "collided": zero, "failed": zero},
            info={},
        )

    def step(self, state: State, action: jax.Array) -> State:
        """One control step of 15 pixels."""
        carried: Any = state.pipeline_state
        params = carried.params
        made = navigation.drive_robot(params, _unpack(carried.robot), action)
        flags = {
            name: jnp.asarray(getattr(made.outcome, name)).astype(jnp.float32)
            for name in ("arrived", "collided", "failed")
        }
        return state.replace(
            pipeline_state=PipelineState(_pack(made.robot), params),
            obs=made.obs,
            reward=made.reward,
            done=flags["arrived"] + flags["collided"] + flags["failed"],
            metrics={**state.metrics, **flags},
        )

    @property
    def observation_size(self) -> int:
        """Sonars, distance, sine and cosine of the angle."""
        return navigation.observation_size(self.params)

    @property
    def action_size(self) -> int:
        """Steering."""
        return 1

    @property
    def backend(self) -> str:
        """No physics engine of brax is behind this."""
        return "kinematic"


class FreshResetWrapper(Wrapper):
    """Start the next episode anywhere in the start circles.

    brax's own `AutoResetWrapper` goes back to the first state of each environment for the whole
    run. Wraps a batched environment.
    """

    def reset(self, rng: jax.Array) -> State:
        """Reset all environments and keep a key for each."""
        state = self.env.reset(rng)
        words = (
            rng if not jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jax.random.key_data(rng)
        )
        state.info["reset_rng"] = words
        return state

    def step(self, state: State, action: jax.Array) -> State:
        """Step all, then reset those that are done."""
        if "steps" in state.info:
            over = state.done.astype(bool)
            steps = jnp.where(over, jnp.zeros_like(state.info["steps"]), state.info["steps"])
            state.info.update(steps=steps)
        state = self.env.step(state.replace(done=jnp.zeros_like(state.done)), action)
        split = jax.vmap(lambda k: jax.random.key_data(jax.random.split(typed_key(k))))
        words = split(state.info["reset_rng"])
        fresh = self.env.reset(words[:, 0])
        done = state.done.astype(bool)

        def choose(new: Array, old: Array) -> Array:
            return jnp.where(done.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        info = {**state.info, "reset_rng": words[:, 1]}
        return state.replace(
            pipeline_state=jax.tree.map(choose, fresh.pipeline_state, state.pipeline_state),
            obs=choose(fresh.obs, state.obs),
            info=info,
        )


def map_randomization(
    maps: Sequence[world.WorldParams], **ranges: tuple[float, float]
) -> Callable[[world.WorldParams, Array], tuple[world.WorldParams, world.WorldParams]]:
    """A `randomization_fn` for brax's learners: a map, and constants of it, for each environment.

    Args:
        maps: each environment has one of them, equally likely.
        ranges: name of a constant -> lowest and highest value, drawn uniformly; the scalars of
            `WorldParams`: `speed`, `robot_radius`, `sonar_noise` ...

    Returns:
        The function of (map, keys `[n]`) that brax calls; its answer is a map for each key.

    Raises:
        ValueError: no map, an unknown constant, or limits that are not finite and in order.

    Example:
        >>> from jaxsnn import scenarios
        >>> draw = map_randomization([scenarios.scenario(i) for i in (1, 2)], speed=(10.0, 20.0))
        >>> found, _ = draw(scenarios.scenario(1), jax.random.split(jax.random.PRNGKey(0), 3))
        >>> found.speed.shape
        (3,)
    """
    stacked = stack_maps(maps)
    scalars = [name for name, leaf in stacked._asdict().items() if np.ndim(leaf) == 1]
    for name, limits in ranges.items():
        require(
            name in scalars,
            f"{name}={limits}: expected a scalar of WorldParams; choose from {', '.join(scalars)}",
        )
        low, high = limits
        require(
            bool(np.isfinite([low, high]).all()) and low <= high,
            f"{name}={limits}: expected two finite limits, the lower one first; put them in order",
        )

    def draw(key: Array) -> world.WorldParams:
        first, *others = jax.random.split(typed_key(key), 1 + len(ranges))
        which = jax.random.randint(first, (), 0, len(maps))
        drawn = {
            name: jax.random.uniform(one, (), minval=low, maxval=high)
            for one, (name, (low, high)) in zip(others, ranges.items(), strict=True)
        }
        return jax.tree.map(lambda leaf: leaf[which], stacked)._replace(**drawn)

    def randomize(
        sys: world.WorldParams, rng: Array
    ) -> tuple[world.WorldParams, world.WorldParams]:
        del sys  # brax's argument: all that an environment has comes from the drawn map.
        found = jax.vmap(draw)(rng)
        return found, jax.tree.map(lambda _: 0, found)

    return randomize


def wrap_for_training(
    env: Env,
    episode_length: int = 200,
    action_repeat: int = 1,
    randomization_fn: Callable[..., Any] | None = None,
) -> Wrapper:
    """Vmap, episode limit and fresh resets; pass it as `wrap_env_fn` to brax's learners.

    Args:
        env: a `NavigationEnv`.
        episode_length: control steps after which an episode is over.
        action_repeat: control steps per action.
        randomization_fn: of `map_randomization`; brax's learners bind its keys. Each environment
            keeps its map for the whole run, as brax has it.
    """
    batched = (
        VmapWrapper(env)
        if randomization_fn is None
        else DomainRandomizationVmapWrapper(env, randomization_fn)
    )
    return FreshResetWrapper(EpisodeWrapper(batched, episode_length, action_repeat))


def _device_put_replicated(x: Any, devices: Sequence[jax.Device]) -> Any:
    """A copy for each device along a new leading axis, as `pmap` takes it."""
    n = len(devices)
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (n, *jnp.shape(a))), x)


@contextlib.contextmanager
def brax_compatibility() -> Iterator[None]:
    """Lend jax the function that brax 0.14.2's PPO and SAC call and that jax 0.10 has dropped.

    >>> with brax_compatibility():  # doctest: +SKIP
    ...     brax.training.agents.ppo.train.train(env, wrap_env_fn=wrap_for_training, ...)
    """
    # An attribute lookup on jax raises for what it has dropped, so look in the module's own names.
    missing = "device_put_replicated" not in vars(jax)
    if missing:
        jax.device_put_replicated = _device_put_replicated
    try:
        yield
    finally:
        if missing:
            del jax.device_put_replicated
