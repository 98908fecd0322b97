"""The ARGate losses, Equations 3.1 and 3.2, per example; every gradient path is an option."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from fusion.gating import Normalizer, normalize

__all__ = ["LossConfig", "LossParams", "LossTerms", "argate_loss", "cross_entropy", "loss_targets"]


class LossParams(NamedTuple):
    """What a sweep may vary; leaves are scalars, so `jax.vmap` runs over them.

    Attributes:
        alpha: weight of the auxiliary losses (Equation 3.1).
        beta: weight of the fusion-weight regularization (Equation 3.1).
        tau: temperature of the target `softmax(-loss / tau)`; unused by the printed target.
        anchor: weight that pulls learned targets to `softmax(-loss / tau)`; 0 as printed.
    """

    alpha: float | Array = 1.0
    beta: float | Array = 1.0
    tau: float | Array = 1.0
    anchor: float | Array = 0.0


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Which terms are there and where gradients flow (static).

    Attributes:
        auxiliary: the network has auxiliary paths (WS).
        loss_weighting: auxiliary losses are weighted by the fusion weights (ALW); else the mean.
        regularization: fusion weights are pulled to targets (FWR).
        learned_targets: the targets come from the monotone lattice (Equation 3.2).
        normalizer: of the weights; the fixed targets follow it (see `loss_targets`).
        stop_targets: no gradient from the regularization into the auxiliary losses; without it
            the auxiliary heads can be made worse to please the gate.
        stop_weights: no gradient of the alpha term into the fusion weights; with it the term trains
            the auxiliary paths only, and does not pull w to whichever path fits first.
        uniform_floor: share of equal weighting mixed into the alpha term's weights, in [0, 1], so
            that the path of a sensor with a low weight goes on learning.
        label_smoothing: share of the label mass spread over all classes, main and auxiliary.
    """

    auxiliary: bool = True
    loss_weighting: bool = True
    regularization: bool = True
    learned_targets: bool = True
    normalizer: Normalizer = "softmax"
    stop_targets: bool = True
    stop_weights: bool = False
    uniform_floor: float = 0.0
    label_smoothing: float = 0.05

    def __post_init__(self) -> None:
        """Refuse combinations that mean nothing."""
        for name in ("uniform_floor", "label_smoothing"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name}={getattr(self, name)}: expected a share in [0, 1]")
        if (self.loss_weighting or self.regularization) and not self.auxiliary:
            raise ValueError("loss_weighting and regularization need auxiliary=True")
        if self.learned_targets and not self.regularization:
            raise ValueError("learned_targets=True needs regularization=True")


class LossTerms(NamedTuple):
    """The parts of the loss, means over the batch; `total` is what is minimized."""

    total: Float[Array, ""]
    main: Float[Array, ""]
    auxiliary: Float[Array, ""]
    regularization: Float[Array, ""]
    anchor: Float[Array, ""]


def cross_entropy(
    logits: Float[Array, "*s c"], labels: Int[Array, "*s"], smoothing: float = 0.0
) -> Float[Array, "*s"]:
    r"""Cross entropy per example, with label smoothing.

    .. math:: L = -\sum_c q_c \log p_c, \qquad q = (1-\epsilon)\,\text{onehot} + \epsilon / C
    """
    logp = jax.nn.log_softmax(logits, axis=-1)
    picked = jnp.sum(jax.nn.one_hot(labels, logits.shape[-1]) * logp, axis=-1)
    return -(1.0 - smoothing) * picked - smoothing * jnp.mean(logp, axis=-1)


def loss_targets(
    losses: Float[Array, "b k"], normalizer: Normalizer, tau: float | Array = 1.0
) -> Float[Array, "b k"]:
    r"""Fixed fusion-weight targets from the auxiliary losses of each example.

    .. math::
        \text{softmax\_sigmoid:} \quad t = \text{softmax}(\sigma(e^{-L})) \qquad
        \text{softmax:} \quad t = \text{softmax}(-L/\tau)

    The first is Equation 3.1 as printed; for K = 9 its values lie in [0.090, 0.136]. The second is
    :math:`e^{-L/\tau}` normalized by its sum.

    Source: Shim (2020), Eq. 3.1. Deviation: the second form.
    """
    if normalizer == "softmax_sigmoid":
        return normalize(jnp.exp(-losses), normalizer)
    return jax.nn.softmax(-losses / tau, axis=-1)


def argate_loss(
    config: LossConfig,
    params: LossParams,
    logits: Float[Array, "b c"],
    labels: Int[Array, " b"],
    weights: Float[Array, "b k"],
    aux_losses: Float[Array, "b k"] | None = None,
    targets: Float[Array, "b k"] | None = None,
    target_losses: Float[Array, "b k"] | None = None,
    counted: Float[Array, " b"] | None = None,
) -> LossTerms:
    r"""The training loss of a gated network with auxiliary paths.

    .. math::
        L = L_{main} + \alpha \sum_k w_k L^{aux}_k + \beta \sum_k (w_k - t_k)^2
            + \lambda \sum_k \left(t_k - \text{softmax}(-L^{aux}/\tau)_k\right)^2

    averaged over the examples of the batch. With `loss_weighting=False` the alpha term is the
    mean of the auxiliary losses (ARGate-WS).

    Args:
        config: which terms are there; static.
        params: alpha, beta, tau and the anchor weight (lambda).
        logits: of the main model.
        labels: class numbers.
        weights: fusion weights w.
        aux_losses: cross entropy of each auxiliary path, per example; None without auxiliary paths.
        targets: learned targets f_k(aux_losses); None for the fixed ones.
        target_losses: losses that the fixed targets are made of; None for `aux_losses`.
        counted: which examples the weights are regularized in, 1 or 0; None for all.

    Returns:
        The terms, scalars.

    Source: Shim (2020), Eq. 3.1 and 3.2. Deviation: the anchor term, off by default.
    """
    main = jnp.mean(cross_entropy(logits, labels, config.label_smoothing))
    zero = jnp.zeros_like(main)
    if not config.auxiliary or aux_losses is None:
        return LossTerms(main, main, zero, zero, zero)
    if config.loss_weighting:
        w = jax.lax.stop_gradient(weights) if config.stop_weights else weights
        floor = config.uniform_floor
        w = (1.0 - floor) * w + floor / weights.shape[-1]
        auxiliary = jnp.mean(jnp.sum(w * aux_losses, axis=-1))
    else:
        auxiliary = jnp.mean(aux_losses)
    regularization = anchor = zero
    if config.regularization:
        seen = aux_losses if target_losses is None else target_losses
        seen = jax.lax.stop_gradient(seen) if config.stop_targets else seen
        fixed = loss_targets(seen, config.normalizer, params.tau)
        target = fixed if targets is None else targets
        share = jnp.ones(weights.shape[:1]) if counted is None else counted
        regularization = jnp.mean(share * jnp.sum((weights - target) ** 2, axis=-1))
        if targets is not None:
            anchor = jnp.mean(share * jnp.sum((targets - fixed) ** 2, axis=-1))
    total = main + params.alpha * auxiliary + params.beta * regularization + params.anchor * anchor
    return LossTerms(total, main, auxiliary, regularization, anchor)
