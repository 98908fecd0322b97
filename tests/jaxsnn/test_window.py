"""The window form against the per-step definition."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn.plasticity import STDPParams, STDPState, Traces
from jaxsnn.window import stdp_kernel, stdp_steps, stdp_window

DT = 1e-3
steps_jit = jax.jit(stdp_steps, static_argnames="dt")
window_jit = jax.jit(stdp_window)
PARAMS = STDPParams(a_plus=1.0, a_minus=-0.7, tau_plus=15e-3, tau_minus=30e-3, tau_z=40e-3)


def spikes(seed, steps, n_pre, n_post):
    rng = np.random.default_rng(seed)
    draw = [(rng.random((steps, n)) < 0.05).astype(np.float32) for n in (n_pre, n_post)]
    traces = Traces(*(jnp.asarray(rng.normal(size=n), jnp.float32) for n in (n_pre, n_post)))
    z = jnp.asarray(rng.normal(size=(n_pre, n_post)) * 10, jnp.float32)
    return STDPState(traces, z), *map(jnp.asarray, draw)


@pytest.mark.parametrize(("n_pre", "n_post"), [(5, 9), (9, 5)])
@pytest.mark.parametrize("steps", [1, 7, 50])
def test_window_equals_steps(n_pre, n_post, steps):
    state, pre, post = spikes(steps, steps, n_pre, n_post)
    want = steps_jit(PARAMS, state, pre, post, dt=DT)
    got = window_jit(stdp_kernel(PARAMS, steps, dt=DT), state, pre, post)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        scale = float(jnp.abs(b).max())
        np.testing.assert_allclose(a, b, rtol=0, atol=3e-6 * scale)


def test_windows_chain_and_forget():
    state, pre, post = spikes(3, 40, 4, 6)
    kernel = stdp_kernel(PARAMS, 20, dt=DT)
    middle, first = window_jit(kernel, state, pre[:20], post[:20], 1.0)
    end, second = window_jit(kernel, middle, pre[20:], post[20:], 1.0)
    want_end, want_sum = steps_jit(PARAMS, state, pre, post, dt=DT)
    np.testing.assert_allclose(end.z, want_end.z, rtol=0, atol=1e-4)
    np.testing.assert_allclose(first + second, want_sum, rtol=0, atol=1e-5)
    empty = jax.tree.map(jnp.zeros_like, state)
    a = window_jit(kernel, state, pre[:20], post[:20], 0.0)
    b = window_jit(kernel, empty, pre[:20], post[:20], 1.0)
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_one_trace_for_vmap_jit_and_traced_constants():
    """A sweep over tau_z and over robots: vmap of the kernel and the window equals a loop."""
    states = [spikes(s, 10, 3, 4) for s in range(2)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *states)

    @jax.jit
    def both(tau_z, args):
        kernel = stdp_kernel(PARAMS._replace(tau_z=tau_z), 10, dt=DT)
        return jax.vmap(stdp_window, in_axes=(None, 0, 0, 0))(kernel, *args)

    for tau_z in (10e-3, 100e-3):
        (state, total) = both(tau_z, batch)
        for k in range(2):
            want = steps_jit(PARAMS._replace(tau_z=tau_z), *states[k], dt=DT)
            np.testing.assert_allclose(state.z[k], want[0].z, rtol=0, atol=2e-4)
            np.testing.assert_allclose(total[k], want[1], rtol=0, atol=1e-5)


def test_gradient_with_respect_to_the_constants():
    state, pre, post = spikes(5, 30, 4, 5)

    def total(tau_z, f):
        params = PARAMS._replace(tau_z=tau_z)
        if f is stdp_window:
            out = stdp_window(stdp_kernel(params, 30, dt=DT), state, pre, post)
        else:
            out = stdp_steps(params, state, pre, post, dt=DT)
        return jnp.sum(out[1] ** 2)

    gradient = jax.jit(jax.grad(total), static_argnums=1)
    grads = [gradient(40e-3, f) for f in (stdp_window, stdp_steps)]
    np.testing.assert_allclose(grads[0], grads[1], rtol=1e-3)


def test_empty_window_is_refused():
    with pytest.raises(ValueError, match="n_steps=0"):
        stdp_kernel(PARAMS, 0, dt=DT)
