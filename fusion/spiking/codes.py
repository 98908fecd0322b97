"""Codes: how the samples of a sensor become the input of its first layer.

All take samples in [-1, 1], time first, `[time, sensor, batch]`, and carry a state, so that a
window may come in pieces. None of them is learned; the weights behind them are.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from fusion.spiking.config import SpikingConfig


class CodeState(NamedTuple):
    """What a code remembers of the samples before: a level for each sensor, and their number.

    `level` is the charge of the rate code `[2, sensor, batch]`, the last value sent of the delta
    code, the held sample of the latency code or the running mean of the contrast code (in row 0).
    """

    level: Float[Array, "2 k b"]
    sample: Int[Array, ""]


def code_channels(config: SpikingConfig) -> int:
    """Channels that the code has for each sensor."""
    return 1 if config.code == "current" else 2


def code_start(k: int, b: int) -> CodeState:
    """Nothing has been seen."""
    return CodeState(jnp.zeros((2, k, b), jnp.float32), jnp.zeros((), jnp.int32))


def _contrast(slow: float, seen: Array, level: Array, x: Array) -> tuple[Array, Array]:
    # The mean of all samples at first, then one that forgets.
    mean = level[0] + (x - level[0]) / jnp.minimum(seen + 1.0, slow)
    return jnp.stack([mean, mean]), jnp.stack([x - mean, mean])


def _rate(level: Array, x: Array) -> tuple[Array, Array]:
    charge = level + 0.5 * jnp.clip(jnp.stack([1.0 + x, 1.0 - x]), 0.0, 2.0)
    spikes = (charge >= 1.0).astype(jnp.float32)
    return charge - spikes, spikes


def _delta(step: float, level: Array, x: Array) -> tuple[Array, Array]:
    change = x - level[0]
    up, down = ((sign * change >= step).astype(jnp.float32) for sign in (1.0, -1.0))
    sent = level[0] + step * (up - down)
    return jnp.stack([sent, sent]), jnp.stack([up, down])


def _latency(frame: int, place: Array, level: Array, x: Array) -> tuple[Array, Array]:
    held = jnp.where(place == 0, jnp.clip(x, -1.0, 1.0), level[0])
    # The largest sample comes at once, the smallest in the last step of the frame.
    due = [jnp.round(0.5 * (1.0 - sign * held) * (frame - 1)) for sign in (1.0, -1.0)]
    spikes = jnp.stack([(place == d).astype(jnp.float32) for d in due])
    return jnp.stack([held, held]), spikes


def encode(
    config: SpikingConfig, state: CodeState, x: Float[Array, "t k b"]
) -> tuple[CodeState, Float[Array, "t k b c"]]:
    r"""Turn samples into spikes or currents, channel last.

    - `current`: the samples themselves, one channel.
    - `contrast`: the sample's distance from a running mean :math:`m` of `slow` samples,
      :math:`x - m`, and :math:`m` itself; the first layer hears the distance with all its delays
      and m with none, so that rhythm and level do not stand in each other's way.
    - `rate`: two neurons that integrate :math:`(1 \pm x)/2` and fire at one, without leak: the
      share of steps with a spike is the sample, without noise.
    - `latency`: in every frame of `frame` samples, each of two neurons fires once, the sooner the
      larger (or smaller) the frame's first sample is: step :math:`\text{round}((1 \mp x)(F-1)/2)`.
    - `delta`: a spike up or down whenever the sample has moved by `delta` from what was last sent,
      at most one a step.

    Args:
        config: code and its constants.
        state: of the samples before.
        x: samples.

    Returns:
        The new state, and `[time, sensor, batch, channel]`.

    Source: Eshraghian et al. (2023) for the names; the rate code is that of an integrate-and-fire
    neuron rather than random.

    Example:
        >>> x = jnp.array([0.1, 0.2, 0.0, 0.0])[:, None, None]
        >>> spikes = encode(SpikingConfig(code="delta", delta=0.1), code_start(1, 1), x)[1]
        >>> spikes[:, 0, 0].tolist()
        [[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]
    """
    n = x.shape[0]
    if config.code == "current":
        return state._replace(sample=state.sample + n), x[..., None].astype(jnp.float32)

    def step(carry: CodeState, sample: Array) -> tuple[CodeState, Array]:
        if config.code == "contrast":
            seen = carry.sample.astype(jnp.float32)
            level, spikes = _contrast(config.slow, seen, carry.level, sample)
        elif config.code == "rate":
            level, spikes = _rate(carry.level, sample)
        elif config.code == "delta":
            level, spikes = _delta(config.delta, carry.level, sample)
        else:
            place = (carry.sample % config.frame).astype(jnp.float32)
            level, spikes = _latency(config.frame, place, carry.level, sample)
        return CodeState(level, carry.sample + 1), spikes

    state, spikes = jax.lax.scan(step, state, x.astype(jnp.float32))
    return state, jnp.moveaxis(spikes, 1, -1)
