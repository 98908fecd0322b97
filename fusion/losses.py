"""The ARGate losses, Equations 3.1 and 3.2, per example; every gradient path is an option."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from fusion._checks import check_choice, check_number
from fusion.gating import Normalizer, normalize


class _LossParams(NamedTuple):
    alpha: float | Array = 1.0
    beta: float | Array = 1.0
    tau: float | Array = 1.0
    anchor: float | Array = 0.0


class LossParams(_LossParams):
    """What a sweep may vary; leaves are scalars, so `jax.vmap` runs over them.

    Attributes:
        alpha: weight of the auxiliary losses (Equation 3.1), >= 0.
        beta: weight of the fusion-weight regularization (Equation 3.1), >= 0.
        tau: temperature of the target `softmax(-loss / tau)`, > 0; unused by the printed target.
        anchor: weight that pulls learned targets to `softmax(-loss / tau)`, >= 0; 0 as printed.

    Raises:
        ValueError: a number out of its range. Arrays and traced values are not looked at.

    Example:
        >>> LossParams(alpha=0.5)
        LossParams(alpha=0.5, beta=1.0, tau=1.0, anchor=0.0)
    """

    __slots__ = ()

    def __new__(
        cls,
        alpha: Any = 1.0,
        beta: Any = 1.0,
        tau: Any = 1.0,
        anchor: Any = 0.0,
    ) -> LossParams:
        """Check the numbers that are given as numbers."""
        for name, value in (("alpha", alpha), ("beta", beta), ("anchor", anchor)):
            check_number(name, value, 0.0, fix="0 leaves the term out")
        check_number("tau", tau, 0.0, above=True, fix="small temperatures give sharp targets")
        return super().__new__(cls, alpha, beta, tau, anchor)

    @classmethod
    def _make(cls, iterable: Iterable[Any]) -> LossParams:  # type: ignore[override]
        return cls(*iterable)


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Which terms are there and where gradients flow (static).

    Attributes:
        auxiliary: the network has auxiliary paths (WS).
        loss_weighting: auxiliary losses are weighted by the fusion weights (ALW); else the mean.
        regularization: fusion weights are pulled to targets (FWR).
        learned_targets: the targets come from the monotone lattice (Equation 3.2).
        fixed_targets: form of the targets that are made of the losses, see `loss_targets`.
        stop_targets: no gradient from the regularization into the auxiliary losses; without it
            the auxiliary heads can be made worse to please the gate.
        stop_weights: no gradient of the alpha term into the fusion weights; with it the term trains
            the auxiliary paths only, and does not pull w to whichever path fits first.
        uniform_floor: share of equal weighting mixed into the alpha term's weights, in [0, 1], so
            that the path of a sensor with a low weight goes on learning.
        label_smoothing: share of the label mass spread over all classes, in the main loss.
    """

    auxiliary: bool = True
    loss_weighting: bool = True
    regularization: bool = True
    learned_targets: bool = True
    fixed_targets: Normalizer = "softmax"
    stop_targets: bool = True
    stop_weights: bool = False
    uniform_floor: float = 0.0
    label_smoothing: float = 0.05

    def __post_init__(self) -> None:
        """Refuse values out of range and combinations that mean nothing."""
        for name in (
            "auxiliary",
            "loss_weighting",
            "regularization",
            "learned_targets",
            "stop_targets",
            "stop_weights",
        ):
            check_choice(name, getattr(self, name), (True, False))
        check_choice("fixed_targets", self.fixed_targets, get_args(Normalizer))
        for name in ("uniform_floor", "label_smoothing"):
            check_number(name, getattr(self, name), 0.0, 1.0, fix="it is a share")
        for name in ("loss_weighting", "regularization"):
            if getattr(self, name) and not self.auxiliary:
                raise ValueError(
                    f"{name}=True: expected auxiliary=True with it; the term is made of the "
                    "losses of auxiliary paths"
                )
        if self.learned_targets and not self.regularization:
            raise ValueError(
                "learned_targets=True: expected regularization=True with it; targets are for the "
                "regularization"
            )


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
        regularization = jnp.mean(share * jnp.sum((weights - target) ** 2, axis=-1))
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

    Returns:
        The terms, scalars.

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
    gate = gate_penalty(config, params, weights, aux_losses, targets)
    return LossTerms(main + gate.total, main, gate.auxiliary, gate.regularization, gate.anchor)
