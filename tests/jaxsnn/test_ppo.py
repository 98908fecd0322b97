"""PPO: advantages in closed form, problems with known answers, and the robot world."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import actor_critic, navigation, ppo, ppo_config, scenarios


def test_advantages_in_closed_form() -> None:
    def advantages(terminated: list[bool], ended: list[bool]) -> jax.Array:
        return ppo.gae(
            jnp.asarray([1.0, 1.0, 1.0]),
            jnp.asarray([0.5, 0.5, 0.5]),
            jnp.asarray([0.5, 2.0, 0.5]),
            jnp.asarray(terminated),
            jnp.asarray(ended),
            discount=0.9,
            gae_lambda=0.5,
        )

    last = 1.0 + 0.45 - 0.5
    middle = 1.0 + 1.8 - 0.5
    first = 1.0 + 0.45 - 0.5
    no = [False] * 3
    np.testing.assert_allclose(
        advantages(no, no),
        [first + 0.45 * (middle + 0.45 * last), middle + 0.45 * last, last],
        rtol=1e-6,
    )
    # Cut off: the sum stops, the value of what follows counts. Terminated: it does not count.
    cut = [False, True, False]
    np.testing.assert_allclose(
        advantages(no, cut), [first + 0.45 * middle, middle, last], rtol=1e-6
    )
    np.testing.assert_allclose(advantages(cut, cut), [first + 0.45 * 0.5, 0.5, last], rtol=1e-6)


def _hit_the_mark(discount_steps: int) -> ppo.Env:
    """Reward 1 - (a - obs)^2 in each step; episodes of a few steps. Best action: a = obs."""

    def draw(key: jax.Array) -> jax.Array:
        return jax.random.uniform(key, (1,), minval=-1.0, maxval=1.0)

    def reset(key: jax.Array) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        obs = draw(key)
        return (obs, jnp.zeros((), jnp.int32)), obs

    def step(state: tuple[jax.Array, jax.Array], action: jax.Array) -> ppo_config.Transition:
        obs, t = state
        last = t + 1 >= discount_steps
        return ppo_config.Transition(
            (obs, t + 1), obs, 1.0 - jnp.sum((action - obs) ** 2), last, jnp.zeros((), bool), last
        )

    return ppo.Env(reset, step, action_size=1)


@pytest.mark.relaxed  # optax mixes int and float in the bias correction of Adam
def test_it_finds_the_known_best_action_and_value() -> None:
    config = ppo.PPOConfig(n_envs=16, n_steps=16, n_updates=80, hidden=(32,))
    params = ppo.PPOParams(learning_rate=5e-3, discount=0.5)
    env = _hit_the_mark(2)
    result = jax.jit(ppo.make_train(config, env))(params, key=jax.random.key(0))
    obs = jnp.linspace(-0.9, 0.9, 7)[:, None]
    action = jax.vmap(lambda o: ppo.act(config, env, result.weights, o))(obs)
    np.testing.assert_allclose(action, obs, atol=0.15)
    # The observation does not tell the two steps of an episode apart: the value that fits both is
    # the mean of (1 + 0.5) and 1 times the reward, less the exploration that is left.
    value = jax.vmap(lambda o: actor_critic.actor_critic(config, env).apply(result.weights, o)[2])(
        obs
    )
    reward = float(result.metrics.reward[-10:].mean())
    assert reward > 0.85
    np.testing.assert_allclose(value.mean(), 1.25 * reward, atol=0.1)
    # Every episode has two steps: 16 x 16 transitions hold 128 of them.
    np.testing.assert_array_equal(result.metrics.episodes, 128)
    assert result.metrics.entropy[-1] < result.metrics.entropy[0]


@pytest.mark.slow
@pytest.mark.relaxed  # optax, as above
def test_robots_learn_to_arrive_in_scenario_1() -> None:
    config = ppo.PPOConfig(n_envs=8, n_steps=64, n_updates=40)
    env = navigation.navigation_env(scenarios.scenario(1), max_steps=100)

    @jax.jit
    def run(key: jax.Array) -> tuple[ppo.Rollout, jax.Array, jax.Array]:
        result = ppo.make_train(config, env)(ppo.PPOParams(), key=key)
        keys = jax.random.split(jax.random.key(9), 50)
        state, success, terminated = ppo.evaluate(
            config, env, result.weights, keys=keys, max_steps=100
        )
        return result.metrics, success & terminated, state.length

    metrics, success, length = run(jax.random.key(0))
    early = metrics.successes[:3].sum() / metrics.episodes[:3].sum()
    assert early < 0.6
    assert success.mean() > 0.9
    assert length[success].max() < 100 * 15.0
    assert length[success].min() > 200.0  # the start circles are no nearer than that


def test_sizes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="n_minibatches=5: expected a divisor of n_envs"):
        ppo.PPOConfig(n_envs=3, n_steps=4, n_minibatches=5)
    with pytest.raises(ValueError, match="n_envs=0"):
        ppo.PPOConfig(n_envs=0)
    with pytest.raises(ValueError, match="learning_rate=-1"):
        ppo.check_ppo(ppo.PPOParams(learning_rate=-1.0))
    with pytest.raises(ValueError, match="max_steps=0"):
        navigation.navigation_env(scenarios.scenario(1), max_steps=0)
