"""One second of a small S3 / S4 network against the recording of Brian 2 (tests/reference)."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import network
from jaxsnn.config import NetworkConfig, Weights, network_params, neuron_signs
from jaxsnn.plasticity import STDPParams
from tests._recordings import assert_recording_is_made_again

REFERENCE = Path(__file__).resolve().parent.parent / "reference" / "snn_brian2.py"


@pytest.fixture(scope="module")
def recipe():
    spec = importlib.util.spec_from_file_location("snn_brian2", REFERENCE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(recipe, data, rule: str, dtype):
    config = NetworkConfig(
        rule=rule, hidden_exc=8, hidden_inh=8, group_exc=3, group_inh=3, w_max_split="post"
    )
    signs = np.concatenate([data["in_sign_pre"], data["in_sign_hidden"]])
    assert np.array_equal(np.concatenate(neuron_signs(config)), signs)
    params = network_params(
        config,
        stdp=STDPParams(**recipe.STDP),
        gamma=recipe.GAMMA,
        w_max_low=recipe.W_MAX,
        gain_input=recipe.GAIN_INPUT,
        gain_output=recipe.GAIN_OUTPUT,
    )
    params = jax.tree.map(lambda x: jnp.asarray(x, dtype), params)
    state = network.init(jax.random.key(0), config, network_params(config))
    weights = Weights(data["in_w_hidden"], data["in_w_output"])
    state = jax.tree.map(lambda x: jnp.asarray(x, dtype), state._replace(weights=weights))

    def body(carry, xs):
        carry, spikes = network.step(config, params, carry, *xs)
        return carry, (spikes, carry.hidden.v, carry.output.v)

    xs = jnp.asarray(data["in_pre"], dtype), jnp.asarray(data["in_reward"], dtype)
    return jax.jit(lambda s, x: jax.lax.scan(body, s, x))(state, xs)


@pytest.mark.relaxed  # spikes are float32 numbers 0 and 1 also when the rest is float64
@pytest.mark.parametrize("rule", ["additive", "multiplicative"])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_brian2_parity(recipe, golden, rule, dtype):
    data = np.load(golden / "snn_brian2.npz")
    want = {k.removeprefix(f"{rule}_"): data[k] for k in data if k.startswith(rule)}
    with jax.enable_x64(dtype == "float64"):
        out = jax.tree.map(np.asarray, run(recipe, data, rule, dtype))
    state, (spikes, v_hidden, v_output) = out
    assert want["spikes_hidden"].sum() > 100 and want["spikes_output"].sum() > 10
    np.testing.assert_array_equal(spikes.hidden > 0, want["spikes_hidden"])
    np.testing.assert_array_equal(spikes.output > 0, want["spikes_output"])
    for name, got in (("v_hidden", v_hidden[:, ::4]), ("v_output", v_output)):
        span = np.abs(want[name]).max()
        np.testing.assert_allclose(got, want[name], rtol=0, atol=1e-5 * span)
    np.testing.assert_allclose(state.weights.hidden, want["w_hidden"], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(state.weights.output, want["w_output"], rtol=1e-5, atol=1e-5)
    scale = np.abs(want["z_hidden"]).max()
    np.testing.assert_allclose(state.stdp_hidden.z, want["z_hidden"], rtol=0, atol=1e-5 * scale)
    scale = np.abs(want["z_output"]).max()
    np.testing.assert_allclose(
        state.stdp_output.z[..., 0], want["z_output"], rtol=0, atol=1e-5 * scale
    )
    moved = np.abs(want["w_hidden"] - data["in_w_hidden"]).mean()
    assert moved > 0.05  # the weights do change, so that parity says something


@pytest.mark.slow
def test_recording_can_be_made_again(golden, tmp_path):
    """With an interpreter that has Brian 2, the recording script gives the recorded numbers."""
    recorded = golden / "snn_brian2.npz"
    assert_recording_is_made_again(REFERENCE, recorded, tmp_path, tolerance=1e-6)
