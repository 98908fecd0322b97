"""Trained networks S1-S4 as NIR graphs, the exchange format of neuromorphic tools, and back.

Needs the package `nir` (`pip install "snn-fusion-failure[exchange]"`). NIR's neuron is

.. math:: \\tau \\dot v = v_{leak} - v + R I, \\qquad
    v \\to v_{reset} \\; \\text{where} \\; v > v_{thr}

which is Eq. 2.1 of the source without its refractory time. A spike is a current of 1 for one step
`dt`, so `R = g tau / dt` with the layer's gain `g` makes a weight the jump of the potential that it
is here. Weights carry the sign of their presynaptic neuron (Dale's law). NIR does not say in what
order a step is done; here it is leak, threshold, jumps, reset (`neurons.lif_step`).
"""

from __future__ import annotations

import itertools
import json
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from jaxsnn._checks import concrete, require, require_choice
from jaxsnn.config import (
    NetworkConfig,
    NetworkParams,
    Weights,
    check_network,
    neuron_signs,
)
from jaxsnn.network_state import check_weights
from jaxsnn.neurons import LIFParams

LAYERS = ("hidden", "output")
GAINS = {"hidden": "gain_input", "output": "gain_output"}
NEURON = {
    "tau_m": "tau",
    "v_rest": "v_leak",
    "v_reset": "v_reset",
    "v_th": "v_threshold",
}
"""Field of LIFParams -> field of NIR's neuron."""


def _nir() -> Any:
    try:
        import nir
    except ImportError as error:
        raise ImportError(
            "the package nir is not installed; pip install 'snn-fusion-failure[exchange]'"
        ) from error
    return nir


def _signed(config: NetworkConfig, weights: Weights) -> dict[str, Any]:
    """Both layers' weights [mV], rows postsynaptic: `[n_hidden, n_in]` and `[2, n_hidden]`."""
    sign_in, sign_hidden = neuron_signs(config)
    hidden, halves = (np.asarray(leaf) for leaf in weights)
    motors = np.zeros((2, config.n_hidden), halves.dtype)
    motors[0, : config.n_half], motors[1, config.n_half :] = halves
    return {"hidden": hidden.T * sign_in[None, :], "output": motors * sign_hidden[None, :]}


def _neuron(nir: Any, layer: LIFParams, gain: float, n: int, dt: float) -> Any:
    ones = np.ones(n)
    return nir.LIF(
        tau=layer.tau_m * ones,
        r=gain * layer.tau_m / dt * ones,
        v_leak=layer.v_rest * ones,
        v_threshold=layer.v_th * ones,
        v_reset=layer.v_reset * ones,
    )


def to_nir(
    config: NetworkConfig,
    params: NetworkParams,
    weights: Weights,
    *,
    refractory: Literal["refuse", "note"] = "refuse",
) -> Any:
    """A trained network as a NIR graph: input, hidden layer, two motors.

    Args:
        config: NetworkConfig.
        params: NetworkParams, of one network: every constant one number.
        weights: of one network, `state.weights` after training.
        refractory: NIR has no refractory time. "refuse" a network that has one, or "note" it in
            the graph's metadata: a tool that does not read them lets neurons fire too fast.

    Returns:
        `nir.NIRGraph` with nodes `input`, `hidden_weights`, `hidden`, `output_weights`, `output`
        (the motors' neurons) and `motors`; `nir.write(path, graph)` saves it.

    Raises:
        ImportError: `nir` is not installed.
        ValueError: constants of more than one network, weights that do not fit, or a refractory
            time that was not to be noted.

    Source: Pedersen et al. (2024), Neuromorphic intermediate representation, Nature Communications.
    """
    require_choice("refractory", refractory, ("refuse", "note"))
    check_network(config, params)
    times = {}
    for name in LAYERS:
        layer: LIFParams = getattr(params, name)
        for field in LIFParams._fields:
            _require_one(f"{name}.{field}", getattr(layer, field))
        times[name] = float(layer.t_ref)
    for field in GAINS.values():
        _require_one(field, getattr(params, field))
    check_weights(config, params, weights)
    require(
        refractory == "note" or not any(times.values()),
        f"t_ref={times}: expected 0, NIR's neurons have no refractory time; say refractory='note' "
        "to keep it as metadata, which other tools do not read",
    )
    nir = _nir()
    signed = _signed(config, weights)
    sizes = {"input": config.n_in, "hidden": config.n_hidden, "output": 2}
    nodes = {
        "input": nir.Input(input_type={"input": np.array([sizes["input"]])}),
        "motors": nir.Output(output_type={"output": np.array([sizes["output"]])}),
    }
    for name in LAYERS:
        nodes[f"{name}_weights"] = nir.Linear(weight=signed[name])
        gain = getattr(params, GAINS[name])
        nodes[name] = _neuron(nir, getattr(params, name), gain, sizes[name], config.dt)
    chain = ("input", "hidden_weights", "hidden", "output_weights", "output", "motors")
    told = {"dt": config.dt, "t_ref": times}
    edges = list(itertools.pairwise(chain))
    return nir.NIRGraph(nodes, edges, metadata={"jaxsnn_network": json.dumps(told)})


