"""The pair of functions with gymnax's signatures, against the environment of PPO."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxsnn import maps, navigation, scenarios

MAP = scenarios.scenario(1)
LIMIT = 4


def test_the_gymnax_pair_is_the_environment_with_fresh_starts() -> None:
    """Three robots, eight steps: the limit of four ends an episode, the next begins at once."""
    pair = navigation.gymnax_pair(max_steps=LIMIT)
    env = navigation.navigation_env(MAP, max_steps=LIMIT)
    reset = jax.jit(jax.vmap(pair.reset, in_axes=(0, None)))
    step = jax.jit(jax.vmap(pair.step, in_axes=(0, 0, 0, None)))
    plain_reset, plain_step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    keys = jax.random.split(jax.random.key(0), (9, 3))
    actions = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (8, 3, 1)), jnp.float32)

    obs, state = reset(keys[0], MAP)
    expected, first = plain_reset(keys[0])
    np.testing.assert_allclose(obs, first, rtol=1e-6, atol=1e-6)
    ends = []
    for key, action in zip(keys[1:], actions, strict=True):
        obs, state, reward, done, info = step(key, state, action, MAP)
        made = plain_step(expected, action)
        np.testing.assert_allclose(reward, made.reward, rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(done, made.terminated | made.truncated)
        np.testing.assert_array_equal(info["truncated"], made.truncated)
        np.testing.assert_array_equal(info["discount"], np.where(made.terminated, 0.0, 1.0))
        expected, seen = made.state, made.obs
        if bool(done.any()):
            assert bool(done.all())
            expected, seen = plain_reset(key)
        np.testing.assert_allclose(obs, seen, rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(state.robot.t, expected.robot.t)
        ends.append(bool(done.all()))
    assert ends == [False, False, False, True] * 2


def test_the_gymnax_pair_ends_at_the_target_and_takes_a_map_for_each_robot() -> None:
    """A robot that starts before its target arrives; the one on the other map drives on."""
    near, far = (
        maps.make_map(target=(x, 300), starts=[(100, 300, 5)], heading_spread=0.0)
        for x in (150, 700)
    )
    pair = navigation.gymnax_pair()
    places = maps.stack_maps([near, far])
    raw = jax.random.split(jax.random.PRNGKey(0), 2)
    _, state = jax.vmap(pair.reset)(raw, places)
    obs, state, reward, done, info = jax.jit(jax.vmap(pair.step))(
        raw, state, jnp.zeros((2, 1)), places
    )
    assert done.tolist() == info["arrived"].tolist() == [True, False]
    assert info["discount"].tolist() == [0.0, 1.0] and float(reward[0]) > 2.0
    assert state.robot.t.tolist() == [0, 1] and obs.shape == (2, 8)
