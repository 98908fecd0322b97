"""Synapses that learn without gradients: spike timing, and a reward that says what it was worth.

The loss of a sensor's auxiliary path is its negative reward. Nothing runs backwards in time: the
eligibility of a synapse is made of traces that both neurons have anyway, and waits for the reward.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion.encoders import EncoderConfig, scalar_features
from fusion.spiking.config import SpikingConfig
from fusion.spiking.drawing import Params
from fusion.spiking.encoder import run_encoder, scalar_config, stack_params
from fusion.spiking.layers import Activity


def _decayed(decay: float, events: Float[Array, "n k b j"]) -> Float[Array, "n k b j"]:
    def step(trace: Array, event: Array) -> tuple[Array, Array]:
        trace = decay * trace + event
        return trace, trace

    return jax.lax.scan(step, jnp.zeros_like(events[0]), events)[1]


def eligible(
    config: SpikingConfig, layers: Sequence[Params], activity: Activity
) -> Float[Array, "k b"]:
    r"""Weights times their eligibility, summed over the synapses of each sensor.

    .. math::
        e_{kbjf} = \frac{1}{n} \sum_t \left( x_{kbj}(t)\, s_{kbf}(t) - y_{kbf}(t)\, c_{kbj}(t)
            \right), \qquad E_{kb} = \sum_{jf} W_{kjf}\, e_{kbjf}

    Symbols: c and s are the inputs and spikes of a layer; x is the trace of c with the input of
    the step, y that of s without it, both decay with `tau_stdp`. Its derivative in W is e, which is
    why it is computed: a rule of learning may then stand in a loss beside others.

    Args:
        config: `tau_stdp`; static.
        layers: parameters of each layer; their kernels are what E is linear in.
        activity: what the layers did; taken as given.
    """
    decay = math.exp(-1.0 / config.tau_stdp)
    total = jnp.zeros(activity.spikes[0].shape[1:3], jnp.float32)
    for own, seen, fired in zip(layers, activity.columns, activity.spikes, strict=True):
        inputs, spikes = jax.lax.stop_gradient((seen, fired))
        before = _decayed(decay, inputs)
        # After the spike only: a spike of the same step is not paired with its own input twice.
        after = _decayed(decay, spikes) - spikes
        potentiated = jnp.einsum("nkbj,kjf,nkbf->kb", before, own["kernel"], spikes)
        depressed = jnp.einsum("nkbj,kjf,nkbf->kb", inputs, own["kernel"], after)
        total = total + (potentiated - depressed) / spikes.shape[0]
    return total


def reward_gradient(
    config: EncoderConfig, params: Params, x: Float[Array, "b k t"], losses: Float[Array, "b k"]
) -> Float[Array, ""]:
    """Zero, with the gradient of `reward_term`: a loss that it is added to stays what it was.

    Args:
        config: of the encoders.
        params: of the spiking encoder, flat.
        x: windows.
        losses: of the auxiliary paths.
    """
    expand = functools.partial(scalar_features, config)
    windows = jnp.transpose(x, (1, 0, 2))
    told = reward_term(config.spiking, params, windows, losses, expand=expand)
    return told - jax.lax.stop_gradient(told)


def reward_term(
    config: SpikingConfig,
    params: Params,
    x: Float[Array, "k b t"],
    losses: Float[Array, "b k"],
    *,
    expand: Callable[[Array], Array] | None = None,
) -> Float[Array, ""]:
    r"""A term of the loss whose gradient is the three-factor rule, and nothing else.

    .. math::
        \Delta W_{kjf} \propto \sum_b \left(\bar L_k - L_{bk}\right) e_{kbjf}, \qquad
        \bar L_k = \frac{1}{B} \sum_b L_{bk}

    Only kernels learn by it; biases, time constants and recurrent synapses stay as drawn.

    Args:
        config, params: of the encoder, flat.
        x: windows of K sensors.
        losses: of the auxiliary paths, per example; minus the reward.
        expand: features of scalars, as in `encoder.run_encoder`.

    Source: Izhikevich (2007) and Frémaux and Gerstner (2016), reward-modulated STDP with the
    reward's mean as baseline. Deviation: the eligibility is summed over the window, at whose end
    the reward comes, and Adam scales the step.
    """
    own = config if x.shape[-1] > 1 else scalar_config(config)
    _, activity = run_encoder(config, jax.lax.stop_gradient(params), x, expand=expand)
    wanted = jax.lax.stop_gradient(losses - jnp.mean(losses, axis=0, keepdims=True))
    traced = eligible(own, stack_params(own, params), activity)
    return config.stdp_rate * jnp.mean(jnp.sum(wanted.T * traced, axis=0))
