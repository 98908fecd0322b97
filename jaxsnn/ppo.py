"""Proximal policy optimization in one compiled program: the modern reference on the same world.

`make_train(config, env)` gives `train(params, key=key)`, a pure function: vmap it over seeds or
constants, jit it as a whole. Environments are pairs of pure functions (`Env`); `jaxsnn.navigation`
is the robot world as one. Robots that end a trial start the next one at once, from a fresh start.

>>> import jax
>>> from jaxsnn import navigation, ppo, scenarios
>>> env = navigation.navigation_env(scenarios.scenario(1))
>>> train = jax.jit(ppo.make_train(ppo.PPOConfig(n_updates=100), env))
>>> result = train(ppo.PPOParams(), key=jax.random.key(0))  # doctest: +SKIP
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key

from jaxsnn._checks import require_key, require_keys, require_whole
from jaxsnn.actor_critic import act, actor_critic, log_prob
from jaxsnn.ppo_config import Env, PPOConfig, PPOParams, check_ppo


class Rollout(NamedTuple):
    """Means over one update, leaves `[n_updates]` in the result of a training."""

    episodes: Array  # trials that ended
    successes: Array  # trials that ended well
    reward: Array  # mean reward of a step
    value_loss: Array
    policy_loss: Array
    entropy: Array
    kl: Array  # estimate of the divergence from the policy that acted
    clip_share: Array  # transitions at which the ratio was clipped


class Result(NamedTuple):
    """What `train` returns: weights of the two networks, and what happened in each update."""

    weights: Any
    metrics: Rollout


def gae(
    rewards: Float[Array, "t"],
    values: Float[Array, "t"],
    next_values: Float[Array, "t"],
    terminated: Array,
    ended: Array,
    *,
    discount: float | Float[Array, ""],
    gae_lambda: float | Float[Array, ""],
) -> Float[Array, "t"]:
    r"""Generalized advantage estimates of one stream of transitions.

    .. math:: \delta_t = r_t + \gamma V(s'_t) - V(s_t), \qquad
        A_t = \delta_t + \gamma \lambda A_{t+1}

    Symbols: :math:`\gamma` is `discount`, :math:`\lambda` is `gae_lambda`; :math:`V(s'_t)` is
    `next_values`, the value of the state that the action led to before any reset, and counts as 0
    where `terminated`; the sum stops where `ended`.

    Source: Schulman et al. (2016), Eq. 16.
    """
    alive = jnp.where(terminated, 0.0, 1.0).astype(rewards.dtype)
    going = jnp.where(ended, 0.0, 1.0).astype(rewards.dtype)
    delta = rewards + discount * alive * next_values - values

    def back(after: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        d, g = row
        here = d + discount * gae_lambda * g * after
        return here, here

    _, advantages = jax.lax.scan(back, jnp.zeros((), rewards.dtype), (delta, going), reverse=True)
    return advantages


def make_train(config: PPOConfig, env: Env) -> Callable[..., Result]:
    r"""PPO with the clipped objective, the whole run as one pure function.

    .. math:: L = \mathbb{E}\,\min(\rho A,\, \operatorname{clip}(\rho, 1 - c, 1 + c) A)
        - c_v\,(V - \hat R)^2 + c_e H, \qquad \rho = \pi(a|s) / \pi_{\text{old}}(a|s)

    Symbols: :math:`c` is `params.clip`, :math:`c_v` is `params.value_coef`, :math:`c_e` is
    `params.entropy_coef`; :math:`A` from `gae`, normalized over each minibatch.

    Args:
        config: sizes and choices.
        env: the environment, reset to a fresh start whenever an episode ends.

    Returns:
        `train(params, *, key) -> Result` with `PPOParams` and a typed key: network weights, and
        metrics with leaves `[n_updates]`.

    Source: Schulman et al. (2017), Eq. 7 and 9; one jit for the run as in PureJaxRL (Lu et al.,
        2022).
    """
    network = actor_critic(config, env)
    apply: Any = network.apply
    n_gradients = config.n_updates * config.n_epochs * config.n_minibatches

    def optimizer_of(params: PPOParams) -> optax.GradientTransformation:
        rate: Any = params.learning_rate
        if config.anneal:
            rate = optax.linear_schedule(rate, 0.0, n_gradients)
        return optax.chain(
            optax.clip_by_global_norm(params.max_grad_norm), optax.adam(rate, eps=1e-5)
        )

    def value_of(weights: Any, obs: Array) -> Array:
        return apply(weights, obs)[2]

    def robot_step(weights: Any, state: Any, obs: Array, key: Array) -> tuple[Any, Array, Any]:
        k_action, k_reset = jax.random.split(key)
        mean, log_std, value = apply(weights, obs)
        action = mean + jnp.exp(log_std) * jax.random.normal(k_action, mean.shape, mean.dtype)
        made = env.step(state, action)
        ended = made.terminated | made.truncated
        carry = jax.tree.map(
            lambda a, b: jnp.where(ended, a, b), env.reset(k_reset), (made.state, made.obs)
        )
        row = {
            "obs": obs,
            "action": action,
            "log_prob": log_prob(action, mean, log_std),
            "value": value,
            "next_value": value_of(weights, made.obs),
            "reward": made.reward,
            "terminated": made.terminated,
            "ended": ended,
            "success": made.success & ended,
        }
        return *carry, row

    def loss(
        weights: Any, params: PPOParams, batch: dict[str, Array]
    ) -> tuple[Array, dict[str, Array]]:
        mean, log_std, value = jax.vmap(lambda o: apply(weights, o))(batch["obs"])
        log_ratio = jax.vmap(log_prob)(batch["action"], mean, log_std) - batch["log_prob"]
        ratio = jnp.exp(log_ratio)
        gain = batch["advantage"]
        gain = (gain - jnp.mean(gain)) / (jnp.std(gain) + 1e-8)
        clipped = jnp.clip(ratio, 1.0 - params.clip, 1.0 + params.clip)
        policy_loss = -jnp.mean(jnp.minimum(ratio * gain, clipped * gain))
        value_loss = jnp.mean((value - batch["return"]) ** 2)
        entropy = jnp.mean(jnp.sum(log_std, axis=-1)) + 0.5 * env.action_size * math.log(
            2.0 * math.pi * math.e
        )
        total = policy_loss + params.value_coef * value_loss - params.entropy_coef * entropy
        return total, {
            "value_loss": value_loss,
            "policy_loss": policy_loss,
            "entropy": entropy,
            "kl": jnp.mean(ratio - 1.0 - log_ratio),
            "clip_share": jnp.mean(jnp.abs(ratio - 1.0) > params.clip),
        }

    def update(params: PPOParams, carry: tuple[Any, ...]) -> tuple[tuple[Any, ...], Rollout]:
        optimizer = optimizer_of(params)
        weights, moments, states, obs, key = carry

        def minibatch(
            carry: tuple[Any, Any], batch: dict[str, Array]
        ) -> tuple[tuple[Any, Any], Any]:
            weights, moments = carry
            grads, info = jax.grad(loss, has_aux=True)(weights, params, batch)
            updates, moments = optimizer.update(grads, moments, weights)
            return (optax.apply_updates(weights, updates), moments), info

        key, k_act, k_shuffle = jax.random.split(key, 3)

        def control_step(now: tuple[Any, Array], step_key: Array) -> tuple[Any, Any]:
            keys = jax.random.split(step_key, config.n_envs)
            states, obs, row = jax.vmap(robot_step, (None, 0, 0, 0))(weights, *now, keys)
            return (states, obs), row

        (states, obs), rows = jax.lax.scan(
            control_step, (states, obs), jax.random.split(k_act, config.n_steps)
        )
        advantage = jax.vmap(
            lambda *row: gae(*row, discount=params.discount, gae_lambda=params.gae_lambda),
            in_axes=1,
            out_axes=1,
        )(rows["reward"], rows["value"], rows["next_value"], rows["terminated"], rows["ended"])
        data = {name: rows[name] for name in ("obs", "action", "log_prob")}
        data |= {"advantage": advantage, "return": advantage + rows["value"]}
        total = config.n_envs * config.n_steps
        data = jax.tree.map(lambda a: a.reshape(total, *a.shape[2:]), data)

        def epoch(carry: tuple[Any, Any], k: Array) -> tuple[tuple[Any, Any], Any]:
            order = jax.random.permutation(k, total).reshape(config.n_minibatches, -1)
            return jax.lax.scan(minibatch, carry, jax.tree.map(lambda a: a[order], data))

        (weights, moments), info = jax.lax.scan(
            epoch, (weights, moments), jax.random.split(k_shuffle, config.n_epochs)
        )
        metrics = Rollout(
            episodes=jnp.sum(rows["ended"]),
            successes=jnp.sum(rows["success"]),
            reward=jnp.mean(rows["reward"]),
            **{name: jnp.mean(value) for name, value in info.items()},
        )
        return (weights, moments, states, obs, key), metrics

    def train(params: PPOParams, *, key: Key[Array, ""]) -> Result:
        require_key(key)
        check_ppo(params)
        k_init, k_reset, k_run = jax.random.split(key, 3)
        states, obs = jax.vmap(env.reset)(jax.random.split(k_reset, config.n_envs))
        weights = network.init(k_init, obs[0])
        carry = (weights, optimizer_of(params).init(weights), states, obs, k_run)
        carry, metrics = jax.lax.scan(
            lambda carry, _: update(params, carry), carry, None, config.n_updates
        )
        return Result(carry[0], metrics)

    return train


def evaluate(
    config: PPOConfig, env: Env, weights: Any, *, keys: Key[Array, "n"], max_steps: int
) -> tuple[Any, Array, Array]:
    """Episodes without exploration, frozen where they end.

    Args:
        config: the one that the parameters were trained with.
        env: the environment; path lengths make sense with a
            `jaxsnn.navigation.navigation_env`.
        weights: `Result.weights`.
        keys: one for each episode.
        max_steps: steps to scan; the environment's own limit or more.

    Returns:
        (final states, success `[n]`, terminated `[n]`).
    """
    require_keys(keys)
    require_whole("max_steps", max_steps, 1, "allow at least one control step")

    def one(key: Array) -> tuple[Any, Array, Array]:
        state, obs = env.reset(key)
        no = jnp.zeros((), bool)

        def body(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
            state, obs, success, terminated, over = carry
            made = env.step(state, act(config, env, weights, obs))
            state, obs = jax.tree.map(
                lambda a, b: jnp.where(over, a, b), (state, obs), (made.state, made.obs)
            )
            success = success | (made.success & ~over)
            terminated = terminated | (made.terminated & ~over)
            return (state, obs, success, terminated, over | made.terminated | made.truncated), None

        carry, _ = jax.lax.scan(body, (state, obs, no, no, no), None, max_steps)
        return carry[0], carry[2], carry[3]

    return jax.vmap(one)(keys)
