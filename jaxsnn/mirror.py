"""Left and right tied: each synapse of one motor's half has its mirror image in the other half.

A robot and its mirror image should turn by the same angle to opposite sides. With tied weights they
do, and what is learnt before an obstacle on the left is known before one on the right.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxsnn.config import NetworkConfig, Weights
from jaxsnn.sensor_intervals import N_DISTANCE, N_NEAR, N_OCTANT


def mirrored_inputs(config: NetworkConfig) -> np.ndarray:
    """The input neuron that stands for the mirror image of what each one stands for, `[n_in]`.

    Sonars from right to left, the same distance, the octant on the other side, turns to the other
    side; within a group the same neuron.

    Example:
        >>> config = NetworkConfig(input_code="interval", group_exc=1, group_inh=0)
        >>> mirrored_inputs(config)[[0, 17, 23, 25, 28]].tolist()
        [16, 1, 23, 31, 28]
    """
    sonars = np.arange(config.n_sonars * N_NEAR).reshape(-1, N_NEAR)[::-1].ravel()
    distances = sonars.size + np.arange(N_DISTANCE)
    octants = sonars.size + N_DISTANCE + (-np.arange(N_OCTANT)) % N_OCTANT
    groups = np.concatenate([sonars, distances, octants])
    if config.turn_groups:
        groups = np.append(groups, groups.size + np.array([1, 0]))
    size = config.group_exc + config.group_inh
    return (groups[:, None] * size + np.arange(size)).ravel()


def tied(config: NetworkConfig, weights: Weights) -> Weights:
    r"""The mean of the weights and of their mirror image.

    .. math:: w \leftarrow \tfrac12 (w + M w)

    with :math:`M` the exchange of the halves and of mirrored inputs. Bounds are kept, since both
    have the same ones. Tied weights that learn and are tied again have learnt from what was sensed
    and from its mirror image, each with half the rate.

    Source: ours.
    """
    inputs = mirrored_inputs(config)
    halves = jnp.roll(weights.hidden[inputs], config.n_half, axis=1)
    return Weights(
        hidden=0.5 * (weights.hidden + halves), output=0.5 * (weights.output + weights.output[::-1])
    )
