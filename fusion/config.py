"""What a network and its training are: static configurations, and numbers that may be traced."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple, get_args

from jaxtyping import Array

from fusion._checks import check_choice, check_count, check_counts, check_number, check_type
from fusion.bayesian_gate import GateKind
from fusion.encoders import EncoderConfig
from fusion.gating import Fusion, Normalizer, Scaling
from fusion.losses import LossConfig, LossParams
from fusion.targets import TargetConfig


@dataclasses.dataclass(frozen=True)
class Recipe:
    """What sets one model apart from the others.

    Attributes:
        gate: where the fusion weights come from; `"none"` is plain late fusion.
        loss: which terms of the loss it has: auxiliary paths (WS), weighted (ALW), targets (FWR).
        modality_dropout: probability that a sensor's features are dropped in training.
        printed: Equations 3.1 and 3.2 to the letter; presets add nothing to them.
    """

    gate: Literal["none", "learned", "oracle", "embrace"]
    loss: LossConfig
    modality_dropout: float = 0.0
    printed: bool = False


_MAIN = LossConfig(
    auxiliary=False, loss_weighting=False, regularization=False, learned_targets=False
)
_PATHS = dataclasses.replace(_MAIN, auxiliary=True)
_PRINTED = LossConfig(fixed_targets="softmax_sigmoid", stop_targets=False, label_smoothing=0.0)

MODELS: dict[str, Recipe] = {
    "baseline": Recipe("none", _MAIN),
    "netgated": Recipe("learned", _MAIN),
    "argate_ws": Recipe("learned", _PATHS),
    "argate_plus": Recipe("learned", LossConfig(learned_targets=False)),
    "argate_l": Recipe("learned", LossConfig()),
    "equal_weights": Recipe("none", _MAIN),
    "argate_plus_printed": Recipe(
        "learned", dataclasses.replace(_PRINTED, learned_targets=False), printed=True
    ),
    "argate_l_printed": Recipe("learned", _PRINTED, printed=True),
    "modality_dropout": Recipe("none", _MAIN, modality_dropout=0.2),
    "embracenet": Recipe("embrace", _MAIN),
    "oracle": Recipe("oracle", _PATHS),
}
"""The models by name. The first five are the source's; the others are references."""


Head = Literal["dense", "neighbourhood"]


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """A network, completely: what it is (`model`), what it reads, how wide it is.

    Attributes:
        model: a name in `MODELS`.
        n_sensors, n_times, n_classes: shape of the problem.
        encoder: the unisensory encoders.
        gate_width: hidden units of the FC-con block.
        own_scores: features also add to their own sensor's score, see `fusion.gating.Gate`.
        gate_kind: `"deterministic"`, or distributions over the parameters of the gate's last layer
            (`"variational"`) or of all of it (`"variational_whole"`), see `fusion.bayesian_gate`.
        gate_prior: standard deviation of their prior, > 0 (variational).
        head_widths: hidden layers after fusion; `match_parameters` moves the first.
        aux_width: hidden units of each auxiliary head; 0 for a linear head.
        embrace_width: width that EmbraceNet docks each sensor's features to before it draws.
        dropout: rate after fusion and in the head, in training.
        head: what reads the weighted features: `"dense"` layers, or `"neighbourhood"`, which adds
            the classes of near training rows (scalar sensors with tables only).
        memory_rows: training rows that each step compares with (neighbourhood).
        sharpening: factor on the learned sharpness where all rows are compared with.
        fusion: `"concat"` keeps each sensor's features apart, `"sum"` adds them.
        scale: `"mean"` multiplies weights by K, `"max"` divides them by the largest.
        normalizer: of the fusion weights, see `fusion.gating.normalize`.
        weight_sharing: auxiliary paths share the encoders; else they have their own (ablation).
        loss: terms of the loss and its gradient paths; None for those of the model's recipe.
        targets: the lattice of Equation 3.2.

    Raises:
        ValueError, TypeError: what cannot be built, by name and value.
    """

    model: str = "argate_l"
    n_sensors: int = 9
    n_times: int = 128
    n_classes: int = 6
    encoder: EncoderConfig = dataclasses.field(default_factory=EncoderConfig)
    gate_width: int = 32
    own_scores: bool = False
    gate_kind: GateKind | str = "deterministic"
    gate_prior: float = 1.0
    head_widths: tuple[int, ...] = (128,)
    aux_width: int = 0
    embrace_width: int = 128
    dropout: float = 0.2
    head: Head = "dense"
    memory_rows: int = 4096
    sharpening: float = 4.0
    fusion: Fusion = "concat"
    scale: Scaling = "mean"
    normalizer: Normalizer = "softmax"
    weight_sharing: bool = True
    loss: LossConfig | None = None
    targets: TargetConfig = dataclasses.field(default_factory=TargetConfig)

    def __post_init__(self) -> None:
        """Refuse what cannot be built, by name and value."""
        check_choice("model", self.model, MODELS)
        for name, options in (("fusion", Fusion), ("scale", Scaling), ("normalizer", Normalizer)):
            check_choice(name, getattr(self, name), get_args(options))
        check_choice("weight_sharing", self.weight_sharing, (True, False))
        check_choice("own_scores", self.own_scores, (True, False))
        check_choice("head", self.head, get_args(Head))
        check_choice("gate_kind", self.gate_kind, get_args(GateKind))
        check_number("gate_prior", self.gate_prior, 0.0, above=True, fix="1 is usual")
        if self.variational and MODELS[self.model].gate != "learned":
            raise ValueError(
                f"gate_kind={self.gate_kind!r}: expected a model with a learned gate, "
                f"{self.model!r} has none; use gate_kind='deterministic' or another model"
            )
        check_count("memory_rows", self.memory_rows)
        check_number("sharpening", self.sharpening, 0.0, above=True, fix="1 changes nothing")
        if self.head == "neighbourhood" and (self.n_times, self.encoder.scalar) != (1, "table"):
            raise ValueError(
                f"head={self.head!r}: expected scalar sensors (n_times=1) with "
                "encoder.scalar='table'; use head='dense' for others"
            )
        check_number("dropout", self.dropout, 0.0, 1.0, below=True, fix="it is a rate")
        for name in ("n_sensors", "n_times", "gate_width", "embrace_width"):
            check_count(name, getattr(self, name))
        check_count("n_classes", self.n_classes, 2)
        check_count("aux_width", self.aux_width, 0)
        check_counts("head_widths", self.head_widths)
        check_type("encoder", self.encoder, EncoderConfig, "build an EncoderConfig")
        check_type("targets", self.targets, TargetConfig, "build a TargetConfig")
        if self.encoder.levels and len(self.encoder.levels) != self.n_sensors:
            raise ValueError(
                f"encoder.levels={len(self.encoder.levels)} rows: expected one for each of "
                f"{self.n_sensors} sensors; make levels with reading_levels"
            )
        if self.encoder.learns_by_reward and not self.recipe.loss.auxiliary:
            raise ValueError(
                "encoder.spiking.learning='reward_stdp': expected a model with auxiliary paths, "
                f"whose losses are the reward, {self.model!r} has none; use 'surrogate' or 'fixed'"
            )
        if self.loss is None:
            return
        check_type("loss", self.loss, LossConfig, "build a LossConfig")
        gate = MODELS[self.model].gate
        for name in ("loss_weighting", "regularization", "mask_supervision"):
            if getattr(self.loss, name) and gate != "learned":
                raise ValueError(
                    f"loss.{name}=True: expected a model with a learned gate, {self.model!r} has "
                    f"none; use loss.{name}=False"
                )

    @property
    def variational(self) -> bool:
        """Does the gate have distributions for parameters."""
        return self.gate_kind != "deterministic"

    @property
    def reads_failed(self) -> bool:
        """Is the network told which sensors failed: the oracle's gate is, no other part is."""
        return MODELS[self.model].gate == "oracle"

    @property
    def recipe(self) -> Recipe:
        """The model's recipe, with the loss of this config where it has one."""
        base = MODELS[self.model]
        return base if self.loss is None else dataclasses.replace(base, loss=self.loss)


