"""Policy and value of PPO as two networks, and what they say of an action."""

from __future__ import annotations

import math
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn.ppo_config import Env, PPOConfig


class ActorCritic(nn.Module):
    """Two tanh networks: mean and log deviation of a Gaussian action, and the value."""

    action_size: int
    hidden: tuple[int, ...]
    initial_std: float

    @nn.compact
    def __call__(self, obs: Array) -> tuple[Array, Array, Array]:
        """Mean `[a]`, log deviation `[a]`, value `[]`."""

        def tower(size: int, scale: float) -> Array:
            x = obs
            for width in self.hidden:
                x = nn.tanh(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2**0.5))(x))
            return nn.Dense(size, kernel_init=nn.initializers.orthogonal(scale))(x)

        log_std = self.param(
            "log_std", nn.initializers.constant(math.log(self.initial_std)), (self.action_size,)
        )
        return tower(self.action_size, 0.01), log_std, tower(1, 1.0)[..., 0]


def actor_critic(config: PPOConfig, env: Env) -> ActorCritic:
    """The two networks for the sizes of `config` and the actions of `env`."""
    return ActorCritic(env.action_size, config.hidden, config.initial_std)


def log_prob(action: Array, mean: Array, log_std: Array) -> Array:
    """Log density of an action `[a]` under a Gaussian, `[]`."""
    z = (action - mean) * jnp.exp(-log_std)
    return jnp.sum(-0.5 * z**2 - log_std - 0.5 * math.log(2.0 * math.pi))


def act(config: PPOConfig, env: Env, weights: Any, obs: Float[Array, "o"]) -> Float[Array, "a"]:
    """The action without exploration: the mean of the policy."""
    apply: Any = actor_critic(config, env).apply
    return apply(weights, obs)[0]
