"""Declared networks: refusals, delays, batches, random edges, and the kernels they agree with."""

from __future__ import annotations

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import LIFParams, STDPParams, lif_init, lif_step, stdp_init, stdp_step
from jaxsnn import declared as d


def network(dt: float = 1e-3, neuron=None, n: int = 3, **how) -> d.Wiring:
    """Four inputs to `n` neurons by one projection."""
    how = {"weight": 1.0, **how}
    populations = {"in": d.Input(4), "out": d.Population(n, neuron=neuron or d.LIF())}
    return d.declare(populations, {"edges": d.Projection("in", "out", **how)}, dt=dt)


WRONG = {
    "projections['edges'].delay=0: expected at least 1 step": {"delay": 0},
    "projections['edges'].delay=<float64>: expected whole steps": {"delay": 1.5},
    "projections['edges'].delay=<shape (3,)>: expected": {"delay": np.ones(3, int)},
    "projections['edges'].connect=<shape (3, 4)>: expected a table": {
        "connect": np.ones((3, 4), bool)
    },
    "projections['edges'].connect=<int64>: expected a table of bool": {
        "connect": np.ones((4, 3), np.int64)
    },
    "projections['edges'].connect='some': expected one of": {"connect": "some"},
    "projections['edges'].connect='one_to_one': expected populations of one size": {
        "connect": "one_to_one"
    },
    "projections['edges'].weight=nan in 12 of 12 values: expected finite": {
        "weight": np.full((4, 3), np.nan)
    },
    "projections['edges'].weight=<shape (3, 4)>: expected a number or a table": {
        "weight": np.ones((3, 4))
    },
    "projections['edges'].weight=6: expected mV inside": {"weight": 6.0, "rule": d.PairSTDP()},
    "projections['edges'].sign=0.5: expected 1 or -1": {"sign": 0.5},
    "projections['edges'].sign=-1: expected 1 with a conductance": {
        "sign": -1,
        "receptor": d.Conductance(),
    },
    "tau=-1.0: expected a number > 0": {"receptor": d.Exponential(-1.0)},
    "w_min=2.0: expected less than w_max = 1.0": {"rule": d.PairSTDP(w_min=2.0, w_max=1.0)},
    "bounds='sotf': expected one of": {"rule": d.TripletSTDP(bounds="sotf")},
    "tau_z=0.0: expected a number > 0": {"rule": d.RewardSTDP(tau_z=0.0)},
    "use=1.5: expected a share": {"short_term": d.TsodyksMarkram(use=1.5)},
    "dt=0.05: expected a step below 2 tau_m": {"dt": 0.05},
    "method='rk4': expected one of": {"neuron": d.LIF(method="rk4")},
    "v_reset=20.0: expected less than v_th": {"neuron": d.LIF(v_reset=20.0, method="exact")},
    "tau_theta=0: expected a number > 0": {"neuron": d.AdaptiveLIF(tau_theta=0)},
    "dt=0.002: expected at most 1e-3 s": {"dt": 2e-3, "neuron": d.Izhikevich()},
}


