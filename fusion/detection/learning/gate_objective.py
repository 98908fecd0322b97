r"""The gate's part of the detector's loss: paths that read one view alone, and targets from them.

.. math::
    \alpha \sum_k w_k L^{aux}_k + \beta \sum_k \big(w_k - f_k(\tilde L)\big)^2
      + \lambda \sum_k \big(f_k(\tilde L) - \mathrm{softmax}(-\tilde L / \tau)_k\big)^2

:math:`L^{aux}_k` is the loss of view k's path through both stages, in whose class losses objects
and background weigh alike (`balanced_class_loss`). The targets see

.. math:: \tilde L_k = 1 + \ell_k - \bar\ell_k,

with :math:`\ell_k` the mean of these class losses and :math:`\bar\ell_k` what it is on average. The
whole loss says how many objects a frame holds and how they stand, more than in which state its
sensor is; and a sensor that alone is the weaker one, however well it works, is no failed sensor.

Source: Shim (2020), Eq. 3.2 and section 3.3.2.2. Deviations: the paths' second stage,
what the targets see (`DetectorConfig.auxiliary_second`, `balanced_paths`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fusion.detection.config import DetectorConfig
from fusion.detection.learning.detection_loss import (
    balanced_class_loss,
    class_loss,
    regression_loss,
)
from fusion.detection.learning.sampling import Sample
from fusion.losses import LossParams, gate_penalty
from fusion.targets import apply_targets


class PathLosses(NamedTuple):
    """Losses of the views' paths in one stage.

    Attributes:
        whole: `[b, k]` classes, boxes and headings.
        balanced: `[b, k]` classes, positives and negatives weighted alike.
        counted: `[b]` 1 for frames with positives, else 0.
    """

    whole: Array
    balanced: Array
    counted: Array


def class_losses(config: DetectorConfig, scores: Array, sample: Sample) -> Array:
    """Class loss of every frame `[b]` from the scores of its mini-batch `[b, m, 2]`."""
    return jax.vmap(lambda s, m: class_loss(s, m, config.label_smoothing))(scores, sample)


def path_losses(
    config: DetectorConfig,
    outputs: Sequence[tuple[Array, ...]],
    targets: tuple[Array, ...],
    sample: Sample,
) -> PathLosses:
    """Losses of one stage.

    Args:
        config: weights of the parts.
        outputs: of each view, class scores `[b, m, 2]`, then offsets, then (second stage) headings.
        targets: what offsets and headings should be.
        sample: mini-batch of every frame.
    """
    scales = (config.regression_weight, config.angle_weight)
    regress = jax.vmap(regression_loss)
    whole, balanced = [], []
    for scores, *predicted in outputs:
        parts = [
            scale * regress(p, t, sample)
            for scale, p, t in zip(scales, predicted, targets, strict=False)
        ]
        even = jax.vmap(balanced_class_loss)(scores, sample)
        classes = even if config.balanced_paths else class_losses(config, scores, sample)
        whole.append(classes + sum(parts))
        balanced.append(even)
    counted = sample.positive.any(axis=1).astype(jnp.float32)
    return PathLosses(jnp.stack(whole, 1), jnp.stack(balanced, 1), counted)


def failure_loss(
    logits: Float[Array, "b 2"], failed: Bool[Array, "b 2"] | None
) -> Float[Array, ""]:
    """Mean cross entropy of the told failures (log odds); 0 without labels or without a teller."""
    if failed is None:
        return jnp.zeros(())
    known = jnp.isfinite(logits)
    safe = jnp.where(known, logits, 0.0)
    losses = jax.nn.softplus(safe) - safe * failed.astype(safe.dtype)
    return jnp.mean(jnp.where(known, losses, 0.0))


def gate_terms(
    config: DetectorConfig,
    gate: LossParams,
    params: Any,
    weights: Array,
    stages: Sequence[PathLosses],
) -> tuple[Array, Array, Array]:
    """The gate's part of the loss, its auxiliary and its regularization term; scalars.

    Args:
        config: static.
        gate: alpha, beta, tau, anchor.
        params: of `init_detector`, for the lattice and the running means of the losses.
        weights: `[b, k]` fusion weights.
        stages: losses of each stage.
    """
    options = config.gate_loss
    aux_losses = sum((stage.whole for stage in stages[1:]), stages[0].whole)
    given, counted, tracking = aux_losses, None, jnp.zeros(())
    if config.balanced_paths:
        balanced = jnp.mean(jnp.stack([stage.balanced for stage in stages]), axis=0)
        counted = jnp.prod(jnp.stack([stage.counted for stage in stages]), axis=0)
        # The mean is learned beside the lattice: it minimizes the squared distance.
        mean, now = params["mean_losses"][None], jax.lax.stop_gradient(balanced)
        tracking = jnp.mean(counted * 0.5 * jnp.sum((mean - now) ** 2, axis=-1))
        given = 1.0 + balanced - jax.lax.stop_gradient(mean)
    given = jax.lax.stop_gradient(given) if options.stop_targets else given
    targets = None
    if options.learned_targets:
        targets = apply_targets(config.targets, params["targets"], given)
    terms = gate_penalty(
        options, gate, weights, aux_losses, targets, target_losses=given, counted=counted
    )
    return terms.total + tracking, terms.auxiliary, terms.regularization
