"""Weights under a reward: what a window leaves in the synapses, and how the rule uses it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn._checks import require
from jaxsnn.config import NetworkConfig, NetworkParams, Weights, neuron_signs, weight_bounds
from jaxsnn.mirror import tied
from jaxsnn.plasticity import apply_reward
from jaxsnn.rewards import synapse_signs


class Eligibility(NamedTuple):
    """What `reinforce` needs to know of a window.

    Attributes:
        hidden, output: time integral of `z` [mV], same shapes as `Weights`.
        hidden_count, output_count: spikes of each neuron.
        duration: of the window [s].
    """

    hidden: Float[Array, "n_in n_hidden"]
    output: Float[Array, "2 n_half"]
    hidden_count: Float[Array, " n_hidden"]
    output_count: Float[Array, "2"]
    duration: float | Array


def no_eligibility(weights: Weights, duration: float | Array) -> Eligibility:
    """That of a window without a spike, for these weights."""
    hidden, output = (jnp.zeros_like(w) for w in weights)
    return Eligibility(hidden, output, hidden[0], output[:, 0], duration)


def reinforce(
    config: NetworkConfig,
    params: NetworkParams,
    weights: Weights,
    eligibility: Eligibility,
    reward: Float[Array, "2"],
    active: float | Float[Array, ""] = 1.0,
) -> Weights:
    r"""Change the weights by a reward held over the window that the eligibility is from.

    .. math:: d_{ij} = \gamma\, s_{ij}\, r_{motor} \int z_{ij}\,dt, \qquad
              h_i = \eta \int (1 - \nu_i / \nu^*)\,dt

    `d` goes through the rule (`plasticity.apply_reward`); with homeostasis `eta > 0` weights are
    scaled by :math:`e^{s_{pre} h_i}` before, `nu` being the rate of the neuron they lead to.

    Args:
        config: NetworkConfig.
        params: NetworkParams.
        weights: Weights.
        eligibility: of the window, from `window`.
        reward: for the synapses of the left and of the right motor, `[2]`.
        active: 0. to leave the weights as they are, else 1.

    Returns:
        The new weights, inside their bounds.

    Raises:
        ValueError: `reward` is not one number for each motor.

    Source:
        Shim (2020), Eq. 2.3 or 2.8 with the sign adjustment of section 2.3.2. Homeostasis is ours.
    """
    require(
        jnp.shape(reward) == (2,),
        f"reward=<shape {jnp.shape(reward)}>: expected (2,), the left and the right motor's; give "
        "one number to both with jnp.full(2, r)",
    )
    dtype = weights.hidden.dtype
    sign_pre, sign_hidden = (jnp.asarray(s, dtype) for s in neuron_signs(config))
    to_first, to_second = synapse_signs(sign_pre, sign_hidden)
    gamma, eta = active * params.gamma, active * params.homeostasis
    # A product, so that the reward is worked out once and not anew for every synapse.
    halves = jnp.repeat(jnp.eye(2, dtype=dtype), config.n_half, axis=1)
    by_neuron = gamma * (reward @ halves)
    drives = Weights(
        hidden=to_first * by_neuron[None, :] * eligibility.hidden,
        output=(params.gamma_output * to_second * by_neuron).reshape(2, -1) * eligibility.output,
    )
    short_hidden = eta * (eligibility.duration - eligibility.hidden_count / params.rate_hidden)
    short_output = (eta * params.homeostasis_output) * (
        eligibility.duration - eligibility.output_count / params.rate_output
    )
    either = jnp.exp(jnp.stack([short_hidden, -short_hidden]))
    scaled = Weights(
        hidden=weights.hidden * jnp.where(sign_pre[:, None] > 0, either[0], either[1]),
        output=weights.output * jnp.exp(short_output[:, None] * sign_hidden.reshape(2, -1)),
    )
    bounds = weight_bounds(config, params)
    changed = Weights(
        *(
            apply_reward(w, d, params.w_min, top, rule=config.rule, bounds=config.bounds)
            for w, d, top in zip(scaled, drives, bounds, strict=True)
        )
    )
    if config.mirror:
        changed = tied(config, changed)
    return jax.tree.map(lambda new, old: new.astype(old.dtype), changed, weights)
