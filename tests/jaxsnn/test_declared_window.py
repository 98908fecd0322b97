"""Windows of declared networks: the same spikes and eligibility as `step`, and as S4 by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import declared, network, poisson_spikes
from jaxsnn.config import Weights
from jaxsnn.presets import preset

STEPS = 40
CONFIG, PARAMS = preset(
    "S4", "literal",
    config={"hidden_exc": 8, "hidden_inh": 8, "group_exc": 2, "group_inh": 2,
            "control_steps": STEPS, "hold_steps": STEPS},
    params={"gamma": 0.02, "gain_input": 4.0, "gain_output": 3.0, "w_max_low": 5.0},
)  # fmt: skip


def s4(gamma=0.02, **second):
    """The structure of S4 with the sizes of CONFIG."""
    sign_in = np.tile(np.repeat([1, -1], 2), 7)
    sign_hidden = np.tile(np.repeat([1, -1], 4), 2)
    rule = declared.RewardSTDP(gamma=gamma, dependence="multiplicative")
    table = (np.arange(16) // 8)[:, None] == np.arange(2)
    return declared.declare(
        {
            "sensors": declared.Input(28, sign_in),
            "hidden": declared.Population(16, sign_hidden),
            "motors": declared.Population(2),
        },
        {
            "first": declared.Projection("sensors", "hidden", 2.0, rule=rule, gain=4.0),
            "second": declared.Projection(
                "hidden", "motors", 2.0, **{"connect": table, "rule": rule, "gain": 3.0} | second
            ),
        },
    )


def begun(net, weights):
    state = declared.init(jax.random.key(0), net)
    spread = jnp.zeros((16, 2)).at[jnp.arange(16), jnp.arange(16) // 8].set(weights.output.ravel())
    synapses = dict(state.synapses)
    for name, w in (("first", weights.hidden), ("second", spread)):
        synapses[name] = synapses[name]._replace(weights=w)
    return state._replace(synapses=synapses)


@pytest.fixture(scope="module")
def two_windows():
    net = s4()
    constants = declared.constants(net)
    start = network.init(jax.random.key(1), CONFIG, PARAMS)
    pre = poisson_spikes(jnp.full(28, 80.0), 2 * STEPS, dt=net.dt, key=jax.random.key(2))
    reward = jnp.array([1.0, -0.5])

    @jax.jit
    def by_hand(state, pre):
        kernel = network.kernel(CONFIG, PARAMS)
        seen = []
        for part in (pre[:STEPS], pre[STEPS:]):
            state, held, spikes = network.window(CONFIG, PARAMS, kernel, state, part)
            weights = network.reinforce(CONFIG, PARAMS, state.weights, held, reward)
            state = state._replace(weights=weights)
            seen.append(spikes)
        return state, seen

    @jax.jit
    def declared_windows(state, pre):
        kernels = declared.window_kernels(net, constants, STEPS)
        sign_in, sign_hidden = (
            jnp.asarray(net.edges[n].sign, jnp.float32) for n in ("first", "second")
        )
        to_hidden = jnp.repeat(reward, 8) * sign_hidden
        rewards = {
            "first": sign_in[:, None] * to_hidden,
            "second": sign_hidden[:, None] * reward,
        }
        seen = []
        for part in (pre[:STEPS], pre[STEPS:]):
            state, held, spikes = declared.window(net, constants, kernels, state, {"sensors": part})
            state = declared.reinforce(net, constants, state, held, rewards)
            seen.append(spikes)
        return state, seen

    return by_hand(start, pre), declared_windows(begun(net, start.weights), pre)


@pytest.mark.slow
def test_a_window_is_its_steps_with_the_weights_held():
    net = s4()
    constants = declared.constants(net)
    pre = poisson_spikes(jnp.full(28, 80.0), STEPS, dt=net.dt, key=jax.random.key(2))

    @jax.jit
    def stepped(state, pre):
        still = s4(gamma=0.0)
        inputs = {"sensors": pre, "first": jnp.zeros(len(pre)), "second": jnp.zeros(len(pre))}
        return declared.run(
            still, declared.constants(still), state, inputs,
            watch=lambda s: s.synapses["first"].rule.z,
        )  # fmt: skip

    @jax.jit
    def one(state, pre):
        kernels = declared.window_kernels(net, constants, STEPS)
        return declared.window(net, constants, kernels, state, {"sensors": pre})

    begin = begun(net, network.init(jax.random.key(1), CONFIG, PARAMS).weights)
    state, eligibility, spikes = one(begin, pre)
    last, fired, z = stepped(begin, pre)
    assert int(state.clock) == int(last.clock) == STEPS
    for name in ("hidden", "motors"):
        np.testing.assert_array_equal(spikes[name], fired[name])
        assert fired[name].any()
        np.testing.assert_allclose(
            state.membranes[name].v, last.membranes[name].v, rtol=1e-5, atol=1e-5
        )
    np.testing.assert_allclose(eligibility["first"], z.sum(axis=0) * 1e-3, rtol=1e-4, atol=1e-5)
    for a, b in zip(state.synapses["first"].rule, last.synapses["first"].rule, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


def test_s4_declared_is_s4_by_hand(two_windows):
    (hand, spikes), (state, seen) = two_windows
    for ours, theirs in zip(seen, spikes, strict=True):
        np.testing.assert_array_equal(ours["hidden"], theirs.hidden)
        np.testing.assert_array_equal(ours["motors"], theirs.output)
    weights = Weights(
        state.synapses["first"].weights,
        state.synapses["second"].weights[np.arange(16), np.arange(16) // 8].reshape(2, 8),
    )
    for ours, theirs in zip(weights, hand.weights, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=2e-5, atol=2e-5)
    assert float(jnp.abs(state.synapses["second"].weights[:8, 1]).max()) == 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"delay": 3}, r"projections\['second'\].delay=3: expected 1 in windows; use step"),
        ({"receptor": declared.Exponential()}, "receptor=Exponential: expected Delta"),
        ({"rule": declared.PairSTDP()}, "rule=PairSTDP: expected RewardSTDP or none"),
    ],
)
def test_networks_without_a_window_form_are_refused(change, words):
    net = s4(**change)
    with pytest.raises(ValueError, match=words):
        declared.window_kernels(net, declared.constants(net), STEPS)


def test_what_is_missing_is_named():
    net = s4()
    state, constants = declared.init(jax.random.key(0), net), declared.constants(net)
    with pytest.raises(ValueError, match=r"inputs=\[\]: expected \['sensors'\] as well"):
        declared.window(net, constants, {}, state, {})
    with pytest.raises(ValueError, match=r"rewards=\[\]: expected \['first'\] as well"):
        declared.reinforce(net, constants, state, {"first": jnp.zeros((28, 16))}, {})
