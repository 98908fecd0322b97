"""Leaky integrate-and-fire neurons: one Euler step, and a scan over many.

Times are in seconds, potentials and synaptic weights in millivolts (as Table 2.1 of the source
gives them), so that a weight is the jump of the membrane potential that one spike causes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsnn._checks import (
    concrete,
    default_float,
    require,
    require_finite,
    require_positive,
    require_whole,
)


class LIFParams(NamedTuple):
    """Constants of a layer of neurons; leaves are scalars or broadcast against the layer.

    Attributes:
        tau_m: membrane time constant [s].
        v_rest: resting potential [mV].
        v_reset: potential after a spike [mV].
        v_th: a neuron whose potential exceeds this fires [mV].
        resistance: `R`, membrane resistance [MOhm], so that `R I` is in mV for `I` in nA.
        t_ref: refractory time [s], below one second; the membrane neither leaks nor integrates
            meanwhile. One that is no multiple of the step is rounded down to one, as in Brian 2.
    """

    tau_m: float | Array = 20e-3
    v_rest: float | Array = 0.0
    v_reset: float | Array = 0.0
    v_th: float | Array = 15.0
    resistance: float | Array = 1.0
    t_ref: float | Array = 2e-3


class LIFState(NamedTuple):
    """Membrane potential `v` [mV] and what is left of the refractory time `refractory` [s]."""

    v: Float[Array, "*batch n"]
    refractory: Float[Array, "*batch n"]


def check_lif(params: LIFParams, *, dt: float) -> None:
    """Refuse constants with which the Euler step cannot work.

    Raises:
        ValueError: a time constant is not positive, the step is unstable (`dt >= 2 tau_m`), the
            reset is not below the threshold, a refractory time is one second or more (surely
            milliseconds), or a value is not finite.
    """
    require_positive("dt", dt, "give the step in seconds, 1e-3 for one millisecond")
    require_positive("tau_m", params.tau_m, "give it in seconds, 20e-3 for twenty milliseconds")
    require_positive("t_ref", params.t_ref, "give it in seconds, 0 for none", zero=True)
    for name in ("v_rest", "v_reset", "v_th", "resistance"):
        require_finite(name, getattr(params, name), "give it in millivolts (resistance: megohms)")
    tau = concrete(params.tau_m)
    if tau is not None:
        require(
            bool(dt < 2 * tau.min()),
            f"dt={dt}: expected a step below 2 tau_m = {2 * tau.min():g} s, or the Euler step "
            "oscillates and grows; take a smaller dt or a longer tau_m",
        )
    refractory = concrete(params.t_ref)
    if refractory is not None:
        require(
            bool((refractory < 1.0).all()),
            f"t_ref={refractory.max():g}: expected less than one second; give it in seconds, 2e-3 "
            "for two milliseconds",
        )
    reset, threshold = concrete(params.v_reset), concrete(params.v_th)
    if reset is not None and threshold is not None:
        require(
            bool((reset < threshold).all()),
            f"v_reset={params.v_reset}: expected less than v_th = {params.v_th}, or a neuron fires "
            "for ever; lower v_reset",
        )


def _fits(name: str, value: Any, shape: tuple[int, ...], fix: str) -> None:
    """`value` broadcasts to `[*batch, n]` without widening it: shapes are known inside jit, too."""
    given, n = jnp.shape(value), shape[-1]
    try:
        fits = np.broadcast_shapes(given, shape)[-1] == n
    except ValueError:
        fits = False
    require(fits, f"{name}=<shape {given}>: expected a number or {n} of them; {fix}")


def lif_init(params: LIFParams, n: int) -> LIFState:
    """`n` neurons at rest, none of them refractory, in jax's default float (float64 under x64).

    Returns:
        LIFState, leaves `[n]`.

    Raises:
        ValueError: `params` holds a constant that no neuron has, or not one for each neuron; `n`
            is not positive.
    """
    require_whole("n", n, 1, "a layer needs at least one neuron")
    _fits("v_rest", params.v_rest, (n,), "give one for all neurons, or one for each")
    dtype = default_float()
    v = jnp.full((n,), 1.0, dtype) * jnp.asarray(params.v_rest, dtype)
    return LIFState(v=v, refractory=jnp.zeros((n,), dtype))


def lif_step(
    params: LIFParams,
    state: LIFState,
    current: Float[Array, "*#batch n"] | Float[Array, ""] | float,
    jump: Float[Array, "*#batch n"],
    *,
    dt: float,
) -> tuple[LIFState, Bool[Array, "*batch n"]]:
    r"""One Euler step of the leaky integrate-and-fire neuron.

    .. math:: \tau_m \frac{dv}{dt} = -(v - v_{rest}) + R I(t)

    Order within a step: leak and current, threshold, synaptic jumps, reset. A jump is the impulse
    part of `R I` (`R I = tau_m w delta(t)` raises `v` by `w`); it counts for the threshold from the
    next step on, so a spike reaches the next layer one step later, and it is lost on a neuron that
    is refractory or has just fired.

    Args:
        params: LIFParams.
        state: LIFState, `[n]`.
        current: `I` [nA], held over the step; `[n]` or a scalar.
        jump: sum of the weights of the spikes that arrive in this step [mV], `[n]`.
        dt: step [s].

    Returns:
        The new state, of the dtype of the old one, and the spikes of this step, `[n]` bool.

    Raises:
        ValueError: a constant with which the step cannot work, see `check_lif`, or a constant,
            current or jump for another number of neurons than the state has.

    Source: Shim (2020), Eq. 2.1; order of operations as in Brian 2 with `(unless refractory)`.

    Example:
        >>> params = LIFParams(v_th=1.0)
        >>> jump = jnp.array([0.5, 2.0])
        >>> state, _ = lif_step(params, lif_init(params, 2), 0.0, jump, dt=1e-3)
        >>> lif_step(params, state, 0.0, jnp.zeros(2), dt=1e-3)[1].tolist()
        [False, True]
    """
    check_lif(params, dt=dt)
    for name, value in params._asdict().items():
        _fits(name, value, state.v.shape, "give one for all neurons, or one for each")
    _fits("current", current, state.v.shape, "give one for all neurons, or one for each")
    _fits("jump", jump, state.v.shape, "sum the weights of each neuron's spikes")
    left = jnp.maximum(state.refractory - dt, 0.0)
    # Half a step of slack: what is left is a multiple of dt only up to rounding.
    active = left <= 0.5 * dt
    v = state.v + (dt / params.tau_m) * (params.v_rest - state.v + params.resistance * current)
    v = jnp.where(active, v, state.v)
    spikes = active & (v > params.v_th)
    v = jnp.where(active, v + jump, v)
    v = jnp.where(spikes, params.v_reset, v)
    # Whole steps, rounded down, with the thousandth of a step of slack that Brian 2 has.
    pause = jnp.floor(jnp.asarray(params.t_ref, left.dtype) / dt + 1e-3) * dt
    left = jnp.where(spikes, pause, left)
    return LIFState(v.astype(state.v.dtype), left.astype(state.refractory.dtype)), spikes


def lif_scan(
    params: LIFParams, state: LIFState, jumps: Float[Array, "t n"], *, dt: float
) -> tuple[LIFState, Bool[Array, "t n"], Float[Array, "t n"]]:
    """`lif_step` over the rows of `jumps` [mV]; returns the last state, spikes and potentials.

    Returns:
        The last state, spikes `[t, n]` and potentials before the reset `[t, n]` [mV].

    Raises:
        ValueError: `jumps` are not steps of as many neurons as the state has; as `lif_step`.
    """
    shape = jnp.shape(jumps)
    require(
        len(shape) > 1 and shape[-1] == state.v.shape[-1],
        f"jumps=<shape {shape}>: expected (steps, {state.v.shape[-1]}); give a row for each step",
    )

    def body(carry: LIFState, jump: Array) -> tuple[LIFState, tuple[Array, Array]]:
        carry, spikes = lif_step(params, carry, 0.0, jump, dt=dt)
        return carry, (spikes, carry.v)

    state, (spikes, v) = jax.lax.scan(body, state, jumps)
    return state, spikes, v
