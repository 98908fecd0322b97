"""The dynamics of the networks S1-S4: input groups, a hidden layer in two halves, two motors.

Weights are magnitudes; the sign of a synapse is that of its presynaptic neuron (Dale's law), a
fixed vector. Hidden neurons come in two halves, the left motor's first; in each half the excitatory
ones come first. Two forms of the same dynamics: `step` (1 ms, weights change in every step: the
definition) and `window` with `reinforce` (weights held for a window, matrix products).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn import native
from jaxsnn._checks import require
from jaxsnn.config import (
    NetworkConfig,
    NetworkParams,
    Weights,
    network_config,
    network_params,
    neuron_signs,
)
from jaxsnn.network_state import NetworkState, Spikes, check_weights, init, reset_membranes
from jaxsnn.neurons import LIFState, lif_step
from jaxsnn.plasticity import STDPState, stdp_step
from jaxsnn.reinforcement import Eligibility, reinforce
from jaxsnn.running_mean import Baseline, baseline_update
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
    "remember",
    "reset_membranes",
    "step",
    "window",
]


def _check_inputs(config: NetworkConfig, pre: Array, *lead: str) -> None:
    """Refuse input spikes of another width, or with other axes before it than `lead`."""
    shape = jnp.shape(pre)
    expected = ", ".join([*lead, str(config.n_in)]) + ("" if lead else ",")
    require(
        len(shape) == len(lead) + 1 and shape[-1] == config.n_in,
        f"pre=<shape {shape}>: expected ({expected}), a column for each input neuron of the config "
        "(n_in); make the spikes for this config, and vmap over robots",
    )


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

    Raises:
        ValueError: `pre` or `reward` has another shape.
    """
    _check_inputs(config, pre)
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
    """Run the neurons over the rows of `pre` with the weights held and no plasticity.

    Raises:
        ValueError: `pre` has another shape.
    """
    _check_inputs(config, pre, "steps")
    sign_pre, _ = neuron_signs(config)
    if config.engine == "native":
        native.check(state.weights.hidden)
        (hidden, output), *fired = native.fire(
            (params.hidden, params.output), (state.hidden, state.output), state.weights.hidden,
            _signed_output(config, params, state.weights), jnp.asarray(sign_pre),
            params.gain_input, pre, dt=config.dt,
        )  # fmt: skip
        return state._replace(hidden=hidden, output=output), Spikes(*fired)
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

    Raises:
        ValueError: `pre` has another shape.
    """
    state, spikes = fire(config, params, state, pre)
    return *remember(config, params, stdp, state, pre, spikes, keep), spikes


def _by_products(
    config: NetworkConfig,
    params: NetworkParams,
    stdp: STDPKernel,
    state: NetworkState,
    pre: Array,
    spikes: Spikes,
    keep: float | Array,
) -> tuple[STDPState, STDPState, Array, Array]:
    """Traces and integrals of the eligibility of both layers after a window."""
    inputs, hidden = _centred(params, state, pre, spikes.hidden)
    stdp_hidden, first = stdp_window(stdp, state.stdp_hidden, inputs, spikes.hidden, keep)
    stdp_output, second = jax.vmap(stdp_window, in_axes=(None, 0, 1, 1, None))(
        stdp,
        state.stdp_output,
        hidden.reshape(-1, 2, config.n_half),
        spikes.output[:, :, None],
        keep,
    )
    return stdp_hidden, stdp_output, first, second


def remember(
    config: NetworkConfig,
    params: NetworkParams,
    stdp: STDPKernel,
    state: NetworkState,
    pre: Float[Array, "t n_in"],
    spikes: Spikes,
    keep: float | Float[Array, ""] = 1.0,
) -> tuple[NetworkState, Eligibility]:
    """What the spikes of a window, of the inputs and from `fire`, leave in the synapses.

    Returns:
        The state with new traces and running means, and the eligibility of the window.

    Raises:
        ValueError: `pre` has another shape.
    """
    _check_inputs(config, pre, "steps")
    if config.engine == "native":
        stdp_hidden, stdp_output, first, second = native.remember(
            params.stdp, (state.stdp_hidden, state.stdp_output), pre, *spikes,
            (params.centring * state.baseline_input.mean,
             params.centring * state.baseline_hidden.mean), keep, dt=config.dt,
        )  # fmt: skip
    else:
        stdp_hidden, stdp_output, first, second = _by_products(
            config, params, stdp, state, pre, spikes, keep
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
    return state, eligibility