def _require_one(name: str, value: Any) -> None:
    found = concrete(value)
    require(
        found is not None and found.ndim == 0,
        f"{name}=<shape {np.shape(value)}>: expected one number; take one network's constants",
    )


def from_nir(
    graph: Any, config: NetworkConfig, params: NetworkParams
) -> tuple[NetworkParams, Weights]:
    """Constants of the neurons and weights out of a graph of `to_nir`.

    Args:
        graph: of `to_nir`, or `nir.read(path)` of one that was saved; a tool may have changed the
            weights and the neurons of its nodes.
        config: NetworkConfig of the network that was written.
        params: NetworkParams for all that NIR has no node for: plasticity, rewards, bounds.

    Returns:
        `params` with the neurons and gains of the graph, and the weights, magnitudes [mV].

    Raises:
        ValueError: a graph without our metadata, of another size or step, or with a weight whose
            sign is not that of its presynaptic neuron.
    """
    held = graph.metadata.get("jaxsnn_network")
    require(
        held is not None,
        f"graph.metadata={sorted(graph.metadata)}: expected 'jaxsnn_network' of to_nir; a graph of "
        "another tool says nothing of gains and steps, so build it by hand",
    )
    told = json.loads(held.decode() if isinstance(held, bytes) else held)
    require(
        told["dt"] == config.dt,
        f"dt={config.dt}: expected {told['dt']}, the step of the graph; use its configuration",
    )
    sizes = {"hidden": (config.n_hidden, config.n_in), "output": (2, config.n_hidden)}
    signed = {name: np.asarray(graph.nodes[f"{name}_weights"].weight) for name in LAYERS}
    for name, shape in sizes.items():
        require(
            signed[name].shape == shape,
            f"graph.nodes[{name}_weights]=<shape {signed[name].shape}>: expected {shape}; use the "
            "configuration of the network that was written",
        )
    read = params
    for name in LAYERS:
        node = graph.nodes[name]
        neuron = {ours: _constant(name, theirs, node) for ours, theirs in NEURON.items()}
        layer = getattr(params, name)._replace(**neuron, t_ref=told["t_ref"][name])
        gain = _constant(name, "r", node) * config.dt / layer.tau_m
        read = read._replace(**{name: layer, GAINS[name]: gain})
    weights = _magnitudes(config, signed)
    check_weights(config, read, weights)
    return read, weights


def _constant(name: str, field: str, node: Any) -> float:
    values = np.unique(getattr(node, field))
    require(
        len(values) == 1,
        f"graph.nodes[{name}].{field}=<{len(values)} values>: expected one for the layer; give "
        "all of its neurons the same",
    )
    return float(values[0])


def _magnitudes(config: NetworkConfig, signed: dict[str, Any]) -> Weights:
    sign_in, sign_hidden = neuron_signs(config)
    hidden = signed["hidden"].T * sign_in[:, None]
    motors = signed["output"] * sign_hidden[None, :]
    for name, found in (("hidden", hidden), ("output", motors)):
        require(
            bool((found >= 0).all()),
            f"graph.nodes[{name}_weights]=<{int((found < 0).sum())} weights>: expected the sign of "
            "the presynaptic neuron (Dale's law); set them to 0",
        )
    half = config.n_half
    crossed = int(np.count_nonzero(motors[0, half:]) + np.count_nonzero(motors[1, :half]))
    require(
        crossed == 0,
        f"graph.nodes[output_weights]=<{crossed} weights>: expected 0 from the hidden neurons of "
        "the other motor; set them to 0",
    )
    halves = np.stack([motors[0, :half], motors[1, half:]])
    return Weights(hidden=jnp.asarray(hidden), output=jnp.asarray(halves))
