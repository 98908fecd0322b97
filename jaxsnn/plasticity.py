"""Spike-timing-dependent plasticity, its eligibility trace and the two reward-modulated rules.

Every function is one step of `dt` and pure. `window.py` has the same mathematics for a whole window
of steps as matrix products. Weights here are magnitudes (or any weights of one sign); which sign a
synapse has belongs to its presynaptic neuron (Dale), see `network.py`.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsnn._checks import (
    concrete,
    default_float,
    require,
    require_choice,
    require_finite,
    require_positive,
    require_whole,
)

Rule = Literal["additive", "multiplicative"]
Bounds = Literal["hard", "soft"]


class STDPParams(NamedTuple):
    """Constants of STDP and of the eligibility trace (Table 2.1 of the source, unless noted).

    Attributes:
        a_plus: `A+` [mV], size of a causal pair (pre before post).
        a_minus: `A-` [mV], negative: size of an anti-causal pair.
        tau_plus, tau_minus: time constants of the two windows [s].
        tau_z: time constant of the eligibility trace [s]; the source does not give it.
        anti_causal: factor on `a_minus` inside the eligibility trace; 1 is the source. With 1 and
            balanced windows the trace of a synapse whose neurons merely fire is zero on average.
    """

    a_plus: float | Array = 1.0
    a_minus: float | Array = -1.0
    tau_plus: float | Array = 20e-3
    tau_minus: float | Array = 20e-3
    tau_z: float | Array = 25e-3
    anti_causal: float | Array = 1.0


class Traces(NamedTuple):
    """`P+` of the presynaptic and `P-` of the postsynaptic neurons [mV].

    Equations 2.6 and 2.7 give each synapse its own pair, but all synapses of a neuron see the same
    spikes, so one number per neuron is the same thing.
    """

    p_plus: Float[Array, " n_pre"]
    p_minus: Float[Array, " n_post"]


class STDPState(NamedTuple):
    """Traces and the eligibility trace `z` [mV/s] of every synapse."""

    traces: Traces
    z: Float[Array, "n_pre n_post"]


def check_stdp(params: STDPParams, *, dt: float) -> None:
    """Refuse time constants that are not positive and amplitudes that are not finite.

    Raises:
        ValueError: names the parameter, its value and the fix.
    """
    require_positive("dt", dt, "give the step in seconds, 1e-3 for one millisecond")
    for name in ("tau_plus", "tau_minus", "tau_z"):
        require_positive(name, getattr(params, name), "give it in seconds, 20e-3 for twenty ms")
    for name in ("a_plus", "a_minus", "anti_causal"):
        require_finite(name, getattr(params, name), "give it in millivolts")


def check_spikes(state: STDPState, pre: Array, post: Array, *, lead: int = 0) -> None:
    """Refuse spikes of other layers than the state's; shapes are known inside jit, too.

    Args:
        state: STDPState.
        pre, post: spikes, `[n_pre]` and `[n_post]` behind `lead` axes.
        lead: 1 where steps come first.

    Raises:
        ValueError: names the spikes, their shape and that of the state.
    """
    for name, spikes, trace in zip(("pre", "post"), (pre, post), state.traces, strict=True):
        shape, n = jnp.shape(spikes), jnp.shape(trace)[-1]
        require(
            len(shape) == lead + 1 and shape[-1] == n,
            f"{name}=<shape {shape}>: expected ({'steps, ' * lead}{n}{'' if lead else ','}), as "
            "the state has; make it by stdp_init(n_pre, n_post) for these layers",
        )


def check_bounds(
    weights: Float[Array, "..."], w_min: float | Array, w_max: float | Array, name: str = "weights"
) -> None:
    """Refuse weights that are not finite or lie outside `[w_min, w_max]` [mV].

    Raises:
        ValueError: names the worst weight and the bounds.
    """
    values, low, high = concrete(weights), concrete(w_min), concrete(w_max)
    if values is None or low is None or high is None:
        return
    require_finite(name, values, "a diverged run cannot be continued: start from its last good one")
    excess = np.maximum(low - values, values - high)
    require(
        bool((excess <= 0).all()),
        f"{name}={values.flat[excess.argmax()]:g}: expected mV inside [w_min, w_max] = "
        f"[{low.min():g}, {high.max():g}]; clip them or change the bounds",
    )


def stdp_init(n_pre: int, n_post: int) -> STDPState:
    """No spikes so far: traces and eligibility are zero, in jax's default float.

    Returns:
        STDPState, traces `[n_pre]` and `[n_post]`, eligibility `[n_pre, n_post]`.

    Raises:
        ValueError: a size is not positive.
    """
    require_whole("n_pre", n_pre, 1, "a layer needs at least one neuron")
    require_whole("n_post", n_post, 1, "a layer needs at least one neuron")
    dtype = default_float()
    traces = Traces(jnp.zeros((n_pre,), dtype), jnp.zeros((n_post,), dtype))
    return STDPState(traces=traces, z=jnp.zeros((n_pre, n_post), dtype))


def stdp_step(
    params: STDPParams,
    state: STDPState,
    pre: Float[Array, " n_pre"],
    post: Float[Array, " n_post"],
    *,
    dt: float,
) -> STDPState:
    r"""One step of the traces and the eligibility trace.

    .. math::
        \dot P^+ = -P^+/\tau_+ + A_+ \Phi_{pre}, \qquad
        \dot P^- = -P^-/\tau_- + A_- \Phi_{post}

        \xi = P^+ \Phi_{post} + P^- \Phi_{pre}, \qquad \tau_z \dot z = -z + \xi

    The traces take this step's spikes before `xi` is formed, so a pair in the same step counts as
    causal and as anti-causal (`A+ + A-`). Decays are exact over the step. A pair adds
    `xi / tau_z` to `z`, whose integral over time is `xi`: `tau_z` says how long a reward may come
    late, not how much it moves a weight.

    Args:
        params: STDPParams, scalar leaves.
        state: STDPState.
        pre: presynaptic spikes, 0. or 1., `[n_pre]`.
        post: postsynaptic spikes, 0. or 1., `[n_post]`.
        dt: step [s].

    Returns:
        The new STDPState, of the dtype of the old one.

    Raises:
        ValueError: a constant with which the step cannot work, see `check_stdp`, or spikes of other
            layers than the state's.

    Source: Shim (2020), Eq. 2.4-2.7, after Florian (2007).

    Example:
        >>> one, none = jnp.ones(1), jnp.zeros(1)
        >>> state = stdp_step(STDPParams(), stdp_init(1, 1), one, none, dt=1e-3)
        >>> float(stdp_step(STDPParams(), state, none, one, dt=1e-3).z[0, 0]) > 0  # pre, then post
        True
    """
    check_stdp(params, dt=dt)
    check_spikes(state, pre, post)
    a_minus = params.a_minus * params.anti_causal
    p_plus = jnp.exp(-dt / params.tau_plus) * state.traces.p_plus + params.a_plus * pre
    p_minus = jnp.exp(-dt / params.tau_minus) * state.traces.p_minus + a_minus * post
    xi = p_plus[:, None] * post[None, :] + pre[:, None] * p_minus[None, :]
    z = jnp.exp(-dt / params.tau_z) * state.z + xi / params.tau_z
    new = STDPState(traces=Traces(p_plus, p_minus), z=z)
    return jax.tree.map(lambda a, b: a.astype(b.dtype), new, state)


def apply_reward(
    weights: Float[Array, "*n"],
    drive: Float[Array, "*n"],
    w_min: float | Float[Array, "..."],
    w_max: float | Float[Array, "..."],
    *,
    rule: Rule,
    bounds: Bounds = "hard",
) -> Float[Array, "*n"]:
    r"""Change weights by reward-modulated STDP, additive or multiplicative, inside their bounds.

    .. math::
        \text{additive: } \dot w = \gamma r z, \qquad \text{multiplicative: } \dot w = \gamma w r z

    With `drive` :math:`d = \gamma r \int z\,dt` (`z` does not depend on `w` while `w` is held):

    ===============  ==========================================  ============================
    rule             hard bounds (the source)                    soft bounds (an option)
    ===============  ==========================================  ============================
    additive         `clip(w + d)`                               `d > 0` scaled by the room left
                                                                 above, `d < 0` by that below
    multiplicative   `clip(w exp(d))`                            `logit(w / w_max) += d`
    ===============  ==========================================  ============================

    Soft bounds are the exact solutions of the rules with a factor `(w_max - w) / w_max` (growth;
    multiplicative: both ways) or `(w - w_min) / w_max` (additive decay). A weight at a hard bound
    forgets what drove it there; one near a soft bound does not.

    Args:
        weights: `w` [mV]; for the multiplicative soft rule they must be >= 0.
        drive: `d`, same shape; [mV] for the additive rule, dimensionless otherwise.
        w_min, w_max: bounds [mV], broadcastable.
        rule: "additive" (A-RM-STDP) or "multiplicative" (M-RM-STDP).
        bounds: "hard" or "soft".

    Returns:
        The new weights.

    Raises:
        ValueError: an unknown rule or kind of bounds, `w_min` above `w_max`, or a drive of another
            shape than the weights.

    Source: Shim (2020), Eq. 2.3 and 2.8. Soft bounds are ours.

    Example:
        >>> apply_reward(jnp.array([1.0, 4.0]), jnp.log(jnp.array([2.0, 2.0])), 0.0, 5.0,
        ...              rule="multiplicative").tolist()
        [2.0, 5.0]
    """
    require_choice("rule", rule, ("additive", "multiplicative"))
    require_choice("bounds", bounds, ("hard", "soft"))
    shape, given = jnp.shape(weights), jnp.shape(drive)
    require(given == shape, f"drive=<shape {given}>: expected {shape}; give one for each weight")
    low, high = concrete(w_min), concrete(w_max)
    if low is not None and high is not None:
        require(
            bool((low <= high).all()),
            f"w_min={low.max():g}: expected at most w_max = {high.min():g}; exchange them",
        )
    if rule == "additive":
        if bounds == "hard":
            return jnp.clip(weights + drive, w_min, w_max)
        up = w_max - (w_max - weights) * jnp.exp(-jnp.maximum(drive, 0.0) / w_max)
        return w_min + (up - w_min) * jnp.exp(jnp.minimum(drive, 0.0) / w_max)
    # exp overflows float32 beyond 88; a window that asks for e^20 has left the model anyway.
    growth = jnp.exp(jnp.clip(drive, -20.0, 20.0))
    if bounds == "hard":
        return jnp.clip(weights * growth, w_min, w_max)
    new = weights * growth / (1.0 + (weights / w_max) * (growth - 1.0))
    return jnp.clip(new, w_min, w_max)


def stdp_curve(params: STDPParams, delta_t: Float[Array, " n"]) -> Float[Array, " n"]:
    r"""The weight change of one pair against its timing (Figure 2.2 of the source).

    .. math:: \Delta w = A_+ e^{-\Delta t/\tau_+} (\Delta t > 0), \quad
              A_- e^{\Delta t/\tau_-} (\Delta t < 0)

    with :math:`\Delta t = t_{post} - t_{pre}` [s]; zero at :math:`\Delta t = 0`.

    Source: Shim (2020), Eq. 2.2. Deviation: Eq. 2.2 prints :math:`e^{-\Delta t/\tau_-}` for
        :math:`\Delta t < 0`, which grows without bound; the sign here is that of Figure 2.2.

    Example:
        >>> stdp_curve(STDPParams(), jnp.array([-1.0, 0.0])).tolist()[1]
        0.0
    """
    causal = params.a_plus * jnp.exp(-jnp.abs(delta_t) / params.tau_plus)
    anti = params.a_minus * params.anti_causal * jnp.exp(-jnp.abs(delta_t) / params.tau_minus)
    return jnp.where(delta_t > 0, causal, jnp.where(delta_t < 0, anti, 0.0))


def rm_stdp_curve(
    params: STDPParams, delta_t: Float[Array, " n"], reward: Float[Array, " m"]
) -> Float[Array, "m n"]:
    """Weight change of one pair against timing and reward, learning rate 1 (Figure 2.3)."""
    return reward[:, None] * stdp_curve(params, delta_t)[None, :]
