"""The ARGate losses, Equations 3.1 and 3.2, per example; every gradient path is an option."""

from __future__ import annotations

from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from fusion._checks import check_choice
from fusion.gating import Normalizer, normalize, oracle_weights
from fusion.loss_config import Imitation, LossConfig, LossParams


class GatePenalty(NamedTuple):
    """What the gate adds to a loss, means over the batch; `total` is the weighted sum."""

    total: Float[Array, ""]
    auxiliary: Float[Array, ""]
    regularization: Float[Array, ""]
    anchor: Float[Array, ""]


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
    losses: Float[Array, "b k"], form: Normalizer, tau: float | Array = 1.0
) -> Float[Array, "b k"]:
    r"""Fixed fusion-weight targets from the auxiliary losses of each example.

    .. math::
        \text{softmax\_sigmoid:} \quad t = \text{softmax}(\sigma(e^{-L})) \qquad
        \text{softmax:} \quad t = \text{softmax}(-L/\tau)

    The first is Equation 3.1 as printed; for K = 9 its values lie in [0.090, 0.136]. The second is
    :math:`e^{-L/\tau}` normalized by its sum.

    Source: Shim (2020), Eq. 3.1. Deviation: the second form.
    """
    if form == "softmax_sigmoid":
        return normalize(jnp.exp(-losses), form)
    return jax.nn.softmax(-losses / tau, axis=-1)


def distance_to_targets(
    weights: Float[Array, "b k"], targets: Float[Array, "b k"], form: Imitation | str = "squared"
) -> Float[Array, " b"]:
    r"""How far the fusion weights of each example lie from their targets.

    .. math::
        \text{squared:} \; \sum_k (w_k - t_k)^2 \qquad
        \text{kl:} \; \sum_k \bar t_k \log \frac{\bar t_k}{w_k}, \;
        \bar t_k = \frac{t_k}{\sum_j t_j}

    The squared distance of weights that are nearly equal has hardly a gradient; the divergence
    has.

    Source: Shim (2020), Eq. 3.1, for `"squared"`. Deviation: `"kl"`.

    Example:
        >>> w, t = jnp.array([[0.5, 0.5]]), jnp.array([[1.0, 0.0]])
        >>> distance_to_targets(w, t).tolist()
        [0.5]
    """
    check_choice("form", form, get_args(Imitation))
    if form == "squared":
        return jnp.sum((weights - targets) ** 2, axis=-1)
    tiny = jnp.asarray(1e-6, targets.dtype)
    share = (targets + tiny) / jnp.sum(targets + tiny, axis=-1, keepdims=True)
    return jnp.sum(share * (jnp.log(share) - jnp.log(weights + tiny)), axis=-1)


def mask_penalty(weights: Float[Array, "b k"], failed: Bool[Array, "b k"]) -> Float[Array, " b"]:
    r"""Cross entropy of the fusion weights with equal shares of the sensors that work.

    .. math:: -\sum_k o_k \log w_k, \qquad o_k = \frac{1 - m_k}{\sum_j (1 - m_j)}

    Honest wherever failures are simulated in training, since the mask is known there; nothing of it
    is read at inference.

    Example:
        >>> w, failed = jnp.array([[0.5, 0.5]]), jnp.array([[True, False]])
        >>> round(float(mask_penalty(w, failed)[0]), 4)
        0.6931
    """
    return -jnp.sum(oracle_weights(failed) * jnp.log(weights + 1e-6), axis=-1)


def product_of_experts(
    targets: Float[Array, "b k"], aux_logits: Float[Array, "b k c"], labels: Int[Array, " b"]
) -> Float[Array, " b"]:
    r"""Cross entropy of the auxiliary paths' joint opinion, with the targets as exponents.

    .. math:: -\log \frac{\prod_k p_k(y)^{f_k}}{\sum_c \prod_k p_k(c)^{f_k}}

    It trains the targets and not the paths: no gradient flows into the logits.

    Source: Hinton (2002), products of experts; Shim (2020), Eq. 3.2, for f.

    Example:
        >>> experts = jnp.log(jnp.array([[[0.9, 0.1], [0.5, 0.5]]]))
        >>> round(float(product_of_experts(jnp.ones((1, 2)), experts, jnp.array([0]))[0]), 4)
        0.1054
    """
    experts = jax.lax.stop_gradient(jax.nn.log_softmax(aux_logits, axis=-1))
    return cross_entropy(jnp.einsum("bk,bkc->bc", targets, experts), labels)


