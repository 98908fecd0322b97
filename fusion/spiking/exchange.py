"""Spiking encoders as NIR graphs, the exchange format of neuromorphic tools, and back.

Needs the package `nir` (`pip install "snn-fusion-failure[exchange]"`). NIR's neuron is

.. math:: \\tau \\dot v = v_{leak} - v + R I, \\qquad
    v \\to v_{reset} \\; \\text{where} \\; v > v_{thr}

which is ours with the hard reset and a fixed threshold; others are refused rather than bent. A
synapse with taps becomes one `Delay` and one `Linear` for each tap; NIR has no clocks, so the
strides and the code are kept as metadata of the graph.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from fusion._checks import check_number
from fusion.spiking.codes import code_channels
from fusion.spiking.config import SpikingConfig
from fusion.spiking.drawing import Params, neurons_of


def _nir() -> Any:
    try:
        import nir
    except ImportError as error:
        raise ImportError(
            "the package nir is not installed; pip install 'snn-fusion-failure[exchange]'"
        ) from error
    return nir


def check_exchangeable(config: SpikingConfig) -> None:
    """Refuse neurons that NIR has no equation for.

    Raises:
        ValueError: a soft reset, an adaptive threshold or resonance.
    """
    if config.reset != "hard":
        raise ValueError(
            f"reset={config.reset!r}: expected 'hard', the only reset of NIR's neurons; train with "
            "reset='hard'"
        )
    if config.resonance[1]:
        raise ValueError(
            f"resonance={config.resonance}: expected (0, 0), NIR has no resonating neuron; train "
            "without resonance"
        )
    if config.adaptation:
        raise ValueError(
            f"adaptation={config.adaptation}: expected 0, NIR's thresholds are fixed; train "
            "without adaptation"
        )


def _with_level(kernel: np.ndarray) -> np.ndarray:
    """Rows (tap, channel) out of rows (taps of the distance, level): the level has no delay."""
    rows = np.zeros((2 * (len(kernel) - 1), kernel.shape[1]), np.float32)
    rows[::2], rows[-1] = kernel[:-1], kernel[-1]
    return rows


def to_nir(config: SpikingConfig, layers: Sequence[Params], *, period: float = 1.0) -> Any:
    r"""A NIR graph with one chain of nodes for each sensor.

    Args:
        config: of the stack, with the hard reset and without adaptation.
        layers: `encoder.stack_params` of a trained encoder.
        period: time between samples [s]; time constants and delays are in seconds.

    Returns:
        `nir.NIRGraph`: nodes `sensor0_input`, `sensor0_layer0_delay3`, `sensor0_layer0_tap3`,
        `sensor0_layer0_lif` ..., `sensor0_output`; `nir.write` saves it.

    Raises:
        ImportError: `nir` is not installed.
        ValueError: neurons that NIR has no equation for.
    """
    check_number("period", period, 0.0, above=True, fix="0.02 for 50 samples a second")
    check_exchangeable(config)
    nir = _nir()
    nodes: dict[str, Any] = {}
    edges: list[tuple[str, str]] = []
    for sensor in range(layers[0]["kernel"].shape[0]):
        source = f"sensor{sensor}_input"
        channels = code_channels(config)
        nodes[source] = nir.Input(input_type={"input": np.array([channels])})
        clock = period
        for index, own in enumerate(layers):
            name, taps = f"sensor{sensor}_layer{index}", config.taps[index]
            kernel = np.asarray(own["kernel"][sensor], np.float32)
            width = kernel.shape[1]
            if index == 0 and config.code == "contrast":
                kernel = _with_level(kernel)
            weights = kernel.reshape(taps, -1, width).transpose(0, 2, 1)
            neuron = f"{name}_lif"
            for tap in range(taps):
                late = np.full(weights.shape[2], (taps - 1 - tap) * clock)
                nodes[f"{name}_delay{tap}"] = nir.Delay(delay=late)
                # The bias belongs to the layer, so one tap has it.
                bias = np.asarray(own["bias"][sensor], np.float32)
                nodes[f"{name}_tap{tap}"] = (
                    nir.Affine(weight=weights[tap], bias=bias)
                    if tap == taps - 1
                    else nir.Linear(weight=weights[tap])
                )
                edges += [
                    (source, f"{name}_delay{tap}"),
                    (f"{name}_delay{tap}", f"{name}_tap{tap}"),
                ]
                edges.append((f"{name}_tap{tap}", neuron))
            clock *= config.strides[index]
            leak = np.asarray(neurons_of(config, own, index).leak, np.float32)
            leak = leak[min(sensor, len(leak) - 1)]
            ones = np.ones(width, np.float32)
            nodes[neuron] = nir.LIF(
                tau=clock / leak,
                r=ones,
                v_leak=0.0 * ones,
                v_threshold=config.threshold * ones,
                v_reset=0.0 * ones,
            )
            if "back" in own:
                back = np.asarray(own["back"][sensor], np.float32).T
                nodes[f"{name}_back_delay"] = nir.Delay(delay=np.full(width, clock))
                nodes[f"{name}_back"] = nir.Linear(weight=back)
                edges += [(neuron, f"{name}_back_delay"), (f"{name}_back_delay", f"{name}_back")]
                edges.append((f"{name}_back", neuron))
            source = neuron
        nodes[f"sensor{sensor}_output"] = nir.Output(output_type={"output": np.array([width])})
        edges.append((source, f"sensor{sensor}_output"))
    kept = json.dumps({"period": period, "config": dataclasses.asdict(config)})
    return nir.NIRGraph(nodes, edges, metadata={"fusion_spiking": kept}, type_check=False)


def from_nir(graph: Any) -> tuple[SpikingConfig, list[Params]]:
    """The stack that `to_nir` wrote, from the nodes of the graph.

    Args:
        graph: of `to_nir`, or `nir.read(path)` of one that was saved.

    Returns:
        The configuration, with time constants that are learned (they stand in the nodes), and the
        parameters of its layers.

    Raises:
        ValueError: a graph without our metadata, whose strides and code nobody knows.
    """
    held = graph.metadata.get("fusion_spiking")
    if held is None:
        raise ValueError(
            f"graph.metadata={sorted(graph.metadata)}: expected 'fusion_spiking' of to_nir; a "
            "graph of another tool says nothing of strides and codes, so build it by hand"
        )
    told = json.loads(held.decode() if isinstance(held, bytes) else held)
    values: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v
        for k, v in told["config"].items()
        if k != "learn_tau"
    }
    config = dataclasses.replace(SpikingConfig(), **values, learn_tau=True)
    sensors = sum(name.endswith("_output") for name in graph.nodes)
    layers: list[Params] = []
    clock = told["period"]
    for index, taps in enumerate(config.taps):
        clock *= config.strides[index]
        found: dict[str, list[np.ndarray]] = {"kernel": [], "bias": [], "leak": []}
        for sensor in range(sensors):
            name = f"sensor{sensor}_layer{index}"
            synapses = [graph.nodes[f"{name}_tap{tap}"] for tap in range(taps)]
            kernel = np.concatenate([node.weight.T for node in synapses])
            if index == 0 and config.code == "contrast":
                kernel = np.concatenate([kernel[::2], kernel[-1:]])
            found["kernel"].append(kernel)
            found["bias"].append(synapses[-1].bias)
            leak = clock / graph.nodes[f"{name}_lif"].tau
            found["leak"].append(np.log(leak / (1.0 - leak)))
            if f"{name}_back" in graph.nodes:
                found.setdefault("back", []).append(graph.nodes[f"{name}_back"].weight.T)
        layers.append({k: jnp.asarray(np.stack(v), jnp.float32) for k, v in found.items()})
    return config, layers
