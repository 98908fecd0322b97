"""S1-S4: sizes, signs, bounds; the window form against the step; what a reward does."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import network
from jaxsnn.config import (
    NetworkConfig,
    Weights,
    check_network,
    network_config,
    network_params,
    neuron_signs,
    weight_bounds,
)
from jaxsnn.encoding import poisson_spikes
from jaxsnn.neurons import LIFParams

SMALL = NetworkConfig(
    hidden_exc=12, hidden_inh=12, group_exc=4, group_inh=4, control_steps=40, hold_steps=20
)


def params_of(config, **changes):
    return network_params(config, gain_input=3.0, gain_output=6.0, **changes)


@pytest.fixture(scope="module")
def runs():
    """Jitted scans of both forms over `[n, hold, n_in]` input spikes with one reward per row."""

    def by_steps(config, params, state, pre, rewards):
        def body(carry, xs):
            return network.step(config, params, carry, *xs)

        rows = pre.reshape(-1, config.n_in)
        per_step = jnp.repeat(rewards, pre.shape[1], axis=0)
        state, spikes = jax.lax.scan(body, state, (rows, per_step))
        return state, spikes

    def by_windows(config, params, state, pre, rewards):
        stdp = network.kernel(config, params)

        def body(carry, xs):
            carry, eligibility, spikes = network.window(config, params, stdp, carry, xs[0])
            weights = network.reinforce(config, params, carry.weights, eligibility, xs[1])
            return carry._replace(weights=weights), spikes

        state, spikes = jax.lax.scan(body, state, (pre, rewards))
        return state, jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), spikes)

    return jax.jit(by_steps, static_argnums=0), jax.jit(by_windows, static_argnums=0)


def inputs(config, n_windows, rate=60.0, seed=0):
    rates = jnp.full(config.n_in, rate)
    pre = poisson_spikes(
        rates, n_windows * config.hold_steps, key=jax.random.key(seed), dt=config.dt
    )
    return pre.reshape(n_windows, config.hold_steps, config.n_in)


@pytest.mark.parametrize(
    ("name", "rule", "hidden", "inhibitory", "top"),
    [
        ("S1", "additive", 210, 0, 40.0),
        ("S2", "multiplicative", 210, 0, 40.0),
        ("S3", "additive", 208, 104, 100.0),
        ("S4", "multiplicative", 208, 104, 100.0),
    ],
)
def test_networks_of_table_2_2(name, rule, hidden, inhibitory, top):
    config = network_config(name)
    params = network_params(config)
    pre, signs = neuron_signs(config)
    assert config.rule == rule and config.n_in == 210 and config.n_hidden == hidden
    assert (pre < 0).sum() == 105 and (signs < 0).sum() == inhibitory
    assert (signs[: config.n_half] < 0).sum() == inhibitory // 2
    assert float(config.rates.sonar[-1]) == float(config.rates.angle[-1]) == top
    assert params.reward.k == (0.3 if rule == "additive" else 1.3)
    state = jax.jit(network.init, static_argnums=1)(jax.random.key(0), config, params)
    assert state.weights.hidden.shape == (210, hidden)
    assert state.weights.output.shape == (2, hidden // 2)
    bound = np.broadcast_to(weight_bounds(config, params).hidden, (210, hidden))
    assert (state.weights.hidden <= bound).all() and (state.weights.hidden >= 0).all()
    low = 0.5 if inhibitory else 0.0
    assert (bound == 2.5).mean() == low and (bound == 5.0).mean() == 1 - low
    np.testing.assert_allclose((state.weights.hidden / bound).mean(), 0.5, atol=0.01)


def test_step_and_window_agree_when_weights_are_held(runs):
    params = params_of(SMALL, gamma=0.0)
    state = network.init(jax.random.key(1), SMALL, params)
    pre, rewards = inputs(SMALL, 12), jnp.ones((12, 2))
    a, spikes_a = runs[0](SMALL, params, state, pre, rewards)
    b, spikes_b = runs[1](SMALL, params, state, pre, rewards)
    assert spikes_a.hidden.sum() > 50 and spikes_a.output.sum() > 5
    jax.tree.map(np.testing.assert_array_equal, spikes_a, spikes_b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=5e-6 * float(jnp.abs(x).max()) + 1e-6)


@pytest.mark.parametrize("rule", ["additive", "multiplicative"])
def test_step_and_window_stay_close_when_weights_change(runs, rule):
    """Fixed spikes in, slow learning: correlation and slope of the change, hold 20 against 1."""
    import dataclasses

    config = dataclasses.replace(SMALL, rule=rule)
    params = params_of(config, gamma=0.01)
    state = network.init(jax.random.key(1), config, params, None)
    state = state._replace(weights=jax.tree.map(lambda w: 0.5 * w + 0.5, state.weights))
    rewards = jnp.array([[1.0, -1.0]] * 12)
    a, _ = runs[0](config, params, state, inputs(config, 12), rewards)
    b, _ = runs[1](config, params, state, inputs(config, 12), rewards)
    da, db = (np.ravel(s.weights.hidden - state.weights.hidden) for s in (a, b))
    assert np.abs(da).mean() > 1e-3
    assert np.corrcoef(da, db)[0, 1] > 0.98
    assert 0.95 < (da @ db) / (da @ da) < 1.05


def test_window_agrees_at_full_size_over_a_second():
    """S4 as it is used: 44,100 synapses, 10 windows of 100 ms, plasticity off against per-step."""
    config = network_config("S4")
    params = network_params(config, gamma=0.0)
    state = network.init(jax.random.key(0), config, params)
    rates = jnp.repeat(jnp.array([50.0, 100.0, 50.0, 0.0, 50.0, 50.0, 25.0]), 30)
    pre = poisson_spikes(rates, 200, key=jax.random.key(1), dt=config.dt)

    @jax.jit
    def both(state, pre):
        steps, s1 = jax.lax.scan(
            lambda c, x: network.step(config, params, c, x, jnp.zeros(2)), state, pre
        )
        stdp = network.kernel(config, params)
        windows, s2 = jax.lax.scan(
            lambda c, x: network.window(config, params, stdp, c, x)[::2],
            state,
            pre.reshape(2, 100, -1),
        )
        return (steps, s1), (windows, s2)

    (a, spikes_a), (b, spikes_b) = both(state, pre)
    np.testing.assert_array_equal(spikes_a.hidden, spikes_b.hidden.reshape(200, -1))
    np.testing.assert_array_equal(spikes_a.output, spikes_b.output.reshape(200, -1))
    scale = float(jnp.abs(a.stdp_hidden.z).max())
    np.testing.assert_allclose(a.stdp_hidden.z, b.stdp_hidden.z, rtol=0, atol=5e-6 * scale)


def test_reward_moves_the_synapses_the_text_says():
    """With eligibility 1 everywhere, the change has the sign of section 2.3.2, per motor."""
    params = params_of(SMALL, gamma=0.1)
    weights = Weights(jnp.full((56, 24), 1.0), jnp.full((2, 12), 1.0))
    ones = eligibility(1.0)
    new = network.reinforce(SMALL, params, weights, ones, jnp.array([1.0, -0.5]))
    pre, hidden = neuron_signs(SMALL)
    reward = np.repeat([1.0, -0.5], 12)
    np.testing.assert_allclose(
        jnp.log(new.hidden), 0.1 * np.outer(pre, hidden * reward), rtol=1e-4, atol=1e-6
    )
    np.testing.assert_allclose(
        jnp.log(new.output), 0.1 * (hidden * reward).reshape(2, 12), rtol=1e-4, atol=1e-6
    )


def eligibility(z, count=0.0):
    return network.Eligibility(
        jnp.full((56, 24), z), jnp.full((2, 12), z), jnp.full(24, count), jnp.full(2, count), 0.1
    )


def test_homeostasis_works_against_the_rate():
    """Above its target rate a neuron loses excitation and gains inhibition; at it, nothing."""
    params = params_of(SMALL, homeostasis=1.0, rate_hidden=50.0, rate_output=50.0)
    weights = Weights(jnp.full((56, 24), 1.0), jnp.full((2, 12), 1.0))
    pre, hidden = neuron_signs(SMALL)
    for count, change in ((0.0, 0.1), (5.0, 0.0), (10.0, -0.1)):
        new = network.reinforce(SMALL, params, weights, eligibility(0.0, count), jnp.zeros(2))
        want = change * np.broadcast_to(pre[:, None], (56, 24))
        np.testing.assert_allclose(jnp.log(new.hidden), want, rtol=1e-4, atol=1e-6)
        want = change * hidden.reshape(2, 12)
        np.testing.assert_allclose(jnp.log(new.output), want, rtol=1e-4, atol=1e-6)
    still = network.reinforce(SMALL, params, weights, eligibility(1.0, 9.0), jnp.ones(2), 0.0)
    np.testing.assert_array_equal(still.hidden, weights.hidden)


def test_weights_stay_magnitudes_in_their_bounds(runs):
    params = params_of(SMALL, gamma=5.0)
    state = network.init(jax.random.key(1), SMALL, params)
    rewards = jnp.array([[2.0, -2.0], [-2.0, 2.0]] * 3)
    state, _ = runs[1](SMALL, params, state, inputs(SMALL, 6), rewards)
    top = weight_bounds(SMALL, params)
    assert (state.weights.hidden >= 0).all() and (state.weights.hidden <= top.hidden).all()
    assert (state.weights.output >= 0).all() and (state.weights.output <= 5.0).all()
    assert float((state.weights.hidden == top.hidden).mean()) > 0.05  # the bound was reached


def test_mirrored_network_mirrors_its_motors():
    """Swapping the halves of the weights swaps the motors."""
    params = params_of(SMALL)
    state = network.init(jax.random.key(3), SMALL, params)
    w = state.weights
    swapped = Weights(jnp.roll(w.hidden, SMALL.n_half, axis=1), w.output[::-1])
    pre = inputs(SMALL, 3).reshape(-1, SMALL.n_in)
    _, a = network.fire(SMALL, params, state, pre)
    _, b = network.fire(SMALL, params, state._replace(weights=swapped), pre)
    assert a.output.sum() > 0
    np.testing.assert_array_equal(a.output, b.output[:, ::-1])


def test_vmap_over_robots_and_constants_equals_a_loop():
    """Each robot has its own weights, each sweep point its own gamma; one compilation."""
    stdp = network.kernel(SMALL, params_of(SMALL))
    pre = jnp.stack([inputs(SMALL, 1, seed=s)[0] for s in range(3)])

    @jax.jit
    @chex.assert_max_traces(n=1)
    def batch(keys, gammas, pre):
        def one(key, gamma, x):
            params = params_of(SMALL, gamma=gamma)
            state = network.init(key, SMALL, params)
            state, held, _ = network.window(SMALL, params, stdp, state, x)
            return network.reinforce(SMALL, params, state.weights, held, jnp.array([1.0, -1.0]))

        return jax.vmap(one)(keys, gammas, pre)

    keys, gammas = jax.random.split(jax.random.key(0), 3), jnp.array([0.0, 0.01, 0.1])
    got = batch(keys, gammas, pre)
    order = jnp.array([2, 0, 1])
    again = batch(keys[order], gammas[order], pre[order])
    np.testing.assert_allclose(got.hidden[order], again.hidden, rtol=1e-6)
    start = network.init(keys[0], SMALL, params_of(SMALL)).weights
    np.testing.assert_allclose(got.hidden[0], start.hidden, rtol=1e-6)
    assert float(jnp.abs(got.hidden[1] - got.hidden[2]).max()) > 1e-3


def test_settle_touches_membranes_of_fresh_robots_only():
    params = params_of(SMALL)
    state = network.init(jax.random.key(0), SMALL, params)
    state, _ = network.fire(SMALL, params, state, inputs(SMALL, 1)[0])
    same = network.reset_membranes(params, state, jnp.asarray(False))
    jax.tree.map(np.testing.assert_array_equal, same, state)
    rest = network.reset_membranes(params, state, jnp.asarray(True))
    assert not rest.hidden.v.any() and not rest.output.v.any() and state.hidden.v.any()


@pytest.mark.parametrize(
    ("call", "part"),
    [
        (lambda: NetworkConfig(hidden_exc=7), "hidden_exc=7: expected an even number"),
        (lambda: NetworkConfig(hidden_exc=0, hidden_inh=0), "expected a hidden neuron"),
        (lambda: NetworkConfig(control_steps=50, hold_steps=20), "hold_steps=20: expected a"),
        (lambda: NetworkConfig(dt=-1.0), "dt=-1.0"),
        (lambda: network_config("S5"), "model='S5'"),
        (lambda: check_network(SMALL, network_params(SMALL, gamma=-1.0)), "gamma=-1.0"),
        (
            lambda: check_network(SMALL, network_params(SMALL, hidden=LIFParams(tau_m=0.0))),
            "tau_m=0.0",
        ),
        (
            lambda: network.init(
                jax.random.key(0), SMALL, network_params(SMALL),
                Weights(jnp.full((56, 24), 9.0), jnp.ones((2, 12))),
            ),
            "weights.hidden=9: expected mV",
        ),
        (
            lambda: network.init(
                jax.random.key(0), SMALL, network_params(SMALL),
                Weights(jnp.ones((5, 24)), jnp.ones((2, 12))),
            ),
            "weights.hidden=<shape",
        ),
    ],
)  # fmt: skip
def test_bad_input_is_named(call, part):
    with pytest.raises(ValueError, match=part):
        call()
