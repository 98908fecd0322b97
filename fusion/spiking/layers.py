"""Layers of spiking neurons: delayed synapses, neurons, recurrence, and what they carry on.

Arrays have time first, `[time, sensor, batch, ...]`; all sensors are one batched matrix product.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fusion.spiking.codes import CodeState, code_channels, code_start, encode
from fusion.spiking.config import SpikingConfig
from fusion.spiking.drawing import Params, neurons_of
from fusion.spiking.neurons import NeuronState, neuron_step, rest

GAIN = 4.0
"""Rates of sparse neurons lie far below one; features are that many times larger."""


class StackState(NamedTuple):
    """What a stack remembers of the samples before.

    `code` of the code; `heard` for each layer the inputs that its delays still reach
    `[taps - stride, sensor, batch, channel]`; `neurons` of each layer; `total` the sum of what is
    read, and `steps` how many steps of the last layer that was.
    """

    code: CodeState
    heard: tuple[Float[Array, "d k b c"], ...]
    neurons: tuple[NeuronState, ...]
    total: Float[Array, "k b r"]
    steps: Array


class Activity(NamedTuple):
    """Input and output of each layer: what cost and plasticity are computed from.

    `columns` are the inputs that each layer's synapses see, `[step, sensor, batch, tap * channel]`;
    `spikes` and `membranes` (before the reset) are `[step, sensor, batch, neuron]`.
    """

    columns: tuple[Float[Array, "n k b j"], ...]
    spikes: tuple[Float[Array, "n k b f"], ...]
    membranes: tuple[Float[Array, "n k b f"], ...]


def stack_start(config: SpikingConfig, k: int, b: int, channels: int | None = None) -> StackState:
    """Everything at rest, nothing heard, for K sensors and a batch of b."""
    channels = code_channels(config) if channels is None else channels
    heard = []
    for taps, stride, width in zip(config.taps, config.strides, config.widths, strict=True):
        heard.append(jnp.zeros((taps - stride, k, b, channels), jnp.float32))
        channels = width
    neurons = tuple(rest(k, b, width) for width in config.widths)
    total = jnp.zeros((k, b, config.features), jnp.float32)
    return StackState(code_start(k, b), tuple(heard), neurons, total, jnp.zeros((), jnp.float32))


def gather(
    heard: Float[Array, "d k b c"], inputs: Float[Array, "t k b c"], taps: int, stride: int
) -> tuple[Float[Array, "d k b c"], Float[Array, "n k b j"]]:
    r"""What each synapse of each step sees: the last `taps` inputs, every `stride` steps.

    .. math:: c_{i, (j, c)} = x_{(i+1) s - w + j,\, c}, \qquad j = 0 \ldots w - 1

    with zeros before the first input, :math:`w` = taps, :math:`s` = stride.

    Returns:
        The inputs that later steps still see, and the columns.
    """
    joined = jnp.concatenate([heard, inputs]) if heard.shape[0] else inputs
    n = inputs.shape[0] // stride
    last = (n - 1) * stride + 1
    columns = jnp.concatenate([joined[j : j + last : stride] for j in range(taps)], axis=-1)
    return joined[joined.shape[0] - (taps - stride) :], columns


def run_layer(
    config: SpikingConfig,
    params: Params,
    state: NeuronState,
    columns: Float[Array, "n k b j"],
    *,
    layer: int,
    constant: Float[Array, "k b f"] | None = None,
) -> tuple[NeuronState, tuple[Float[Array, "n k b f"], Float[Array, "n k b f"]]]:
    r"""Synaptic currents and neurons of one layer over some steps.

    .. math:: I_{kbf} = b_{kf} + \sum_j c_{kbj} W_{kjf} \; \left(+ \sum_g s_{kbg} V_{kgf}\right)

    Args:
        config: of the stack.
        params: of the layer.
        state: of its neurons.
        columns: what its synapses see in each step.
        layer: its number.
        constant: currents that are the same in each step, in place of those of `columns`.

    Returns:
        The new state, and (spikes, potentials before the reset) of every step.
    """
    kernel, bias = params["kernel"], params["bias"][:, None, :]
    neurons = neurons_of(config, params, layer)
    back = params.get("back")
    at_once = not config.stepwise or constant is not None

    def body(carry: NeuronState, given: Array) -> tuple[NeuronState, tuple[Array, Array]]:
        current = given if at_once else given @ kernel + bias
        if constant is not None:
            current = constant
        if back is not None:
            current = current + carry.spikes @ back
        carry, u = neuron_step(config, neurons, carry, current)
        return carry, (carry.spikes, u)

    if at_once and constant is None:
        columns = jnp.einsum("nkbj,kjf->nkbf", columns, kernel) + bias[None]
    return cast(Any, jax.lax.scan(body, state, columns))


def run_stack(
    config: SpikingConfig,
    params: Sequence[Params],
    state: StackState,
    inputs: Float[Array, "t k b c"],
    *,
    held: bool = False,
) -> tuple[StackState, Activity]:
    """All layers over some steps of coded input.

    Args:
        config, params: of the stack.
        state: before the first step.
        inputs: coded samples; a whole number of strides of them.
        held: the inputs are the same in every step, so that the first layer's currents are
            computed once.

    Returns:
        The state after them and what every layer did.

    Raises:
        ValueError: a piece that ends within a step of the last layer.
    """
    if inputs.shape[0] % config.stride:
        raise ValueError(
            f"inputs.shape[0]={inputs.shape[0]}: expected a multiple of {config.stride}, the "
            "strides of all layers; feed whole steps of the last layer"
        )
    columns: list[Array] = []
    spikes: list[Array] = []
    membranes: list[Array] = []
    heard: list[Array] = []
    neurons: list[NeuronState] = []
    for layer, own in enumerate(params):
        below = spikes[-1] if layer else inputs
        kept, seen = gather(state.heard[layer], below, config.taps[layer], config.strides[layer])
        if layer == 0 and config.code == "contrast":
            # All delays of the distance, the newest level.
            seen = jnp.concatenate([seen[..., ::2], seen[..., -1:]], axis=-1)
        constant = None
        if held and layer == 0:
            constant = seen[0] @ own["kernel"] + own["bias"][:, None, :]
        now, (fired, u) = run_layer(
            config, own, state.neurons[layer], seen, layer=layer, constant=constant
        )
        heard.append(kept)
        columns.append(seen)
        neurons.append(now)
        spikes.append(fired)
        membranes.append(u)
    activity = Activity(tuple(columns), tuple(spikes), tuple(membranes))
    total = _add_up(config, state.total, activity)
    steps = state.steps + spikes[-1].shape[0]
    return StackState(state.code, tuple(heard), tuple(neurons), total, steps), activity


def _add_up(config: SpikingConfig, total: Array, activity: Activity) -> Array:
    """The sums of what is read, of every layer that is read, with what came before."""
    first = len(config.widths) - 1 if config.read == "last" else 0
    ends, start = [], 0

    def held(width: int) -> Array:
        return total[..., start : start + width]

    if config.readout != "membranes":
        for spikes in activity.spikes[first:]:
            # Spikes are whole numbers, whose sum has no order.
            ends.append(held(spikes.shape[-1]) + jnp.sum(spikes, axis=0))
            start += spikes.shape[-1]
    if config.readout != "counts":
        for u in activity.membranes[first:]:
            # Membranes are added in the order of time, so that pieces give the bits of a window.
            before = held(u.shape[-1])
            ends.append(jax.lax.scan(lambda sum_, row: (sum_ + row, None), before, u)[0])
            start += u.shape[-1]
    return jnp.concatenate(ends, axis=-1)


def feed(
    config: SpikingConfig,
    params: Sequence[Params],
    state: StackState,
    x: Float[Array, "k b t"],
) -> tuple[StackState, Activity]:
    """Code a piece of a window and run all layers on it; `readout` of the state is the feature.

    With `config.stepwise`, a window in pieces gives the bits of the window in one call.

    Args:
        config, params: of the stack.
        state: `stack_start`, or what the piece before left.
        x: samples, a multiple of `config.stride` of them for each sensor.

    Returns:
        The state after the piece and what every layer did.
    """
    code, coded = encode(config, state.code, jnp.moveaxis(x, -1, 0))
    return run_stack(config, params, state._replace(code=code), coded)


def readout(config: SpikingConfig, state: StackState) -> Float[Array, "k b r"]:
    r"""Features of what has been fed: mean spikes (or membranes) per step, of order one.

    .. math:: z_l = \frac{g}{n_l} \sum_{i=1}^{n_l} s_{li}, \qquad g = 4

    Layers of a slower clock have fewer steps :math:`n_l`.
    """
    first = len(config.widths) - 1 if config.read == "last" else 0
    faster = np.cumprod((1, *config.strides[:0:-1]))[::-1]
    rates = np.repeat(1.0 / faster[first:], config.widths[first:])
    if config.readout == "both":
        rates = np.tile(rates, 2)
    scale = jnp.asarray(GAIN * rates, jnp.float32)
    return state.total * scale[None, None] / jnp.maximum(state.steps, 1.0)
