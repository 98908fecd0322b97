"""First parameters of spiking layers, and the neurons that parameters stand for."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from fusion.spiking.codes import code_channels
from fusion.spiking.config import SpikingConfig
from fusion.spiking.neurons import NeuronParams, spread_leaks, spread_turns

Params = dict[str, Any]


def draw_layer(
    config: SpikingConfig, k: int, layer: int, channels: int, *, key: Key[Array, ""]
) -> Params:
    """Parameters of one layer: `kernel` `[k, tap * channel, f]`, `bias`, `leak`, `turn`, `back`.

    Where numbers drive the first layer, its neurons have gains from 1 to 16, so that weak and
    strong rhythms find neurons that answer them. Under the current code half of them see changes
    only (their weights sum to zero); under the contrast code one half sees changes and one quarter
    the level, until they learn otherwise.
    """
    width, taps = config.widths[layer], config.taps[layer]
    kernel_key, bias_key, back_key = jax.random.split(key, 3)
    fan_in = inputs_of(config, layer, channels)
    kernel = jax.random.normal(kernel_key, (k, fan_in, width)) / math.sqrt(fan_in)
    if layer == 0 and config.analog:
        # Shares of irrational numbers: gains, time constants and frequencies are unrelated.
        gain = 16.0 ** ((np.arange(width) * 0.7548776662) % 1.0)
        place = np.arange(width) % 4
        if config.code == "contrast":
            seen = np.ones((fan_in, width), np.float32)
            seen[-1, place < 2] = 0.0
            seen[:-1, place == 2] = 0.0
            kernel = kernel * jnp.asarray(seen)[None]
            kernel = kernel.at[:, -1].multiply(math.sqrt(fan_in))
        elif taps > 1 and not config.resonates(layer):
            changes = kernel - jnp.mean(kernel, axis=1, keepdims=True)
            half = jnp.asarray(place % 2 == 0)
            kernel = jnp.where(half[None, None], 2.0 * changes, kernel)
        kernel = kernel * jnp.asarray(gain, jnp.float32)[None, None]
    else:
        kernel = 2.0 * kernel
    bias = jax.random.uniform(bias_key, (k, width), minval=0.0, maxval=config.threshold)
    params = {"kernel": kernel, "bias": bias}
    if config.learn_tau:
        params["leak"] = jnp.tile(jnp.asarray(spread_leaks(config, width))[None], (k, 1))
        if config.resonates(layer):
            params["turn"] = jnp.tile(jnp.asarray(spread_turns(config, width))[None], (k, 1))
    if config.recurrent and layer == len(config.widths) - 1:
        params["back"] = jax.random.normal(back_key, (k, width, width)) / (4.0 * math.sqrt(width))
    return params


def inputs_of(config: SpikingConfig, layer: int, channels: int) -> int:
    """Columns that each neuron of a layer has weights for."""
    if layer == 0 and config.code == "contrast":
        return config.taps[0] + 1
    return config.taps[layer] * channels


def draw_stack(
    config: SpikingConfig, k: int, channels: int | None = None, *, key: Key[Array, ""]
) -> list[Params]:
    """Parameters of all layers, for `channels` channels of input (those of the code when None)."""
    channels = code_channels(config) if channels is None else channels
    layers = []
    for layer, width in enumerate(config.widths):
        draw = jax.random.fold_in(key, layer)
        layers.append(draw_layer(config, k, layer, channels, key=draw))
        channels = width
    return layers


def neurons_of(config: SpikingConfig, params: Params, layer: int) -> NeuronParams:
    """Leaks in (0, 1) and phases of a layer: learned, or the fixed spread."""
    width = config.widths[layer]
    fixed = {"leak": spread_leaks(config, width), "turn": spread_turns(config, width)}
    leak, turn = (
        params[name] if config.learn_tau and name in params else jnp.asarray(value)[None]
        for name, value in fixed.items()
    )
    return NeuronParams(jax.nn.sigmoid(leak), turn if config.resonates(layer) else None)
