r"""Losses of both stages for one frame; everything is a mean over a mini-batch of fixed size.

.. math::
    L_{cls} = \frac{1}{|B|} \sum_{i \in B} \mathrm{CE}_i, \qquad
    L_{reg} = \frac{1}{|P|} \sum_{i \in P} \sum_j \mathrm{smooth}_{L1}(t_{ij} - \hat t_{ij})

over the mini-batch B and its positives P.

Source: Ku et al. (2018), section III-E; smooth L1: Girshick (2015).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion.detection.learning.sampling import Sample
from fusion.losses import cross_entropy


class StageLoss(NamedTuple):
    """Loss of the classes, of the boxes and of the headings (0 in the first stage)."""

    classes: Array
    boxes: Array
    angle: Array


def smooth_l1(error: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Half the square within 1, the absolute value less a half outside.

    Example:
        >>> smooth_l1(jnp.array([0.5, -2.0])).tolist()
        [0.125, 1.5]
    """
    size = jnp.abs(error)
    return jnp.where(size < 1.0, 0.5 * error**2, size - 0.5)


def _mean(losses: Array, counted: Array) -> Array:
    """Mean over the rows that count; 0 where there is none."""
    n = counted.sum().astype(losses.dtype)
    return jnp.sum(jnp.where(counted, losses, 0.0)) / jnp.maximum(1.0, n)


def class_loss(
    scores: Float[Array, "m c"], sample: Sample, smoothing: float = 0.0
) -> Float[Array, ""]:
    """Mean cross entropy over the mini-batch; class 1 is the object, class 0 the background."""
    losses = cross_entropy(scores, sample.positive.astype(jnp.int32), smoothing)
    return _mean(losses, sample.valid)


def balanced_class_loss(scores: Float[Array, "m 2"], sample: Sample) -> Float[Array, ""]:
    r"""Cross entropy in which positives and negatives weigh alike, however few the positives are.

    .. math:: L_{bal} = \tfrac{1}{2} \overline{\mathrm{CE}}_{P} + \tfrac{1}{2}
        \overline{\mathrm{CE}}_{B \setminus P}

    The mean over the mini-batch says above all how many objects a frame holds; this one says how
    well they are told from the background: near log 2 for scores that know nothing and are not
    sure of themselves.
    """
    losses = cross_entropy(scores, sample.positive.astype(jnp.int32))
    negative = sample.valid & ~sample.positive
    return 0.5 * (_mean(losses, sample.positive) + _mean(losses, negative))


def regression_loss(
    predicted: Float[Array, "m d"], target: Float[Array, "m d"], sample: Sample
) -> Float[Array, ""]:
    """Smooth L1 over the columns, mean over the positives; 0 without positives."""
    losses = smooth_l1(predicted - target).sum(axis=1)
    return _mean(losses, sample.positive)
