r"""Running mean of presynaptic rates, so that only the difference from it is learnt from.

The eligibility trace of the source is a product of firing, so a synapse from a neuron that always
fires is changed by every reward, and one from a neuron whose rate says which of two situations this
is gets the same sign in both. With the mean taken off the presynaptic side,

.. math:: \tilde S_{pre}(t) = S_{pre}(t) - c \, \bar S_{pre}, \qquad
          \tau \, \dot{\bar S}_{pre} = S_{pre} - \bar S_{pre}

the trace is a covariance: a situation changes the synapses whose neurons it drives away from their
mean, up or down (Sejnowski 1977, the covariance rule). `c = 0` is the source.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Baseline(NamedTuple):
    """Mean spikes per step of each presynaptic neuron, and the time it was taken over [s]."""

    mean: Float[Array, " n"]
    duration: Float[Array, ""]


def baseline_init(n: int) -> Baseline:
    """Nothing observed yet."""
    return Baseline(jnp.zeros((n,)), jnp.zeros(()))


def baseline_update(
    state: Baseline,
    spikes: Float[Array, " n"],
    *,
    tau: float | Float[Array, ""],
    duration: float | Float[Array, ""],
) -> Baseline:
    r"""Take in the mean of some steps.

    .. math:: \bar S \leftarrow \bar S + \max(1 - e^{-T/\tau}, \tfrac{T}{t + T}) (S - \bar S)

    so that it is a plain mean until `t` reaches about `tau`.

    Args:
        state: Baseline.
        spikes: mean number of spikes per step over the steps, `[n]`.
        tau: time constant [s].
        duration: `T` of the steps [s].

    Source: Ours.

    Example:
        >>> state = baseline_init(1)
        >>> for spikes in (1.0, 0.0):
        ...     state = baseline_update(state, jnp.array([spikes]), tau=10.0, duration=0.1)
        >>> state.mean.tolist()
        [0.5]
    """
    total = state.duration + duration
    share = jnp.maximum(-jnp.expm1(-duration / tau), duration / total)
    new = Baseline(state.mean + share * (spikes - state.mean), total)
    return jax.tree.map(lambda a, b: a.astype(b.dtype), new, state)
