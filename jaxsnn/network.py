"""The dynamics of the networks S1-S4: input groups, a hidden layer in two halves, two motors.

Weights are magnitudes; the sign of a synapse is that of its presynaptic neuron (Dale's law), a
fixed vector. Hidden neurons come in two halves, the left motor's first; in each half the excitatory
ones come first. Two forms of the same dynamics: `step` (1 ms, weights change in every step: the
definition) and `window` with `reinforce` (weights held for a window, matrix products).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxsnn._checks import default_float, require, require_key
from jaxsnn.config import (
    NetworkConfig,
    NetworkParams,
    Weights,
    check_network,
    network_config,
    network_params,
    neuron_signs,
    weight_bounds,
)
from jaxsnn.neurons import LIFParams, LIFState, lif_init, lif_step
from jaxsnn.plasticity import STDPState, apply_reward, check_bounds, stdp_init, stdp_step
from jaxsnn.rewards import synapse_signs
from jaxsnn.running_mean import Baseline, baseline_init, baseline_update
from jaxsnn.window import STDPKernel, stdp_kernel, stdp_window

__all__ = [
    "Eligibility",
    "NetworkConfig",
    "NetworkParams",
    "NetworkState",
    "Spikes",
    "Weights",
    "check_weights",
    "fire",
    "init",
    "kernel",
    "network_config",
    "network_params",
    "reinforce",
    "reset_membranes",
    "step",
    "window",
]


class NetworkState(NamedTuple):
    """Weights, membranes of both layers, traces and eligibility of both sets of synapses.

    The baselines are running means of what input and hidden neurons fire; see `running_mean`.
    `recent_turn` is a leaky mean of the robot's turns in this trial [deg], `updates` the number of
    control steps in which the network has learnt.
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
            u = jax.random.uniform(k, shape)
            drawn.append((params.init_low + (1.0 - params.init_low) * u) * bound)
        weights = Weights(*drawn)
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


def _centred(params: NetworkParams, state: NetworkState, pre: Array, hidden: Array) -> tuple:
    """Spikes `[..., n]` of both presynaptic sides, less their running means."""

    def less(spikes: Array, baseline: Baseline) -> Array:
        return spikes - jnp.broadcast_to(params.centring * baseline.mean, spikes.shape)

    return less(pre, state.baseline_input), less(hidden, state.baseline_hidden)


def _update_baselines(
    params: NetworkParams, state: NetworkState, pre: Array, hidden: Array, duration: float
) -> tuple[Baseline, Baseline]:
    """Both baselines after `duration` with these mean spikes per step."""
    tau = params.tau_baseline
    return (
        baseline_update(state.baseline_input, pre, tau=tau, duration=duration),
        baseline_update(state.baseline_hidden, hidden, tau=tau, duration=duration),
    )


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


def _fire(
    config: NetworkConfig,
    params: NetworkParams,
    hidden: LIFState,
    output: LIFState,
    jump: Float[Array, " n_hidden"],
    signed_output: Float[Array, "2 n_half"],
) -> tuple[LIFState, LIFState, Spikes]:
    """One step of both layers of neurons, given what the inputs add to the hidden layer."""
    hidden, fired = lif_step(params.hidden, hidden, 0.0, jump, dt=config.dt)
    spikes = fired.astype(hidden.v.dtype)
    to_motor = jnp.sum(signed_output * spikes.reshape(2, config.n_half), axis=1)
    output, motor = lif_step(params.output, output, 0.0, to_motor, dt=config.dt)
    return hidden, output, Spikes(hidden=spikes, output=motor.astype(output.v.dtype))


def step(
    config: NetworkConfig,
    params: NetworkParams,
    state: NetworkState,
    pre: Float[Array, " n_in"],
    reward: Float[Array, "2"],
) -> tuple[NetworkState, Spikes]:
    r"""One step of `dt`: neurons, traces, eligibility, and the weights under a reward.

    .. math:: \dot w = \gamma\, s\, r_{motor}\, z \quad (\text{times } w \text{ if multiplicative})

    with `s` the synapse's sign product (`rewards.synapse_signs`).

    Args:
        config: NetworkConfig.
        params: NetworkParams.
        state: NetworkState.
        pre: input spikes of this step, 0. or 1., `[n_in]`.
        reward: for the synapses of the left and of the right motor, `[2]`.

    Returns:
        The new state and the spikes of this step.
    """
    sign_pre, _ = neuron_signs(config)
    weights = state.weights
    jump = params.gain_input * ((pre * sign_pre) @ weights.hidden)
    hidden, output, spikes = _fire(
        config, params, state.hidden, state.output, jump, _signed_output(config, params, weights)
    )
    first, second = _centred(params, state, pre, spikes.hidden)
    stdp_hidden = stdp_step(params.stdp, state.stdp_hidden, first, spikes.hidden, dt=config.dt)
    stdp_output = jax.vmap(lambda s, x, y: stdp_step(params.stdp, s, x, y, dt=config.dt))(
        state.stdp_output, second.reshape(2, -1), spikes.output[:, None]
    )
    baselines = _update_baselines(params, state, pre, spikes.hidden, config.dt)
    eligibility = Eligibility(
        hidden=stdp_hidden.z * config.dt,
        output=stdp_output.z[..., 0] * config.dt,
        hidden_count=spikes.hidden,
        output_count=spikes.output,
        duration=config.dt,
    )
    weights = reinforce(config, params, weights, eligibility, reward)
    state = state._replace(
        weights=weights,
        hidden=hidden,
        output=output,
        stdp_hidden=stdp_hidden,
        stdp_output=stdp_output,
        baseline_input=baselines[0],
        baseline_hidden=baselines[1],
    )
    return state, spikes


