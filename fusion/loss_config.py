"""Terms of the ARGate losses: which are there (static), and their weights (may be traced)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple, get_args

from jaxtyping import Array

from fusion._checks import check_choice, check_number
from fusion.gating import Normalizer


class _LossParams(NamedTuple):
    alpha: float | Array = 1.0
    beta: float | Array = 1.0
    tau: float | Array = 1.0
    anchor: float | Array = 0.0
    mask: float | Array = 1.0
    divergence: float | Array = 1.0


class LossParams(_LossParams):
    """What a sweep may vary; leaves are scalars, so `jax.vmap` runs over them.

    Attributes:
        alpha: weight of the auxiliary losses (Equation 3.1), >= 0.
        beta: weight of the fusion-weight regularization (Equation 3.1), >= 0.
        tau: temperature of the target `softmax(-loss / tau)`, > 0; unused by the printed target.
        anchor: weight that pulls learned targets to `softmax(-loss / tau)`, >= 0; 0 as printed.
        mask: weight of the mask of simulated failures, >= 0; read with `mask_supervision` only.
        divergence: weight of the gate's divergence from its prior over the number of training rows,
            >= 0; 1 is Bayes' rule, less is a cold posterior; read with a variational gate only.

    Raises:
        ValueError: a number out of its range. Arrays and traced values are not looked at.

    Example:
        >>> LossParams(alpha=0.5)
        LossParams(alpha=0.5, beta=1.0, tau=1.0, anchor=0.0, mask=1.0, divergence=1.0)
    """

    __slots__ = ()

    def __new__(
        cls,
        alpha: Any = 1.0,
        beta: Any = 1.0,
        tau: Any = 1.0,
        anchor: Any = 0.0,
        mask: Any = 1.0,
        divergence: Any = 1.0,
    ) -> LossParams:
        """Check the numbers that are given as numbers."""
        for name, value in (
            ("alpha", alpha),
            ("beta", beta),
            ("anchor", anchor),
            ("mask", mask),
            ("divergence", divergence),
        ):
            check_number(name, value, 0.0, fix="0 leaves the term out")
        check_number("tau", tau, 0.0, above=True, fix="small temperatures give sharp targets")
        return super().__new__(cls, alpha, beta, tau, anchor, mask, divergence)

    @classmethod
    def _make(cls, iterable: Iterable[Any]) -> LossParams:  # type: ignore[override]
        return cls(*iterable)


Imitation = Literal["squared", "kl"]
TargetTraining = Literal["imitation", "held_out", "experts"]


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Which terms are there and where gradients flow (static).

    Attributes:
        auxiliary: the network has auxiliary paths (WS).
        loss_weighting: auxiliary losses are weighted by the fusion weights (ALW); else the mean.
        regularization: fusion weights are pulled to targets (FWR).
        learned_targets: the targets come from the monotone lattice (Equation 3.2).
        fixed_targets: form of the targets that are made of the losses, see `loss_targets`.
        imitation: how far weights lie from targets: `"squared"` as printed, or `"kl"`, see
            `distance_to_targets`.
        target_training: what learned targets are trained by: `"imitation"` of the weights as in
            Equation 3.2, `"held_out"` rows, see `fusion.bilevel`, or a product of the auxiliary
            paths' `"experts"`, see `fusion.losses.product_of_experts`.
        mask_supervision: the weights learn from the mask of simulated failures, see `mask_penalty`.
        stop_targets: no gradient from the regularization into the auxiliary losses; without it
            the auxiliary heads can be made worse to please the gate.
        stop_weights: no gradient of the alpha term into the fusion weights; with it the term trains
            the auxiliary paths only, and does not pull w to whichever path fits first.
        uniform_floor: share of equal weighting mixed into the alpha term's weights, in [0, 1], so
            that the path of a sensor with a low weight goes on learning.
        label_smoothing: share of the label mass spread over all classes, in the main loss.

    Raises:
        ValueError: a share out of range, or a combination that means nothing.
    """

    auxiliary: bool = True
    loss_weighting: bool = True
    regularization: bool = True
    learned_targets: bool = True
    fixed_targets: Normalizer = "softmax"
    imitation: Imitation | str = "squared"
    target_training: TargetTraining | str = "imitation"
    mask_supervision: bool = False
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
            "mask_supervision",
            "stop_targets",
            "stop_weights",
        ):
            check_choice(name, getattr(self, name), (True, False))
        check_choice("fixed_targets", self.fixed_targets, get_args(Normalizer))
        check_choice("imitation", self.imitation, get_args(Imitation))
        check_choice("target_training", self.target_training, get_args(TargetTraining))
        if self.target_training != "imitation" and not self.learned_targets:
            raise ValueError(
                f"target_training={self.target_training!r}: expected learned_targets=True with it; "
                "fixed targets are not trained"
            )
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
