"""The two calls of `window.cc` as JAX functions, for one network and under `jax.vmap`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn._checks import require
from jaxsnn.native.compiling import register
from jaxsnn.neurons import LIFParams, LIFState
from jaxsnn.plasticity import STDPParams, STDPState, Traces


def check(*arrays: Array) -> None:
    """Refuse what the calls are not for.

    Raises:
        ValueError: an array is not float32, or jax does not run on a CPU.
    """
    require(
        jax.default_backend() == "cpu",
        f"engine='native': expected a CPU, jax runs on {jax.default_backend()}; take engine='xla'",
    )
    for array in arrays:
        require(
            array.dtype == jnp.float32,
            f"engine='native': expected float32 states and constants, got {array.dtype}; take "
            "engine='xla' under x64",
        )


def _call(
    name: str, shapes: list[tuple[int, ...]], *arguments: Array, in_place: dict[int, int]
) -> list[Array]:
    """All robots of a `vmap` in one call; some arguments' memory is that of results."""
    check(*arguments)
    register()
    results = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    call = jax.ffi.ffi_call(
        name, results, vmap_method="broadcast_all", input_output_aliases=in_place
    )
    return list(call(*arguments))


def _pack(*values: Any) -> Array:
    """Constants as one vector.

    Raises:
        ValueError: one differs between neurons.
    """
    for value in values:
        require(
            jnp.ndim(value) == 0,
            f"engine='native': expected one constant for a whole layer, got {jnp.shape(value)} of "
            "them; take engine='xla'",
        )
    return jnp.stack([jnp.asarray(v, jnp.result_type(float)) for v in values])


def _layer(lif: LIFParams, dt: float) -> tuple[Any, ...]:
    """Leak per step, potentials, refractory time in whole steps, as `neurons.lif_step` has it."""
    pause = jnp.floor(jnp.asarray(lif.t_ref, jnp.result_type(float)) / dt + 1e-3) * dt
    return dt / lif.tau_m, lif.v_rest, lif.v_reset, lif.v_th, pause


def fire(
    layers: tuple[LIFParams, LIFParams],
    states: tuple[LIFState, LIFState],
    weights: Float[Array, "n_in n"],
    signed_output: Float[Array, "2 half"],
    sign_in: Float[Array, " n_in"],
    gain: float | Array,
    pre: Float[Array, "t n_in"],
    *,
    dt: float,
) -> tuple[tuple[LIFState, LIFState], Float[Array, "t n"], Float[Array, "t 2"]]:
    """Both layers of neurons over the rows of `pre`, the weights held.

    Args:
        layers: constants of the hidden and of the motor neurons, scalars.
        states: their membranes.
        weights: magnitudes of the first layer [mV].
        signed_output: signed weights of the second layer, times their gain [mV].
        sign_in: sign of each input.
        gain: what the first layer's weights are multiplied with.
        pre: input spikes, anything but 0 is one.
        dt: step [s].

    Returns:
        The membranes, the spikes of the hidden and those of the motor neurons.
    """
    (steps, _), n = pre.shape, weights.shape[1]
    hidden, motor = states
    constants = _pack(dt, gain, *_layer(layers[0], dt), *_layer(layers[1], dt))
    *membranes, spikes, motors = _call(
        "jaxsnn_fire",
        [(n,), (n,), (2,), (2,), (steps, n), (steps, 2)],
        weights, signed_output, sign_in, *hidden, *motor, pre, constants, in_place={},
    )  # fmt: skip
    return (LIFState(*membranes[:2]), LIFState(*membranes[2:])), spikes, motors


def remember(
    stdp: STDPParams,
    states: tuple[STDPState, STDPState],
    pre: Float[Array, "t n_in"],
    hidden: Float[Array, "t n"],
    output: Float[Array, "t 2"],
    centres: tuple[Float[Array, " n_in"], Float[Array, " n"]],
    keep: float | Float[Array, ""],
    *,
    dt: float,
) -> tuple[STDPState, STDPState, Float[Array, "n_in n"], Float[Array, "2 half 1"]]:
    """Traces and eligibility of both layers of synapses after a window, as `window.stdp_window`.

    Args:
        stdp: constants, scalars.
        states: of the two layers of synapses; the second has a leading axis of motors.
        pre, hidden, output: spikes, anything but 0 is one.
        centres: what is taken off each step of a presynaptic neuron.
        keep: 0 to start from empty traces, else 1.
        dt: step [s].

    Returns:
        The state of each layer after the window, and the integral of the eligibility of each.
    """
    a_minus = stdp.a_minus * stdp.anti_causal
    # Divided here, as in `window.stdp_kernel`, so that both round alike.
    rates = (dt / tau for tau in (stdp.tau_plus, stdp.tau_minus, stdp.tau_z))
    constants = _pack(dt, keep, stdp.tau_z, *rates, stdp.a_plus, a_minus)
    leaves = [(*states[0].traces, states[0].z), (*states[1].traces, states[1].z)]
    found = _call(
        "jaxsnn_remember",
        [x.shape for layer in leaves for x in (*layer, layer[-1])],
        *leaves[0], *leaves[1], pre, hidden, output, *centres, constants, in_place={2: 2},
    )  # fmt: skip
    first, second = (STDPState(Traces(*x[:2]), x[2]) for x in (found[:4], found[4:]))
    return first, second, found[3], found[7]
