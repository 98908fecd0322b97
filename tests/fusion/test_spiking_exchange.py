"""NIR: a saved graph gives the same spikes, and its equations, stepped by hand, do, too."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.spiking.config import SpikingConfig
from fusion.spiking.drawing import draw_stack
from fusion.spiking.exchange import from_nir, to_nir
from fusion.spiking.layers import feed, stack_start

nir = pytest.importorskip("nir", reason="the package nir is not installed (extra `exchange`)")

CONFIG = SpikingConfig(
    widths=(5, 4), taps=(4, 3), strides=(2, 2), reset="hard", recurrent=True, threshold=0.5
)
LAYERS = draw_stack(CONFIG, 2, key=jax.random.key(0))
X = np.random.default_rng(0).uniform(-1, 1, (2, 3, 24)).astype(np.float32)


def spikes_of(config: SpikingConfig, layers: list) -> np.ndarray:
    """Of the last layer, `[step, sensor, batch, neuron]`."""
    start = stack_start(config, 2, 3)
    return np.asarray(feed(config, layers, start, jnp.asarray(X))[1].spikes[-1])


@pytest.mark.parametrize("code", ["current", "contrast", "delta"])
def test_a_saved_graph_gives_the_same_spikes(code: str, tmp_path: Path) -> None:
    given = dataclasses.replace(CONFIG, code=code)
    drawn = draw_stack(given, 2, key=jax.random.key(1))
    nir.write(tmp_path / "encoder.nir", to_nir(given, drawn, period=0.02))
    config, layers = from_nir(nir.read(tmp_path / "encoder.nir"))
    for own, back in zip(drawn, layers, strict=True):
        assert set(own) == set(back)
        for name in own:
            np.testing.assert_allclose(back[name], own[name], rtol=1e-5, atol=1e-5)
    expected = spikes_of(given, drawn)
    np.testing.assert_array_equal(spikes_of(config, layers), expected)
    assert expected.sum() > 20


def stepped(graph: Any, x: np.ndarray, period: float, clocks: list[float]) -> np.ndarray:
    """Euler steps of a graph's own nodes for sensor 0 and one window; spikes of the last neurons.

    Knows nothing of the exporter but which neurons tick how often: nodes, edges and their
    equations are NIR's.
    """
    nodes, edges = graph.nodes, graph.edges
    mine = [n for n in nodes if n.startswith("sensor0_")]
    trains: dict[str, dict[int, np.ndarray]] = {n: {} for n in mine}
    v = {n: np.zeros(nodes[n].tau.shape) for n in mine if isinstance(nodes[n], nir.LIF)}
    order = sorted(v)
    out = []

    def value(name: str, time: int) -> Any:
        """What a node gives at a time, counted in samples."""
        node = nodes[name]
        if isinstance(node, nir.Input | nir.LIF):
            return trains[name].get(time, 0.0)
        (source,) = [a for a, b in edges if b == name]
        if isinstance(node, nir.Delay):
            return value(source, time - round(float(node.delay[0]) / period))
        given = value(source, time) * np.ones(node.weight.shape[1])
        return node.weight @ given + (node.bias if isinstance(node, nir.Affine) else 0.0)

    for time, sample in enumerate(x):
        trains["sensor0_input"][time] = np.array([sample])
        for name, clock in zip(order, clocks, strict=True):
            ticks = round(clock / period)
            if (time + 1) % ticks:
                continue
            node = nodes[name]
            current = sum(value(a, time) for a, b in edges if b == name)
            v[name] += clock / node.tau * (node.v_leak - v[name] + node.r * current)
            fired = v[name] > node.v_threshold
            v[name] = np.where(fired, node.v_reset, v[name])
            trains[name][time] = fired.astype(float)
            if name == order[-1]:
                out.append(trains[name][time])
    return np.array(out)


def test_the_equations_of_the_graph_give_our_spikes() -> None:
    graph = to_nir(CONFIG, LAYERS, period=0.02)
    ours = spikes_of(CONFIG, LAYERS)
    theirs = stepped(graph, X[0, 0], 0.02, [0.04, 0.08])
    np.testing.assert_array_equal(theirs, ours[:, 0, 0])
    assert theirs.sum() > 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reset": "soft"}, "reset='soft': expected 'hard'"),
        ({"adaptation": 0.2}, "adaptation=0.2"),
        ({"resonance": (0.1, 0.2)}, "resonance="),
    ],
)
def test_neurons_that_nir_has_no_equation_for_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        to_nir(SpikingConfig(**{"reset": "hard"} | changes), LAYERS)


def test_a_graph_of_another_tool_is_refused() -> None:
    with pytest.raises(ValueError, match="expected 'fusion_spiking'"):
        from_nir(nir.NIRGraph({}, [], metadata={}, type_check=False))