@pytest.mark.parametrize("message", WRONG)
def test_a_wrong_part_is_refused_with_its_name_value_and_fix(message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        network(**WRONG[message])
    assert ";" in str(caught.value) or "take" in str(caught.value)


def test_names_have_to_fit() -> None:
    cells = {"in": d.Input(2), "out": d.Population(2)}
    with pytest.raises(ValueError, match=r"\.post='uot': expected one of 'in', 'out'"):
        d.declare(cells, {"e": d.Projection("in", "uot")})
    with pytest.raises(ValueError, match="an Input receives nothing"):
        d.declare(cells, {"e": d.Projection("out", "in")})
    with pytest.raises(ValueError, match="expected names that no population has"):
        d.declare(cells, {"in": d.Projection("in", "out")})
    with pytest.raises(ValueError, match="at least one Population"):
        d.declare({"in": d.Input(2)}, {})
    with pytest.raises(ValueError, match=r"p=0\.0: expected a probability"):
        d.FixedProbability(0.0)
    net = network(rule=d.RewardSTDP())
    state, params = d.init(jax.random.key(0), net), d.constants(net)
    with pytest.raises(ValueError, match=r"expected \['edges'\] as well"):
        d.step(net, params, state, {"in": np.zeros(4)})
    with pytest.raises(ValueError, match=r"\['inn'\]: expected names of populations"):
        d.step(net, params, state, {"in": np.zeros(4), "edges": 1.0, "inn": 1.0})
    with pytest.raises(ValueError, match="one and the same number of steps"):
        d.run(net, params, state, {"in": np.zeros((5, 4)), "edges": 1.0})


def test_an_exact_neuron_takes_any_step() -> None:
    assert network(dt=0.05, neuron=d.LIF(method="exact", t_ref=0.05)).dt == 0.05


def test_a_spike_arrives_after_its_own_delay() -> None:
    """Each neuron hears one input; with a weight above the threshold it fires `delay` later."""
    delay = np.array([[1, 9, 9], [9, 3, 9], [9, 9, 7], [9, 9, 9]])
    table = delay < 9
    net = network(weight=20.0, delay=delay, connect=table)
    pre = np.zeros((12, 4))
    pre[2] = 1.0
    state = d.init(jax.random.key(0), net)
    _, spikes, _ = jax.jit(d.run, static_argnums=0)(net, d.constants(net), state, {"in": pre})
    steps, neurons = np.nonzero(spikes["out"])
    assert dict(zip(neurons.tolist(), steps.tolist(), strict=True)) == {0: 3, 1: 5, 2: 9}


def test_declared_steps_are_those_of_the_kernels() -> None:
    """Euler neurons and reward-modulated STDP beside lif_step and stdp_step, bit for bit nearly."""
    rng = np.random.default_rng(3)
    steps, dt = 300, 1e-3
    pre = jnp.asarray(rng.random((steps, 4)) < 0.1, jnp.float32)
    weight = rng.uniform(2, 5, (4, 3))
    rule = d.RewardSTDP(gamma=0.0)
    net = network(weight=weight, rule=rule, gain=2.0)
    inputs = {"in": pre, "edges": jnp.zeros(steps)}
    state, spikes, _ = jax.jit(d.run, static_argnums=0)(
        net, d.constants(net), d.init(jax.random.key(0), net), inputs
    )

    def body(carry, row):
        cells, traces = carry
        jump = 2.0 * (row @ jnp.asarray(weight, jnp.float32))
        cells, fired = lif_step(LIFParams(), cells, 0.0, jump, dt=dt)
        traces = stdp_step(STDPParams(), traces, row, fired.astype(jnp.float32), dt=dt)
        return (cells, traces), fired

    start = lif_init(LIFParams(), 3), stdp_init(4, 3)
    (cells, traces), fired = jax.lax.scan(body, start, pre)
    assert fired.sum() > 20
    np.testing.assert_array_equal(spikes["out"], fired)
    np.testing.assert_allclose(state.membranes["out"].v, cells.v, rtol=0, atol=2e-5)
    np.testing.assert_allclose(state.synapses["edges"].rule.z, traces.z, rtol=1e-4, atol=1e-2)


def test_seeds_draw_their_own_edges_and_weights_stay_on_them() -> None:
    keys = jax.random.split(jax.random.key(1), 8)
    net = network(
        n=50,
        weight=lambda key, shape: jax.random.uniform(key, shape, minval=1.0, maxval=4.0),
        connect=d.FixedProbability(0.3),
        rule=d.PairSTDP(w_min=0.5, w_max=5.0, a_plus=0.5),
    )
    params = d.constants(net)
    pre = (np.random.default_rng(0).random((60, 4)) < 0.5).astype(np.float32)

    def one(key, a_plus):
        rule = dataclasses.replace(params.rules["edges"], a_plus=a_plus)
        state = d.init(key, net)
        last, _, _ = d.run(net, params._replace(rules={"edges": rule}), state, {"in": pre})
        return state.synapses["edges"].weights, last.synapses["edges"].weights

    sizes = jnp.tile(jnp.array([0.0, 0.5]), 4)
    first, last = jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(keys, sizes))
    there = first > 0
    # 1600 draws: a share of 0.3 within four standard deviations.
    assert abs(there.mean() - 0.3) < 4 * np.sqrt(0.3 * 0.7 / there.size)
    assert not np.array_equal(there[0], there[1])
    assert (last[~there] == 0).all() and (last[there] >= 0.5).all()
    # A batch over a constant of the rule: without growth the weights fall.
    assert last[0][there[0]].mean() < last[1][there[1]].mean()


@pytest.mark.parametrize("double", [False, True])
def test_a_state_keeps_its_dtype(double: bool) -> None:
    with jax.enable_x64(double):
        want = jnp.float64 if double else jnp.float32
        net = network(
            neuron=d.AdaptiveLIF(),
            receptor=d.Conductance(),
            rule=d.TripletSTDP(),
            short_term=d.TsodyksMarkram(),
            delay=2,
        )
        now = {"in": np.ones(4, bool), "out": 1.0}
        state = d.init(jax.random.key(0), net)
        new, _ = jax.jit(d.step, static_argnums=0)(net, d.constants(net), state, now)
        kinds = {leaf.dtype for leaf in jax.tree.leaves(new)}
    assert kinds == {jnp.dtype(want), jnp.dtype(jnp.int32)}


def test_triplets_at_40_hz_strengthen_as_the_sums_over_spikes_say() -> None:
    """Sixty pairs (post 10 ms after pre) at 40 Hz, against sums over all earlier spikes."""
    rule = d.TripletSTDP(w_max=5.0)
    dt, lag, period, pairs = 1e-3, 10, 25, 60
    net = network(n=1, weight=2.0, rule=rule, delay=1, gain=0.0)
    steps = period * pairs
    pre, current = np.zeros((steps, 4)), np.zeros((steps, 1))
    pre[::period] = 1.0
    current[lag::period] = 1e3  # 1000 nA over a millisecond: fires in that step
    _, spikes, w = d.run(
        net,
        d.constants(net),
        d.init(jax.random.key(0), net),
        {"in": pre, "out": current},
        watch=lambda s: s.synapses["edges"].weights[0, 0],
    )
    fired = np.flatnonzero(np.asarray(spikes["out"])[:, 0])
    np.testing.assert_array_equal(fired, np.arange(lag, steps, period))
    before = np.flatnonzero(pre[:, 0])

    def trace(times, now, tau, *, own):
        past = times[(times < now) | (own & (times == now))]
        return np.exp(-(now - past) * dt / tau).sum()

    want = 2.0
    for t in range(steps):
        if t in before:
            o1 = trace(fired, t, rule.tau_minus, own=True)
            want -= o1 * (rule.a2_minus + rule.a3_minus * trace(before, t, rule.tau_x, own=False))
        if t in fired:
            r1 = trace(before, t, rule.tau_plus, own=True)
            want += r1 * (rule.a2_plus + rule.a3_plus * trace(fired, t, rule.tau_y, own=False))
    np.testing.assert_allclose(w[-1], want, rtol=1e-5)
    assert want > 2.2
