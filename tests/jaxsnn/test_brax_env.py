"""The world under brax: the contract of Env and State, brax's wrappers, ARS and PPO."""

from __future__ import annotations

import contextlib
import functools
import io
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import navigation, scenarios, world

# brax mixes dtypes and warns about its optional engines as it is imported.
pytestmark = [pytest.mark.relaxed, pytest.mark.filterwarnings("ignore")]

B = 4


@pytest.fixture(scope="module")
def brax_env() -> Any:
    import warnings

    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        from jaxsnn import brax_env

    return brax_env


@pytest.fixture(scope="module")
def env(brax_env: Any) -> Any:
    return brax_env.NavigationEnv(scenarios.scenario(1))


def test_states_keep_their_structure_under_scan(env: Any) -> None:
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    assert state.obs.shape == (env.observation_size,)
    assert state.done.dtype == state.reward.dtype == jnp.float32

    def body(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        state = env.step(state, action)
        return state, state.done

    last, done = jax.jit(lambda s: jax.lax.scan(body, s, jnp.zeros((40, 1))))(state)
    assert jax.tree.structure(last) == jax.tree.structure(state)
    assert set(np.unique(done)) <= {0.0, 1.0}


def test_env_agrees_with_the_world_and_with_our_own_env(env: Any) -> None:
    params = scenarios.scenario(1)
    key = jax.random.key(3)
    raw, typed = env.reset(jax.random.key_data(key)), env.reset(key)
    np.testing.assert_array_equal(raw.obs, typed.obs)
    own = navigation.navigation_env(params)
    state, obs = own.reset(key)
    np.testing.assert_allclose(raw.obs, obs)
    action = jnp.asarray([0.5])
    ours, theirs = own.step(state, action), env.step(raw, action)
    np.testing.assert_allclose(theirs.obs, ours.obs, rtol=1e-6)
    np.testing.assert_allclose(theirs.reward, ours.reward, rtol=1e-6)
    moved, _ = world.step(params, world.reset(params, key=key), 22.5)
    np.testing.assert_allclose(theirs.pipeline_state.robot.x, moved.x, rtol=1e-6)


@pytest.mark.slow
def test_brax_wrappers_run_and_reset(brax_env: Any, env: Any) -> None:
    from brax.envs import training

    keys = jax.random.split(jax.random.PRNGKey(1), B)
    starts = {}
    for name, wrapped in (
        ("brax", training.wrap(env, episode_length=5)),
        ("fresh", brax_env.wrap_for_training(env, episode_length=5)),
    ):
        first = jax.jit(wrapped.reset)(keys)

        def body(state: Any, _: None, wrapped: Any = wrapped) -> tuple[Any, Any]:
            state = wrapped.step(state, jnp.zeros((B, 1)))
            robot = state.pipeline_state.robot
            return state, (state.done, robot.x, robot.t, state.info["truncation"])

        _, (done, x, t, truncation) = jax.jit(lambda s, body=body: jax.lax.scan(body, s, None, 15))(
            first
        )
        # Three episodes of five steps, none near anything: all are cut off by their length.
        expected = np.zeros((15, B))
        expected[4::5] = 1.0
        np.testing.assert_array_equal(done, expected)
        np.testing.assert_array_equal(truncation, expected)
        assert (t[4::5] == 0).all()
        starts[name] = np.concatenate([np.asarray(first.pipeline_state.robot.x)[None], x[4::5]])
    assert (np.ptp(starts["brax"], axis=0) == 0).all()  # always the same start
    assert (np.ptp(starts["fresh"], axis=0) > 0).all()


@pytest.mark.slow
def test_every_environment_drives_on_a_map_of_its_own(brax_env: Any, env: Any) -> None:
    maps = [scenarios.scenario(number) for number in (1, 3)]
    draw = brax_env.map_randomization(maps, speed=(5.0, 10.0), sonar_noise=(0.0, 2.0))
    keys = jax.random.split(jax.random.PRNGKey(4), 32)
    wrapped = brax_env.wrap_for_training(
        env, episode_length=3, randomization_fn=functools.partial(draw, rng=keys)
    )
    first = jax.jit(wrapped.reset)(keys)
    drawn = first.pipeline_state.params
    targets = {tuple(np.asarray(target)) for target in drawn.target}
    assert targets == {tuple(np.asarray(one.target)) for one in maps}
    assert 5.0 <= drawn.speed.min() < 6.0 and 9.0 < drawn.speed.max() <= 10.0
    assert len(np.unique(drawn.sonar_noise)) == 32
    state, step = first, jax.jit(wrapped.step)
    for _ in range(4):  # one more than an episode
        before = state.pipeline_state.robot
        state = step(state, jnp.zeros((32, 1)))
        robot = state.pipeline_state.robot
        moved = np.hypot(robot.x - before.x, robot.y - before.y)
        np.testing.assert_allclose(moved[robot.t > 0], drawn.speed[robot.t > 0], rtol=1e-3)
    np.testing.assert_array_equal(state.pipeline_state.params.target, drawn.target)
    assert env.sys is env.params and env.params.speed.ndim == 0


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"sped": (1.0, 2.0)}, r"sped=.*expected a scalar of WorldParams; choose from .*speed"),
        ({"target": (1.0, 2.0)}, "target=.*expected a scalar"),
        ({"speed": (2.0, 1.0)}, "speed=.*the lower one first"),
        ({"speed": (1.0, float("inf"))}, "speed=.*two finite limits"),
    ],
)
def test_randomization_of_what_is_no_constant_is_refused(
    brax_env: Any, ranges: dict, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        brax_env.map_randomization([scenarios.scenario(1)], **ranges)


def test_the_shim_is_still_needed_and_leaves_no_trace(brax_env: Any) -> None:
    """When this fails, jax or brax has changed: drop `brax_compatibility`."""
    assert "device_put_replicated" not in vars(jax)
    with brax_env.brax_compatibility():
        out = jax.device_put_replicated({"a": jnp.arange(3)}, jax.local_devices()[:1])
        assert out["a"].shape == (1, 3)
    assert "device_put_replicated" not in vars(jax)

    import inspect

    from brax.training.agents.ppo import train

    assert "device_put_replicated" in inspect.getsource(train)


@pytest.mark.slow
def test_ars_of_brax_learns_what_driving_straight_on_does_not(brax_env: Any) -> None:
    from brax.training.agents.ars import train

    env = brax_env.NavigationEnv(scenarios.scenario(3))

    @jax.jit
    def straight_on(key: jax.Array) -> jax.Array:
        def body(carry: tuple, _: None) -> tuple[tuple, jax.Array]:
            state, under_way = carry
            state = env.step(state, jnp.zeros((1,)))
            return (state, under_way * (1.0 - state.done)), under_way * state.reward

        start = (env.reset(key), jnp.ones(()))
        return jnp.sum(jax.lax.scan(body, start, length=60)[1])

    idle = float(jax.vmap(straight_on)(jax.random.split(jax.random.key(0), 64)).mean())
    seen: list[float] = []
    train.train(
        env,
        wrap_env_fn=brax_env.wrap_for_training,
        num_timesteps=60_000,
        episode_length=60,
        number_of_directions=16,
        top_directions=8,
        step_size=0.1,
        exploration_noise_std=0.1,
        num_eval_envs=64,
        num_evals=2,
        progress_fn=lambda n, m: seen.append(float(m["eval/episode_reward"])),
    )
    assert seen[-1] > idle + 1.0, (seen, idle)


def shares_that_arrive(brax_env: Any, env: Any, **options: Any) -> list[float]:
    """Before and after a training of brax's PPO."""
    from brax.training.agents.ppo import train

    seen: list[float] = []
    with brax_env.brax_compatibility():
        train.train(
            env,
            wrap_env_fn=brax_env.wrap_for_training,
            num_timesteps=60_000,
            num_envs=32,
            batch_size=32,
            num_minibatches=4,
            unroll_length=20,
            learning_rate=1e-3,
            discounting=0.97,
            num_eval_envs=64,
            num_evals=2,
            progress_fn=lambda n, m: seen.append(float(m["eval/episode_arrived"])),
            **options,
        )
    return seen


@pytest.mark.slow
def test_ppo_of_brax_learns(brax_env: Any, env: Any) -> None:
    seen = shares_that_arrive(brax_env, env, episode_length=60)
    assert seen[-1] > 0.8  # share of 64 trials that arrive


@pytest.mark.slow
def test_ppo_of_brax_learns_on_several_maps_at_once(brax_env: Any, env: Any) -> None:
    maps = [scenarios.scenario(number) for number in (1, 2)]
    several = brax_env.map_randomization(maps, speed=(12.0, 15.0))
    seen = shares_that_arrive(brax_env, env, episode_length=80, randomization_fn=several)
    assert seen[-1] > max(0.6, seen[0] + 0.1), seen
