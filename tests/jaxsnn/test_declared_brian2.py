"""Each model of `jaxsnn.declared` against the recording of Brian 2 (tests/reference)."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import declared as d
from tests._recordings import assert_recording_is_made_again

REFERENCE = Path(__file__).resolve().parent.parent / "reference" / "snn_models_brian2.py"
TIGHT = 1e-11
"""Of the range of a quantity: both sides compute in float64, over a thousand steps."""


def load(path: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def recipe():
    return load(REFERENCE)


@pytest.fixture(scope="module")
def data(golden):
    return dict(np.load(golden / "snn_models_brian2.npz"))


def lif(recipe, method: str, t_ref: float) -> d.LIF:
    return d.LIF(**recipe.LIF, t_ref=t_ref, method=method)


def simulate(net: d.Wiring, inputs, names, dtype=np.float64):
    """Spikes, potentials and last state, all as numpy."""
    state = d.init(jax.random.key(0), net)
    inputs = {name: jnp.asarray(value, dtype) for name, value in inputs.items()}

    def watch(s):
        return {name: s.membranes[name].v for name in names}

    run = jax.jit(lambda s, x: d.run(net, d.constants(net), s, x, watch=watch))
    state, spikes, v = jax.tree.map(np.asarray, run(state, inputs))
    return state, spikes, v


def worst(got, want) -> float:
    """Largest difference as a share of the range of what is wanted."""
    return float(np.abs(got - want).max() / np.ptp(want))


def check(recipe, data, name, spikes, v) -> None:
    assert data[f"{name}_spikes"].sum() > 20
    np.testing.assert_array_equal(spikes[name], data[f"{name}_spikes"], err_msg=name)
    assert worst(v[name][:: recipe.EVERY], data[f"{name}_v"]) < TIGHT, name


def test_neurons_and_delays_are_those_of_brian2(recipe, data) -> None:
    cells = {
        "euler": lif(recipe, "euler", recipe.T_REF["euler"]),
        "exact": lif(recipe, "exact", recipe.T_REF["exact"]),
        "adaptive": d.AdaptiveLIF(
            **recipe.LIF, **recipe.ADAPTIVE, t_ref=recipe.T_REF["adaptive"], method="exact"
        ),
        "izhikevich": d.Izhikevich(**recipe.IZHIKEVICH),
    }
    n = recipe.N_OUT
    parts = {name: d.Population(n, neuron=model) for name, model in cells.items()}
    projections = {
        f"to_{name}": d.Projection("in", name, data["in_weight"], delay=data["in_delay"])
        for name in cells
    }
    projections["back"] = d.Projection(
        "euler", "exact", data["in_weight_back"], connect=data["in_table"]
    )
    projections["round"] = d.Projection("exact", "exact", data["in_weight_back"], delay=4)
    currents = {name: np.tile(data["in_current"], (recipe.STEPS, 1)) for name in cells}
    with jax.enable_x64(True):
        source = d.Input(recipe.N_IN, data["in_sign"])
        net = d.declare({"in": source, **parts}, projections, dt=recipe.DT)
        _, spikes, v = simulate(net, {"in": data["in_pre"], **currents}, cells)
    for name in cells:
        check(recipe, data, name, spikes, v)


def test_receptors_and_short_term_plasticity_are_those_of_brian2(recipe, data) -> None:
    weight, axon = data["in_weight"], data["in_delay_axon"]
    tau, reversal = recipe.TAU_SYN, recipe.REVERSAL
    parts = {
        "receptors": d.Population(recipe.N_OUT, neuron=lif(recipe, "exact", recipe.T_REF["euler"])),
        "short_term": d.Population(
            recipe.N_OUT, neuron=lif(recipe, "exact", recipe.T_REF["euler"])
        ),
    }
    projections = {
        "current": d.Projection(
            "in", "receptors", weight, delay=axon, receptor=d.Exponential(tau["current"])
        ),
        "excite": d.Projection(
            "in", "receptors", 0.15 * weight, delay=2, sign=1,
            receptor=d.Conductance(tau["excite"], reversal["excite"]),
        ),
        "inhibit": d.Projection(
            "in", "receptors", 0.03 * weight, delay=data["in_delay"], sign=1,
            receptor=d.Conductance(tau["inhibit"], reversal["inhibit"]),
        ),
        "tired": d.Projection(
            "in", "short_term", weight, delay=axon, sign=1, gain=6.0,
            short_term=d.TsodyksMarkram(**recipe.SHORT),
        ),
    }  # fmt: skip
    with jax.enable_x64(True):
        source = d.Input(recipe.N_IN, data["in_sign"])
        net = d.declare({"in": source, **parts}, projections, dt=recipe.DT)
        state, spikes, v = simulate(net, {"in": data["in_pre"]}, parts)
    for name in parts:
        check(recipe, data, name, spikes, v)
    short = state.synapses["tired"].short_term
    assert worst(short.u[:, 0], data["short_u"]) < TIGHT
    assert worst(short.x[:, 0], data["short_x"]) < TIGHT


def test_learning_rules_are_those_of_brian2(recipe, data) -> None:
    bound = {"w_max": recipe.W_MAX}
    learn = {
        "pair": d.PairSTDP(**recipe.PAIR, **bound),
        "pair_soft": d.PairSTDP(
            **recipe.SHARE, **bound, dependence="multiplicative", bounds="soft"
        ),
        "triplet": d.TripletSTDP(**recipe.TRIPLET, **bound),
        "reward_soft": d.RewardSTDP(**recipe.REWARD, **bound, bounds="soft"),
        "reward_times": d.RewardSTDP(**recipe.REWARD, **bound, dependence="multiplicative"),
    }
    assert tuple(learn) == recipe.RULES
    delays = {"pair": data["in_delay"], "triplet": data["in_delay_axon"]}
    populations: dict = {"in": d.Input(recipe.N_IN), "teacher": d.Input(recipe.N_OUT)}
    projections, rewards = {}, {}
    for name, rule in learn.items():
        populations[name] = d.Population(
            recipe.N_OUT, neuron=lif(recipe, "euler", recipe.T_REF["euler"])
        )
        projections[f"teach_{name}"] = d.Projection(
            "teacher", name, recipe.TEACHER, connect="one_to_one"
        )
        projections[f"learn_{name}"] = d.Projection(
            "in", name, data["in_weight"], delay=delays.get(name, 3), rule=rule
        )
        if rule.rewarded:
            rewards[f"learn_{name}"] = data["in_reward"]
    with jax.enable_x64(True):
        net = d.declare(populations, projections, dt=recipe.DT)
        inputs = {"in": data["in_pre"], "teacher": data["in_teacher"], **rewards}
        state, spikes, v = simulate(net, inputs, learn)
    for name in learn:
        check(recipe, data, name, spikes, v)
        got, want = state.synapses[f"learn_{name}"].weights, data[f"{name}_w"]
        assert worst(got, want) < TIGHT, name
        # The weights do move, so that equality says something.
        assert np.abs(want - data["in_weight"]).mean() > 0.05, name


@pytest.mark.parametrize("rule", ["additive", "multiplicative"])
def test_the_structure_of_s4_declared_is_the_recorded_network(golden, rule) -> None:
    """The other recording: 42 inputs, 16 hidden in two halves, two motors."""
    old = load(REFERENCE.parent / "snn_brian2.py")
    data = np.load(golden / "snn_brian2.npz")
    half = old.N_HIDDEN // 2
    motor = np.arange(old.N_HIDDEN) // half
    cell = d.LIF(**old.LIF)
    learn = d.RewardSTDP(**old.STDP, gamma=old.GAMMA, w_max=old.W_MAX, dependence=rule)
    to_motor = data["in_w_output"].ravel()[:, None] * np.ones(2)
    signs, hidden = data["in_sign_pre"], data["in_sign_hidden"]
    with jax.enable_x64(True):
        net = d.declare(
            {
                "in": d.Input(old.N_IN, signs),
                "hidden": d.Population(old.N_HIDDEN, hidden, cell),
                "motor": d.Population(2, neuron=cell),
            },
            {
                "first": d.Projection(
                    "in", "hidden", data["in_w_hidden"], rule=learn, gain=old.GAIN_INPUT
                ),
                "second": d.Projection(
                    "hidden", "motor", to_motor, connect=motor[:, None] == np.arange(2),
                    rule=learn, gain=old.GAIN_OUTPUT,
                ),
            },
            dt=old.DT,
        )  # fmt: skip
        reward = data["in_reward"]
        credit = signs[:, None] * hidden[None, :]
        inputs = {
            "in": data["in_pre"],
            "first": reward[:, None, motor] * credit[None],
            "second": reward[:, None, :] * hidden[None, :, None],
        }
        state, spikes, _ = simulate(net, inputs, ("motor",))
    np.testing.assert_array_equal(spikes["hidden"], data[f"{rule}_spikes_hidden"])
    np.testing.assert_array_equal(spikes["motor"], data[f"{rule}_spikes_output"])
    assert worst(state.synapses["first"].weights, data[f"{rule}_w_hidden"]) < TIGHT
    second = state.synapses["second"].weights[np.arange(old.N_HIDDEN), motor].reshape(2, half)
    assert worst(second, data[f"{rule}_w_output"]) < TIGHT


def test_in_single_precision_potentials_stay_near_brian2(recipe, data) -> None:
    """Until a spike falls into another step; here none does in the first 100 ms."""
    steps = 200
    cell = lif(recipe, "exact", recipe.T_REF["exact"])
    net = d.declare(
        {
            "in": d.Input(recipe.N_IN, data["in_sign"]),
            "adaptive": d.Population(
                recipe.N_OUT,
                neuron=d.AdaptiveLIF(
                    **recipe.LIF, **recipe.ADAPTIVE, t_ref=recipe.T_REF["adaptive"],
                    method=cell.method,
                ),
            ),
        },
        {"edges": d.Projection("in", "adaptive", data["in_weight"], delay=data["in_delay"])},
        dt=recipe.DT,
    )  # fmt: skip
    inputs = {
        "in": data["in_pre"][:steps],
        "adaptive": np.tile(data["in_current"], (steps, 1)),
    }
    _, spikes, v = simulate(net, inputs, ("adaptive",), np.float32)
    np.testing.assert_array_equal(spikes["adaptive"], data["adaptive_spikes"][:steps])
    want = data["adaptive_v"][: steps // recipe.EVERY]
    assert worst(v["adaptive"][:: recipe.EVERY], want) < 1e-5


@pytest.mark.slow
def test_the_recording_can_be_made_again(golden, tmp_path) -> None:
    """With an interpreter that has Brian 2, the script gives the recorded numbers."""
    recorded = golden / "snn_models_brian2.npz"
    assert_recording_is_made_again(REFERENCE, recorded, tmp_path, tolerance=1e-9)
