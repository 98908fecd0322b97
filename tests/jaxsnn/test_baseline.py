"""Centred eligibility: the running mean, and that only what differs from it is learnt from."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import network
from jaxsnn.config import network_config, network_params
from jaxsnn.encoding import poisson_spikes
from jaxsnn.plasticity import STDPParams
from jaxsnn.running_mean import Baseline, baseline_init, baseline_update

SMALL = network_config("S4", group_exc=4, group_inh=4, hidden_exc=12, hidden_inh=12, hold_steps=20)


def test_a_plain_mean_until_the_time_constant_then_an_exponential_one():
    spikes = np.random.default_rng(0).uniform(size=(400, 3)).astype(np.float32)

    def body(state, x):
        return (baseline_update(state, x, tau=10.0, duration=0.1),) * 2

    _, seen = jax.lax.scan(body, baseline_init(3), jnp.asarray(spikes))
    np.testing.assert_allclose(seen.mean[19], spikes[:20].mean(axis=0), rtol=1e-5)
    mean, share = np.asarray(seen.mean[199], np.float64), -np.expm1(-0.01)
    for x in spikes[200:]:
        mean += share * (x - mean)
    np.testing.assert_allclose(seen.mean[-1], mean, rtol=1e-4)


@pytest.fixture(scope="module")
def eligibility():
    @jax.jit
    def run(params, state, pre):
        stdp = network.kernel(SMALL, params)

        def body(carry, x):
            carry, held, _ = network.window(SMALL, params, stdp, carry, x)
            return carry, held.hidden

        return jax.lax.scan(body, state, pre)

    return run


def test_neurons_that_always_fire_alike_stop_learning_and_others_learn_by_covariance(eligibility):
    """Group 0 alternates between 0 and 100 Hz, group 1 fires at 50 Hz, all along."""
    stdp = STDPParams(anti_causal=0.0)
    params = network_params(
        SMALL, stdp=stdp, gamma=0.0, centring=1.0, tau_baseline=4.0, gain_input=4.0, gain_output=4.0
    )
    state = network.init(jax.random.key(0), SMALL, params)
    state = state._replace(weights=jax.tree.map(lambda w: 0.5 * w + 1.0, state.weights))
    n = 400
    rates = jnp.full((n, SMALL.n_in), 50.0)
    rates = rates.at[:, :8].set(jnp.where(jnp.arange(n)[:, None] // 10 % 2 == 0, 100.0, 0.0))
    keys = jax.random.split(jax.random.key(1), n)
    pre = jax.vmap(lambda k, r: poisson_spikes(r, SMALL.hold_steps, key=k, dt=SMALL.dt))(
        keys, rates
    )
    # Past the first half, and past the traces of what was before the last change.
    settled = (np.arange(n) >= 200) & (np.arange(n) % 10 >= 5)
    high, low = (settled & (np.arange(n) // 10 % 2 == k) for k in (0, 1))

    def means(centring):
        _, held = eligibility(params._replace(centring=centring), state, pre)
        held = np.asarray(held)
        return [
            held[part][:, group].mean()
            for group in (slice(8), slice(8, 16))
            for part in (high, low)
        ]

    on, off, steady_a, steady_b = means(1.0)
    raw_on, _, raw_a, raw_b = means(0.0)
    # Above its mean a group learns one way, below it the other; raw, both go the same way.
    assert abs(on) > 0.2 * abs(raw_on) and on * off < 0
    assert abs(steady_a + steady_b) < 0.2 * abs(raw_a + raw_b)


def test_step_and_window_agree_with_a_settled_baseline():
    """A baseline that hardly moves within the run: then both forms see the same mean."""
    params = network_params(
        SMALL, gamma=0.0, centring=1.0, tau_baseline=1e6, gain_input=4.0, gain_output=4.0
    )
    state = network.init(jax.random.key(0), SMALL, params)
    usual = Baseline(jnp.full((SMALL.n_in,), 0.05), jnp.asarray(1e6))
    hidden = Baseline(jnp.full((SMALL.n_hidden,), 0.03), jnp.asarray(1e6))
    state = state._replace(baseline_input=usual, baseline_hidden=hidden)
    pre = poisson_spikes(jnp.full(SMALL.n_in, 80.0), 100, key=jax.random.key(2), dt=SMALL.dt)

    @jax.jit
    def both(state, pre):
        stdp = network.kernel(SMALL, params)
        a, _ = jax.lax.scan(
            lambda c, x: network.step(SMALL, params, c, x, jnp.zeros(2)), state, pre
        )
        b, _ = jax.lax.scan(
            lambda c, x: (network.window(SMALL, params, stdp, c, x)[0], None),
            state, pre.reshape(5, 20, -1),
        )  # fmt: skip
        return a, b

    a, b = both(state, pre)
    for x, y in ((a.stdp_hidden.z, b.stdp_hidden.z), (a.stdp_output.z, b.stdp_output.z)):
        scale = float(jnp.abs(x).max())
        assert scale > 0
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-4 * scale)
