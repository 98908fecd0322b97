"""What a network S1-S4 carries from step to step, and how it begins."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxsnn._checks import default_float, require, require_key
from jaxsnn.config import NetworkConfig, NetworkParams, Weights, check_network, weight_bounds
from jaxsnn.critic import Critic, critic_init
from jaxsnn.mirror import tied
from jaxsnn.neurons import LIFParams, LIFState, lif_init
from jaxsnn.plasticity import STDPState, check_bounds, stdp_init
from jaxsnn.running_mean import Baseline, baseline_init


class NetworkState(NamedTuple):
    """Weights, membranes of both layers, traces and eligibility of both sets of synapses.

    The baselines are running means of what input and hidden neurons fire; see `running_mean`.
    `recent_turn` is a leaky mean of the robot's turns in this trial [deg], `updates` the number of
    control steps in which the network has learnt, `critic` its value of what it senses.
    """

    weights: Weights
    hidden: LIFState
    output: LIFState
    stdp_hidden: STDPState
    stdp_output: STDPState
    baseline_input: Baseline
    baseline_hidden: Baseline
    recent_turn: Float[Array, ""]
    updates: Float[Array, ""]
    critic: Critic | None = None


class Spikes(NamedTuple):
    """Spikes of the hidden and of the motor neurons, 0. or 1., with or without a leading time."""

    hidden: Float[Array, "*t n_hidden"]
    output: Float[Array, "*t 2"]


def init(
    key: Key[Array, ""],
    config: NetworkConfig,
    params: NetworkParams,
    weights: Weights | None = None,
) -> NetworkState:
    """A network at rest with random weights, uniform between 0 (`init_low`) and their bounds.

    Args:
        key: typed PRNG key.
        config: NetworkConfig.
        params: NetworkParams.
        weights: take these instead of random ones; they must lie inside the bounds.

    Raises:
        ValueError: a constant or a given weight is not acceptable.
    """
    require_key(key)
    check_network(config, params)
    top = weight_bounds(config, params)
    shapes = (config.n_in, config.n_hidden), (2, config.n_half)
    if weights is None:
        keys = jax.random.split(key)
        drawn = []
        for k, shape, bound in zip(keys, shapes, top, strict=True):
            u = jax.random.uniform(k, (math.prod(shape),)).reshape(shape)
            drawn.append((params.init_low + (1.0 - params.init_low) * u) * bound)
        weights = tied(config, Weights(*drawn)) if config.mirror else Weights(*drawn)
    else:
        check_weights(config, params, weights)
    return NetworkState(
        weights=weights,
        hidden=lif_init(params.hidden, config.n_hidden),
        output=lif_init(params.output, 2),
        stdp_hidden=stdp_init(config.n_in, config.n_hidden),
        stdp_output=jax.tree.map(
            lambda x: jnp.broadcast_to(x, (2, *x.shape)), stdp_init(config.n_half, 1)
        ),
        baseline_input=baseline_init(config.n_in),
        baseline_hidden=baseline_init(config.n_hidden),
        recent_turn=jnp.zeros((), default_float()),
        updates=jnp.zeros((), default_float()),
        critic=critic_init(config.n_groups) if config.critic == "td" else None,
    )


def check_weights(
    config: NetworkConfig, params: NetworkParams, weights: Weights, robots: int | None = None
) -> None:
    """Refuse weights that this network cannot begin with.

    Args:
        config: NetworkConfig.
        params: NetworkParams; bounds that are traced or differ between robots are not compared.
        weights: of one network, or with a leading axis of `robots`.

    Raises:
        ValueError: a shape does not fit, or a weight is not finite or outside the bounds.
    """
    lead = () if robots is None else (robots,)
    shapes = (*lead, config.n_in, config.n_hidden), (*lead, 2, config.n_half)
    for field, shape in zip(Weights._fields, shapes, strict=True):
        given = getattr(weights, field)
        require(
            given.shape == shape,
            f"weights.{field}=<shape {given.shape}>: expected {shape}; use the config that they "
            "were made with",
        )
    if any(jnp.ndim(getattr(params, name)) for name in ("w_min", "w_max", "w_max_low")):
        return
    for field, top in zip(Weights._fields, weight_bounds(config, params), strict=True):
        check_bounds(getattr(weights, field), params.w_min, top, f"weights.{field}")


def reset_membranes(
    params: NetworkParams, state: NetworkState, fresh: Bool[Array, ""]
) -> NetworkState:
    """Membranes at rest where `fresh` (a trial begins); traces are dropped by `window(keep=0)`."""

    def rest(lif: LIFParams, layer: LIFState) -> LIFState:
        return LIFState(
            v=jnp.where(fresh, lif.v_rest, layer.v),
            refractory=jnp.where(fresh, 0.0, layer.refractory),
        )

    return state._replace(
        hidden=rest(params.hidden, state.hidden), output=rest(params.output, state.output)
    )