def _signed_output(config: NetworkConfig, params: NetworkParams, weights: Weights) -> Array:
    _, sign_hidden = neuron_signs(config)
    return params.gain_output * weights.output * sign_hidden.reshape(2, config.n_half)


def kernel(config: NetworkConfig, params: NetworkParams) -> STDPKernel:
    """The pair kernel for windows of `config.hold_steps`."""
    return stdp_kernel(params.stdp, config.hold_steps, dt=config.dt)


def fire(
    config: NetworkConfig, params: NetworkParams, state: NetworkState, pre: Float[Array, "t n_in"]
) -> tuple[NetworkState, Spikes]:
    """Run the neurons over the rows of `pre` with the weights held and no plasticity."""
    sign_pre, _ = neuron_signs(config)
    jumps = params.gain_input * ((pre * sign_pre[None, :]) @ state.weights.hidden)
    signed_output = _signed_output(config, params, state.weights)

    # Only the membranes go round the loop: synapses in the carry would be copied.
    def body(
        carry: tuple[LIFState, LIFState], jump: Array
    ) -> tuple[tuple[LIFState, LIFState], Spikes]:
        hidden, output, spikes = _fire(config, params, *carry, jump, signed_output)
        return (hidden, output), spikes

    (hidden, output), spikes = jax.lax.scan(body, (state.hidden, state.output), jumps)
    return state._replace(hidden=hidden, output=output), spikes


def window(
    config: NetworkConfig,
    params: NetworkParams,
    stdp: STDPKernel,
    state: NetworkState,
    pre: Float[Array, "t n_in"],
    keep: float | Float[Array, ""] = 1.0,
) -> tuple[NetworkState, Eligibility, Spikes]:
    """All steps of a window with the weights held: currents and traces as matrix products.

    Args:
        config: NetworkConfig.
        params: NetworkParams.
        stdp: `kernel(config, params)`, for as many steps as `pre` has rows.
        state: NetworkState.
        pre: input spikes, 0. or 1., `[T, n_in]`.
        keep: 0. to forget traces and eligibility from before the window, else 1.

    Returns:
        The state with the weights as they were, the eligibility of the window for `reinforce`, and
        all spikes.
    """
    state, spikes = fire(config, params, state, pre)
    inputs, hidden = _centred(params, state, pre, spikes.hidden)
    stdp_hidden, first = stdp_window(stdp, state.stdp_hidden, inputs, spikes.hidden, keep)
    stdp_output, second = jax.vmap(stdp_window, in_axes=(None, 0, 1, 1, None))(
        stdp,
        state.stdp_output,
        hidden.reshape(-1, 2, config.n_half),
        spikes.output[:, :, None],
        keep,
    )
    duration = pre.shape[0] * config.dt
    rates = pre.mean(axis=0), spikes.hidden.mean(axis=0)
    baselines = _update_baselines(params, state, *rates, duration)
    state = state._replace(
        stdp_hidden=stdp_hidden,
        stdp_output=stdp_output,
        baseline_input=baselines[0],
        baseline_hidden=baselines[1],
    )
    eligibility = Eligibility(
        hidden=first,
        output=second[..., 0],
        hidden_count=jnp.sum(spikes.hidden, axis=0),
        output_count=jnp.sum(spikes.output, axis=0),
        duration=duration,
    )
    return state, eligibility, spikes


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

    Source:
        Shim (2020), Eq. 2.3 or 2.8 with the sign adjustment of section 2.3.2. Homeostasis is ours.
    """
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
    scaled = Weights(
        hidden=weights.hidden
        * jnp.where(
            sign_pre[:, None] > 0, jnp.exp(short_hidden)[None], jnp.exp(-short_hidden)[None]
        ),
        output=weights.output * jnp.exp(short_output[:, None] * sign_hidden.reshape(2, -1)),
    )
    bounds = weight_bounds(config, params)
    changed = Weights(
        *(
            apply_reward(w, d, params.w_min, top, rule=config.rule, bounds=config.bounds)
            for w, d, top in zip(scaled, drives, bounds, strict=True)
        )
    )
    return jax.tree.map(lambda new, old: new.astype(old.dtype), changed, weights)