Schedule = Literal["cosine", "constant"]


class _HyperParams(NamedTuple):
    learning_rate: float | Array = 2e-3
    weight_decay: float | Array = 1e-3
    loss: LossParams = LossParams()


class HyperParams(_HyperParams):
    """What a sweep may vary; scalars, so `jax.vmap` runs over them without recompiling.

    Attributes:
        learning_rate: of Adam, >= 0; the start of the schedule.
        weight_decay: decoupled, >= 0.
        loss: weights of the terms of the loss.

    Raises:
        ValueError: a number out of its range. Arrays and traced values are not looked at.

    Example:
        >>> HyperParams(1e-2).weight_decay
        0.001
    """

    __slots__ = ()

    def __new__(
        cls,
        learning_rate: Any = 2e-3,
        weight_decay: Any = 1e-3,
        loss: Any = LossParams(),  # noqa: B008
    ) -> HyperParams:
        """Check the numbers that are given as numbers."""
        check_number("learning_rate", learning_rate, 0.0, fix="2e-3 is usual")
        check_number("weight_decay", weight_decay, 0.0, fix="0 turns it off")
        return super().__new__(cls, learning_rate, weight_decay, loss)

    @classmethod
    def _make(cls, iterable: Iterable[Any]) -> HyperParams:  # type: ignore[override]
        return cls(*iterable)


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """What recompiles: sizes and choices of the training run.

    Attributes:
        epochs: passes over the training set; also the length of the cosine schedule.
        batch_size: examples per step; the rest of an epoch that fills no batch is left out.
        schedule: of the learning rate, `"cosine"` to zero or `"constant"`.
        clip_norm: bound of the gradient's global norm.
        jitter: standard deviation of a random gain per channel and example, in training.

    Raises:
        ValueError, TypeError: sizes that make no run, by name and value.
    """

    epochs: int = 20
    batch_size: int = 64
    schedule: Schedule = "cosine"
    clip_norm: float = 5.0
    jitter: float = 0.0

    def __post_init__(self) -> None:
        """Refuse sizes that make no run."""
        for name in ("epochs", "batch_size"):
            check_count(name, getattr(self, name))
        check_choice("schedule", self.schedule, get_args(Schedule))
        check_number("clip_norm", self.clip_norm, 0.0, above=True, fix="1e9 clips nothing")
        check_number("jitter", self.jitter, 0.0, fix="0 turns it off")
