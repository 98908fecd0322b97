"""Leaky integrate-and-fire neurons that learn: dimensionless, one Euler step of one time step.

The membrane obeys the equation of `jaxsnn.neurons` (Shim 2020, Eq. 2.1) with times in steps and
potentials in units of the threshold; a test holds both to the same spikes. Membranes are float32.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fusion.spiking.config import SpikingConfig
from fusion.spiking.surrogate import spike


class NeuronParams(NamedTuple):
    r"""Constants of a layer's membranes, one for each neuron.

    `leak` is :math:`\lambda = 1 / \tau` in (0, 1]; `turn` is :math:`\omega`, the phase that a
    resonating membrane advances in a step [rad], None for one that leaks only.
    """

    leak: Float[Array, "#k f"]
    turn: Float[Array, "#k f"] | None = None


class NeuronState(NamedTuple):
    """Potentials, their quadrature (resonance), rise of the thresholds, spikes of the last step."""

    v: Float[Array, "k b f"]
    w: Float[Array, "k b f"]
    rise: Float[Array, "k b f"]
    spikes: Float[Array, "k b f"]


def rest(k: int, b: int, width: int) -> NeuronState:
    """Neurons at rest that have not fired, `[sensor, batch, neuron]`."""
    zero = jnp.zeros((k, b, width), jnp.float32)
    return NeuronState(zero, zero, zero, zero)


def spread_leaks(config: SpikingConfig, width: int) -> Float[np.ndarray, " f"]:
    r"""Logits of the leaks of a layer, time constants spread evenly on a log scale.

    .. math:: \tau_i = \tau_{lo} \left(\tau_{hi} / \tau_{lo}\right)^{i / (n - 1)}, \qquad
        \ell_i = \log \frac{1/\tau_i}{1 - 1/\tau_i}
    """
    share = np.linspace(0.0, 1.0, width) if width > 1 else np.array([0.5])
    low, high = config.tau
    leak = 1.0 / (low * (high / low) ** share)
    # A leak of one (a time constant of one step) has no logit.
    leak = np.minimum(leak, 0.999)
    return np.asarray(np.log(leak / (1.0 - leak)), np.float32)


def spread_turns(config: SpikingConfig, width: int) -> Float[np.ndarray, " f"]:
    r"""Phases per step of a resonating layer, spread evenly and unrelated to the time constants.

    .. math:: \omega_i = 2 \pi \left(f_{lo} + (f_{hi} - f_{lo}) (0.618\, i \bmod 1)\right)
    """
    low, high = config.resonance
    share = (np.arange(width) * 0.6180339887) % 1.0
    return np.asarray(2.0 * np.pi * (low + (high - low) * share), np.float32)


def neuron_step(
    config: SpikingConfig,
    params: NeuronParams,
    state: NeuronState,
    current: Float[Array, "k b f"],
) -> tuple[NeuronState, Float[Array, "k b f"]]:
    r"""One step: leak and current, threshold, reset.

    .. math::
        u = v + \lambda (I - v), \qquad \lambda = 1 / \tau \\
        s = [u > \theta + a], \qquad a' = e^{-1/\tau_a} a + \kappa s \\
        v' = u - (\theta + a)\, s \;(\text{soft}), \qquad v' = u\, (1 - s) \;(\text{hard})

    and for a resonating membrane, with :math:`z = v + i w`,

    .. math:: u + i w' = (1 - \lambda)\, e^{i \omega} z + \lambda I

    which is the first line where :math:`\omega = 0`. Symbols: :math:`\lambda, \omega` of `params`,
    I is `current`, :math:`\theta` the threshold, a the rise of an adaptive threshold,
    :math:`\kappa` is `adaptation`, :math:`\tau_a` is `tau_adaptation`. The reset takes part in no
    gradient: what is learned is when to fire, not to have fired.

    Args:
        config: threshold, adaptation, reset and surrogate; static.
        params: leaks and phases.
        state: before the step.
        current: I, synaptic currents of the step.

    Returns:
        The state after the step (its `spikes` are those of the step), and the potentials u before
        the reset.

    Source: Shim (2020), Eq. 2.1 by Euler's rule; Bellec et al. (2018), adaptive threshold;
    Izhikevich (2001), resonate-and-fire.
    """
    leak, w = params.leak[:, None, :], state.w
    if params.turn is None:
        u = state.v + leak * (current - state.v)
    else:
        cosine, sine = (f(params.turn)[:, None, :] for f in (jnp.cos, jnp.sin))
        kept = 1.0 - leak
        u = kept * (cosine * state.v - sine * w) + leak * current
        w = kept * (sine * state.v + cosine * w)
    threshold = config.threshold + state.rise if config.adaptation else config.threshold
    spikes = spike(u - threshold, config.surrogate, config.slope)
    fired = jax.lax.stop_gradient(spikes)
    v = u - threshold * fired if config.reset == "soft" else u * (1.0 - fired)
    rise = state.rise
    if config.adaptation:
        rise = rise * float(np.exp(-1.0 / config.tau_adaptation)) + config.adaptation * spikes
    return NeuronState(v, w, rise, spikes), u
