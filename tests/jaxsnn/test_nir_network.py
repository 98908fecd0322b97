"""NIR: a saved network drives as before, and the graph's own equations give the same spikes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import network
from jaxsnn.config import NetworkConfig, NetworkParams, network_config, network_params
from jaxsnn.nir_network import from_nir, to_nir

nir = pytest.importorskip("nir", reason="the package nir is not installed (extra `exchange`)")

CONFIG = network_config("S4", hidden_exc=12, hidden_inh=8, group_exc=4, group_inh=2)
PARAMS = network_params(CONFIG, gain_input=1.5, gain_output=3.0)
STATE = network.init(jax.random.key(0), CONFIG, PARAMS)
INPUTS = np.random.default_rng(1).random((400, CONFIG.n_in)) < 0.15


def spikes_of(config: NetworkConfig, params: NetworkParams, weights: Any) -> list[np.ndarray]:
    state = network.init(jax.random.key(0), config, params, weights)
    found = network.fire(config, params, state, jnp.asarray(INPUTS, jnp.float32))[1]
    return [np.asarray(train) for train in found]


def stepped(graph: Any, dt: float, t_ref: float = 0.0) -> list[np.ndarray]:
    """Euler steps of the graph's own nodes: leak, threshold, jumps, reset; spikes of both layers.

    Knows nothing of the exporter but that order: nodes and their equations are NIR's.
    """
    layers = [graph.nodes["hidden"], graph.nodes["output"]]
    joints = [graph.nodes["hidden_weights"].weight, graph.nodes["output_weights"].weight]
    v = [layer.v_leak.copy() for layer in layers]
    rest = [np.zeros(len(x)) for x in v]
    steps = round(t_ref / dt)
    found: list[list[np.ndarray]] = [[], []]
    for row in INPUTS:
        arriving = row.astype(float)
        for i, (layer, joint) in enumerate(zip(layers, joints, strict=True)):
            rest[i] = np.maximum(rest[i] - 1, 0)
            free = rest[i] == 0
            v[i] += np.where(free, dt / layer.tau * (layer.v_leak - v[i]), 0.0)
            fired = free & (v[i] > layer.v_threshold)
            v[i] += np.where(free, dt / layer.tau * layer.r * (joint @ arriving), 0.0)
            v[i] = np.where(fired, layer.v_reset, v[i])
            rest[i][fired] = steps
            arriving = fired.astype(float)
            found[i].append(arriving)
    return [np.array(train) for train in found]


def test_a_saved_network_fires_as_before(tmp_path: Path) -> None:
    graph = to_nir(CONFIG, PARAMS, STATE.weights, refractory="note")
    nir.write(tmp_path / "s4.nir", graph)
    # Neurons that the reader does not know yet, from the file.
    other = network_params(CONFIG)._replace(hidden=PARAMS.hidden._replace(v_th=99.0))
    params, weights = from_nir(nir.read(tmp_path / "s4.nir"), CONFIG, other)
    for own, back in zip(STATE.weights, weights, strict=True):
        np.testing.assert_array_equal(own, back)
    expected = spikes_of(CONFIG, PARAMS, STATE.weights)
    for train, again in zip(expected, spikes_of(CONFIG, params, weights), strict=True):
        np.testing.assert_array_equal(again, train)
    assert expected[0].sum() > 100 and expected[1].sum() > 5


@pytest.mark.parametrize("t_ref", [0.0, 3e-3])
def test_the_equations_of_the_graph_give_our_spikes(t_ref: float) -> None:
    params = PARAMS._replace(
        hidden=PARAMS.hidden._replace(t_ref=t_ref), output=PARAMS.output._replace(t_ref=t_ref)
    )
    graph = to_nir(CONFIG, params, STATE.weights, refractory="note" if t_ref else "refuse")
    ours = spikes_of(CONFIG, params, STATE.weights)
    for expected, found in zip(ours, stepped(graph, CONFIG.dt, t_ref), strict=True):
        np.testing.assert_array_equal(found, expected)
    if t_ref:
        # What a tool makes of it that has no refractory time.
        assert stepped(graph, CONFIG.dt)[0].sum() > ours[0].sum()


def test_what_nir_cannot_say_is_refused() -> None:
    with pytest.raises(ValueError, match="no refractory time; say refractory='note'"):
        to_nir(CONFIG, PARAMS, STATE.weights)
    several = PARAMS._replace(gain_output=jnp.ones(4))
    with pytest.raises(ValueError, match=r"gain_output=<shape \(4,\)>: expected one number"):
        to_nir(CONFIG, several, STATE.weights, refractory="note")


def test_a_graph_that_is_no_such_network_is_refused() -> None:
    with pytest.raises(ValueError, match="expected 'jaxsnn_network'"):
        from_nir(nir.NIRGraph({}, [], metadata={}, type_check=False), CONFIG, PARAMS)
    graph = to_nir(CONFIG, PARAMS, STATE.weights, refractory="note")
    larger = network_config("S4", hidden_exc=14, hidden_inh=8, group_exc=4, group_inh=2)
    with pytest.raises(ValueError, match=r"hidden_weights.*expected \(22, "):
        from_nir(graph, larger, PARAMS)
    graph.nodes["hidden_weights"].weight[3, 0] *= -1.0
    with pytest.raises(ValueError, match="<1 weights>: expected the sign"):
        from_nir(graph, CONFIG, PARAMS)
    graph = to_nir(CONFIG, PARAMS, STATE.weights, refractory="note")
    graph.nodes["hidden"].tau[2] = 1.0
    with pytest.raises(ValueError, match="expected one for the layer"):
        from_nir(graph, CONFIG, PARAMS)
