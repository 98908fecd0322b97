r"""A window of many STDP steps at once, as matrix products.

While the weights are held, nothing in the eligibility trace depends on them, and everything in it
is linear in pairs of spikes: pre at step `s` and post at step `t` add a number that depends on `s`
and `t` alone. With spikes as matrices `S` (`T` x pre) and `O` (`T` x post) and that number as a
fixed `T` x `T` matrix `K`,

.. math:: z(T) = \lambda^T z_0 + (K S)^\top O, \qquad
          \int z \, dt = s z_0 + (K' S)^\top O

which costs two matrix products per window instead of `T` passes over all synapses. What the traces
remember from before the window enters as one more row of `S` and `O`, row and column `T` of `K`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn._checks import default_float, require, require_whole
from jaxsnn.plasticity import STDPParams, STDPState, Traces, check_spikes, check_stdp, stdp_step


class STDPKernel(NamedTuple):
    """What `stdp_window` needs to know about `STDPParams` and the number of steps.

    Attributes:
        pairs: `K` and `K'`, with the row and column of the old traces, `[2, T + 1, T + 1]`,
            indexed `[which, post step, pre step]`.
        carry: factors of `z_0` in `z(T)` [1] and in its integral [s], `[2]`.
        plus, minus: weight of each step's spikes in the traces at the end, `[T]`.
        carry_plus, carry_minus: factor of the old traces in the new ones.
    """

    pairs: Float[Array, "2 t1 t1"]
    carry: Float[Array, "2"]
    plus: Float[Array, " t"]
    minus: Float[Array, " t"]
    carry_plus: Float[Array, ""]
    carry_minus: Float[Array, ""]


def stdp_kernel(params: STDPParams, n_steps: int, *, dt: float) -> STDPKernel:
    r"""Fold traces, pairing and the decay of `z` over `n_steps` steps into one matrix.

    A pair whose later spike is at step `u` has decayed by :math:`\lambda^{T-1-u}` at the end and
    has summed to :math:`dt (1-\lambda^{T-u})/(1-\lambda)`, with :math:`\lambda = e^{-dt/\tau_z}`.

    Args:
        params: STDPParams, scalar leaves (may be traced).
        n_steps: `T`, steps per window.
        dt: step [s].

    Returns:
        STDPKernel; compute it once, outside the scan over windows.

    Raises:
        ValueError: a constant with which the steps cannot work, see `check_stdp`.
    """
    require_whole("n_steps", n_steps, 1, "a window needs at least one step")
    check_stdp(params, dt=dt)
    t = jnp.arange(n_steps)
    lag = t[:, None] - t[None, :]  # post step minus pre step
    dtype = default_float()
    left = n_steps - 1 - t
    rates = [dt / tau for tau in (params.tau_z, params.tau_plus, params.tau_minus)]
    # What is left after 0 .. T steps of z and of the two traces, one exponential for all.
    table = jnp.stack([jnp.asarray(rate, dtype) for rate in rates])
    table = jnp.exp(-table[:, None] * jnp.arange(n_steps + 1).astype(dtype)[None])
    kept_z, kept_plus, kept_minus = table
    rate_z = rates[0]
    # expm1 keeps the sums exact where tau_z is long against the step.
    at_end = kept_z[left] / params.tau_z
    sums = jnp.expm1(-rate_z * (left + 1).astype(dtype)) / jnp.expm1(-rate_z)
    summed = sums * dt / params.tau_z
    weight = jnp.stack([at_end, summed])
    a_minus = params.a_minus * params.anti_causal
    distance = jnp.abs(lag)
    causal = jnp.where(lag >= 0, params.a_plus * kept_plus[distance], 0.0)
    anti = jnp.where(lag <= 0, a_minus * kept_minus[distance], 0.0)
    inner = weight[:, :, None] * causal[None] + weight[:, None, :] * anti[None]
    old_plus = weight * kept_plus[1:][None]
    old_minus = weight * kept_minus[1:][None]
    top = jnp.concatenate([inner, old_plus[:, :, None]], axis=2)
    corner = jnp.zeros((2, 1, 1), top.dtype)
    bottom = jnp.concatenate([old_minus[:, None, :], corner], axis=2)
    return STDPKernel(
        pairs=jnp.concatenate([top, bottom], axis=1),
        carry=jnp.stack([kept_z[-1], sums[0] * kept_z[1] * dt]),
        plus=params.a_plus * kept_plus[left],
        minus=a_minus * kept_minus[left],
        carry_plus=kept_plus[-1],
        carry_minus=kept_minus[-1],
    )


def stdp_window(
    kernel: STDPKernel,
    state: STDPState,
    pre: Float[Array, "t n_pre"],
    post: Float[Array, "t n_post"],
    keep: float | Float[Array, ""] = 1.0,
) -> tuple[STDPState, Float[Array, "n_pre n_post"]]:
    r"""`T` calls of `plasticity.stdp_step` at once, and the time integral of `z` over them.

    Args:
        kernel: from `stdp_kernel` for the same number of steps.
        state: STDPState at the window's start.
        pre: presynaptic spikes, 0. or 1., `[T, n_pre]`.
        post: postsynaptic spikes, 0. or 1., `[T, n_post]`.
        keep: 1 to go on from `state`, 0 to start from empty traces; a number rather than a reset
            of the state, because it costs no pass over the synapses.

    Returns:
        The state after the window and :math:`\int z\,dt` [mV], the sum over the `T` values of `z`
        after each step, times dt.

    Raises:
        ValueError: the kernel is for another number of steps than there are spikes, or the spikes
            are of other layers than the state.

    Source: Shim (2020), Eq. 2.4-2.7, summed over a window in closed form.
    """
    steps = kernel.plus.shape[-1]
    check_spikes(state, pre, post, lead=1)
    require(
        pre.shape[0] == post.shape[0] == steps,
        f"pre=<{pre.shape[0]} steps>, post=<{post.shape[0]} steps>: expected the {steps} steps of "
        "the kernel; make it by stdp_kernel(params, steps, dt=dt) for this window",
    )
    p_plus, p_minus = keep * state.traces.p_plus, keep * state.traces.p_minus
    pre_rows = jnp.concatenate([pre, p_plus[None]])
    post_rows = jnp.concatenate([post, p_minus[None]])
    # The small matrix is applied to the smaller layer; the rest is one product over time. The step
    # comes first in both factors, so that nothing has to be transposed between the products.
    n_pre, n_post = pre.shape[-1], post.shape[-1]
    if n_pre <= n_post:
        folded = jnp.einsum("kts,sj->tkj", kernel.pairs, pre_rows)
        change = folded.reshape(-1, 2 * n_pre).T @ post_rows
        change = change.reshape(2, n_pre, n_post)
    else:
        folded = jnp.einsum("kts,ti->ski", kernel.pairs, post_rows)
        change = pre_rows.T @ folded.reshape(-1, 2 * n_post)
        change = jnp.moveaxis(change.reshape(n_pre, 2, n_post), 1, 0)
    carry = keep * kernel.carry
    traces = Traces(
        p_plus=kernel.carry_plus * p_plus + kernel.plus @ pre,
        p_minus=kernel.carry_minus * p_minus + kernel.minus @ post,
    )
    z = carry[0] * state.z + change[0]
    new = STDPState(traces=traces, z=z)
    new = jax.tree.map(lambda a, b: a.astype(b.dtype), new, state)
    return new, carry[1] * state.z + change[1]


def stdp_steps(
    params: STDPParams,
    state: STDPState,
    pre: Float[Array, "t n_pre"],
    post: Float[Array, "t n_post"],
    *,
    dt: float,
) -> tuple[STDPState, Float[Array, "n_pre n_post"]]:
    """What `stdp_window` computes, step by step: the definition it is tested against."""
    check_spikes(state, pre, post, lead=1)
    require(
        pre.shape[0] == post.shape[0],
        f"pre=<{pre.shape[0]} steps>, post=<{post.shape[0]} steps>: expected as many; cut one",
    )

    def body(carry: tuple[STDPState, Array], spikes: tuple[Array, Array]) -> tuple:
        traces, total = carry
        traces = stdp_step(params, traces, *spikes, dt=dt)
        return (traces, (total + traces.z * dt).astype(total.dtype)), None

    (state, total), _ = jax.lax.scan(body, (state, jnp.zeros_like(state.z)), (pre, post))
    return state, total