def gate_penalty(
    config: LossConfig,
    params: LossParams,
    weights: Float[Array, "b k"],
    aux_losses: Float[Array, "b k"],
    targets: Float[Array, "b k"] | None = None,
    *,
    target_losses: Float[Array, "b k"] | None = None,
    counted: Float[Array, " b"] | None = None,
) -> GatePenalty:
    r"""What Equations 3.1 and 3.2 add to the loss of any main task.

    .. math::
        \alpha \sum_k w_k L^{aux}_k + \beta \sum_k (w_k - t_k)^2
            + \lambda \sum_k \left(t_k - \text{softmax}(-L^{aux}/\tau)_k\right)^2

    averaged over the examples of the batch. With `loss_weighting=False` the alpha term is the
    mean of the auxiliary losses (ARGate-WS).

    Args:
        config: which terms are there; static.
        params: alpha, beta, tau and the anchor weight (lambda).
        weights: fusion weights w.
        aux_losses: loss of each auxiliary path, per example.
        targets: learned targets f_k(aux_losses); None for the fixed ones.
        target_losses: losses that the fixed targets are made of; None for `aux_losses`.
        counted: which examples the weights are regularized in, 1 or 0; None for all.

    Returns:
        The terms, scalars.

    Source: Shim (2020), Eq. 3.1 and 3.2. Deviation: the anchor term, off by default.

    Example:
        >>> w, losses = jnp.full((1, 2), 0.5), jnp.array([[1.0, 3.0]])
        >>> float(gate_penalty(LossConfig(), LossParams(beta=0.0), w, losses).auxiliary)
        2.0
    """
    zero = jnp.zeros((), weights.dtype)
    if not config.auxiliary:
        return GatePenalty(zero, zero, zero, zero)
    if config.loss_weighting:
        w = jax.lax.stop_gradient(weights) if config.stop_weights else weights
        floor = config.uniform_floor
        w = (1.0 - floor) * w + floor / weights.shape[-1]
        auxiliary = jnp.mean(jnp.sum(w * aux_losses, axis=-1))
    else:
        auxiliary = jnp.mean(aux_losses)
    regularization = anchor = zero
    if config.regularization:
        given = aux_losses if target_losses is None else target_losses
        given = jax.lax.stop_gradient(given) if config.stop_targets else given
        fixed = loss_targets(given, config.fixed_targets, params.tau)
        target = fixed if targets is None else targets
        share = jnp.ones(weights.shape[:1]) if counted is None else counted
        regularization = jnp.mean(share * distance_to_targets(weights, target, config.imitation))
        if targets is not None:
            anchor = jnp.mean(share * jnp.sum((targets - fixed) ** 2, axis=-1))
    total = params.alpha * auxiliary + params.beta * regularization + params.anchor * anchor
    return GatePenalty(total, auxiliary, regularization, anchor)


def argate_loss(
    config: LossConfig,
    params: LossParams,
    logits: Float[Array, "b c"],
    labels: Int[Array, " b"],
    weights: Float[Array, "b k"],
    aux_losses: Float[Array, "b k"] | None = None,
    targets: Float[Array, "b k"] | None = None,
    aux_logits: Float[Array, "b k c"] | None = None,
) -> LossTerms:
    r"""The training loss of a classifier with a gate and auxiliary paths.

    .. math:: L = L_{main} + P(w, L^{aux}, t)

    with the cross entropy of the main model and the penalty P of `gate_penalty`, averaged over the
    examples of the batch.

    Args:
        config: which terms are there; static.
        params: alpha, beta, tau and the anchor weight (lambda).
        logits: of the main model.
        labels: class numbers.
        weights: fusion weights w.
        aux_losses: cross entropy of each auxiliary path, per example; None without auxiliary paths.
        targets: learned targets f_k(aux_losses); None for the fixed ones.
        aux_logits: of the auxiliary paths, for `target_training="experts"`, which adds
            `product_of_experts` to the total and lets nothing else train the targets.

    Returns:
        The terms, scalars.

    Raises:
        ValueError: targets that experts train, and no `aux_logits`.

    Source: Shim (2020), Eq. 3.1 and 3.2.

    Example:
        >>> logits, labels = jnp.zeros((1, 2)), jnp.array([0])
        >>> terms = argate_loss(LossConfig(), LossParams(), logits, labels, jnp.ones((1, 3)) / 3)
        >>> round(float(terms.total), 4)
        0.6931
    """
    main = jnp.mean(cross_entropy(logits, labels, config.label_smoothing))
    if not config.auxiliary or aux_losses is None:
        zero = jnp.zeros_like(main)
        return LossTerms(main, main, zero, zero, zero)
    judged = jnp.zeros_like(main)
    if config.target_training == "experts" and targets is not None:
        if aux_logits is None:
            raise ValueError(
                "aux_logits=None: expected the logits of the auxiliary paths, which "
                "target_training='experts' reads; give them"
            )
        judged = jnp.mean(product_of_experts(targets, aux_logits, labels))
        targets = jax.lax.stop_gradient(targets)
    gate = gate_penalty(config, params, weights, aux_losses, targets)
    return LossTerms(
        main + gate.total + judged, main, gate.auxiliary, gate.regularization, gate.anchor
    )
