"""What an inference costs: multiply-adds, synaptic operations, spikes, and an estimate of energy.

A synaptic operation is one addition of a weight because one spike arrived at one synapse. Dense
layers on numbers that are no spikes are multiply-adds, in spiking networks, too: the currents of
the samples, the leaks of the membranes, the gate and the head.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fusion.config import ModelConfig
from fusion.encoders import EncoderConfig, scalar_features
from fusion.spiking.codes import code_channels
from fusion.spiking.drawing import Params, inputs_of
from fusion.spiking.encoder import run_encoder, scalar_config
from fusion.spiking.layers import Activity

MULTIPLY_ADD_PJ = 4.6
"""Energy of a float32 multiplication and addition, 45 nm, 0.9 V: 3.7 + 0.9 pJ.

Source: Horowitz (2014), Computing's energy problem, ISSCC, Figure 1.1.9."""
ADD_PJ = 0.9
"""Energy of a float32 addition; same source. Memory and control, which cost more, are left out."""


class Cost(NamedTuple):
    """Means per inference (one example, all sensors).

    Attributes:
        multiply_adds: products of numbers that are no spikes.
        synaptic_operations: additions that spikes cause.
        spikes: of all neurons of all sensors.
        energy: of both [nJ], see `MULTIPLY_ADD_PJ` and `ADD_PJ`.
    """

    multiply_adds: float
    synaptic_operations: float
    spikes: float
    energy: float

    @property
    def operations(self) -> float:
        """Multiply-adds and synaptic operations together."""
        return self.multiply_adds + self.synaptic_operations


def _series(config: EncoderConfig, n_times: int, *, fast: bool) -> float:
    """Multiply-adds of one sensor's convolutions and what is read of them."""
    total, length, channels = 0.0, n_times, 1
    layers = zip(config.conv_kernels, config.conv_strides, config.conv_features, strict=True)
    for width, stride, features in layers:
        length = (length - width) // stride + 1
        total += length * width * channels * features
        channels = features
    return total + _readout(config, n_times, channels, fast=fast)


def _readout(config: EncoderConfig, n_times: int, channels: int, *, fast: bool) -> float:
    """Multiply-adds of one sensor's `pooled_features`."""
    total, joined = float(2 * channels * config.features), config.features
    if config.spectral:
        bins = n_times // 2
        # A real FFT of N samples has about N log2 N multiplications; as a matrix it has 2 N bins.
        total += n_times * math.log2(n_times) if fast else 2 * n_times * bins
        total += (bins + 7) * config.features
        joined += config.features
    return total + joined * config.features


def _reversible(config: EncoderConfig, n_times: int, *, fast: bool) -> float:
    """Multiply-adds of one sensor's coupling blocks and what is read of them."""
    trunk = config.reversible
    widths, total, length = trunk.stage_channels(), 0.0, n_times
    for stage, half in enumerate(width // 2 for width in widths):
        length //= trunk.squeezes[stage]
        drive = (trunk.taps[stage] + 1) * half * trunk.hidden[stage]
        total += trunk.depths[stage] * 2 * length * drive
    if n_times == 1:
        return total + widths[-1] * config.features
    return total + _readout(config, n_times, widths[-1], fast=fast)


def _spiking(config: EncoderConfig, n_times: int) -> float:
    """Multiply-adds of one sensor's spiking layers: currents of samples, and leaks."""
    spiking = config.spiking if n_times > 1 else scalar_config(config.spiking)
    steps = n_times if n_times > 1 else spiking.steps
    total, channels = 0.0, code_channels(spiking)
    if n_times == 1 and spiking.code == "current":
        channels = _scalar_channels(config)
    for layer, width in enumerate(spiking.widths):
        steps //= spiking.strides[layer]
        if layer == 0 and spiking.analog:
            times = steps if n_times > 1 else 1
            total += times * inputs_of(spiking, 0, channels) * width
            # A running mean is one product for each sample.
            total += n_times if spiking.code == "contrast" else 0
        # A leak is one product, a turn of a resonating membrane four more.
        total += steps * width * (5 if spiking.resonates(layer) else 1)
    return total


def _scalar_channels(config: EncoderConfig) -> int:
    return 1 + 2 * config.frequencies + bool(config.levels)


def multiply_adds(config: ModelConfig, *, fast: bool = False) -> dict[str, float]:
    """Multiply-adds of an inference by part: `encoders`, `gate`, `head`.

    Args:
        config: a network with dense head.
        fast: the spectrum of the convolutional encoders is counted as a fast Fourier transform
            rather than as the matrix product that this package computes.

    Raises:
        ValueError: a network whose head or scalars read memory rather than multiply.

    Example:
        >>> small = ModelConfig("baseline", n_sensors=2, n_times=1, n_classes=3, head_widths=(4,))
        >>> multiply_adds(small)["head"]
        524.0
    """
    encoder, k = config.encoder, config.n_sensors
    if config.head != "dense" or (encoder.scalar == "table" and encoder.series == "conv"):
        raise ValueError(
            f"head={config.head!r}, scalar={encoder.scalar!r}: expected a dense head and encoders "
            "that multiply; tables are read, which is not counted here"
        )
    if encoder.series == "spiking":
        own = _spiking(encoder, config.n_times)
    elif encoder.series == "reversible":
        own = _reversible(encoder, config.n_times, fast=fast)
    elif config.n_times == 1:
        own = float(_scalar_channels(encoder) * encoder.features)
    else:
        own = _series(encoder, config.n_times, fast=fast)
    joined = k * encoder.width
    gate = config.gate_width * (joined + k) if config.recipe.gate == "learned" else 0
    fused = joined if config.fusion == "concat" else encoder.width
    sizes = (fused, *config.head_widths, config.n_classes)
    head = sum(a * b for a, b in itertools.pairwise(sizes))
    return {"encoders": float(k * own), "gate": float(gate), "head": float(head)}


def activity_of(config: EncoderConfig, params: Params, x: Float[Array, "b k t"]) -> Activity:
    """What the spiking layers do on windows; `params` are those of the encoder."""
    expand = functools.partial(scalar_features, config)
    windows = jnp.transpose(x, (1, 0, 2))
    return run_encoder(config.spiking, params, windows, expand=expand)[1]


def count_spikes(
    config: EncoderConfig, activity: Activity, *, scalars: bool = False
) -> tuple[Float[Array, " b"], Float[Array, " b"]]:
    r"""Synaptic operations and spikes of each example, over all sensors.

    .. math:: \sum_l \sum_{t, k} n_l \left(\#\{j : c_{kj}(t) \ne 0\} + r_l \#\{g : s_{kg}(t)
        \ne 0\}\right)

    with :math:`n_l` neurons in layer l and :math:`r_l = 1` where it is recurrent. The first layer
    of an analog code has no spikes in its input and is counted as multiply-adds.
    """
    spiking = config.spiking
    b = activity.spikes[0].shape[2]
    operations, spikes = jnp.zeros(b), jnp.zeros(b)
    for layer, width in enumerate(spiking.widths):
        fired = jnp.sum(activity.spikes[layer], axis=(0, 1, 3))
        spikes = spikes + fired
        if layer or not spiking.analog:
            events = (activity.columns[layer] != 0.0).astype(jnp.float32)
            heard = jnp.sum(events, axis=(0, 1, 3))
            operations = operations + width * heard
        if spiking.recurrent and layer == len(spiking.widths) - 1:
            operations = operations + width * fired
    return operations, spikes


def cost(
    config: ModelConfig, main: Params, x: Float[Array | np.ndarray, "b k t"], *, batch: int = 256
) -> Cost:
    """Mean cost of an inference on given windows.

    Args:
        config: of the network.
        main: `fusion.export(params)`.
        x: windows to count spikes on; convolutional networks cost the same on all.
        batch: windows at a time.

    Returns:
        Multiply-adds, synaptic operations, spikes and energy, means over the windows.
    """
    products = sum(multiply_adds(config).values())
    operations = spikes = 0.0
    if config.encoder.series == "spiking":
        count = jax.jit(
            lambda params, x: count_spikes(config.encoder, activity_of(config.encoder, params, x))
        )
        found = [
            count(main["encoder"], jnp.asarray(x[i : i + batch])) for i in range(0, len(x), batch)
        ]
        operations, spikes = (
            float(np.mean(np.concatenate(part))) for part in zip(*found, strict=True)
        )
    energy = 1e-3 * (MULTIPLY_ADD_PJ * products + ADD_PJ * operations)
    return Cost(products, operations, spikes, energy)
