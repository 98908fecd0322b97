"""The compared networks: baseline, NetGated, ARGate-WS, ARGate+, ARGate-L, and three references.

All of them share encoders and head; a `Recipe` says what differs. Parameters are one dict:
`main` is what inference needs, `aux` (unisensory heads) and `targets` (the lattice of
Equation 3.2) exist in training only.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fusion.encoders import EncoderConfig, encoder, stacked_dense
from fusion.gating import (
    Gate,
    Normalizer,
    apply_weights,
    drop_modalities,
    embrace,
    oracle_weights,
)
from fusion.losses import LossConfig
from fusion.targets import TargetConfig, init_targets

__all__ = [
    "MODELS",
    "AuxiliaryPaths",
    "FusionNet",
    "MainOutput",
    "ModelConfig",
    "Recipe",
    "auxiliary_logits",
    "count_parameters",
    "export",
    "init",
    "loss_config",
    "match_parameters",
    "predict",
]

Params = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Recipe:
    """What sets one model apart from the others.

    Attributes:
        gate: where the fusion weights come from; `"none"` is plain late fusion.
        auxiliary: unisensory paths that share the encoders (WS).
        loss_weighting: auxiliary losses weighted by the fusion weights (ALW).
        regularization: fusion weights pulled to targets (FWR).
        learned_targets: targets from the monotone lattice.
        modality_dropout: probability that a sensor's features are dropped in training.
    """

    gate: Literal["none", "learned", "oracle", "embrace"] = "none"
    auxiliary: bool = False
    loss_weighting: bool = False
    regularization: bool = False
    learned_targets: bool = False
    modality_dropout: float = 0.0


MODELS: dict[str, Recipe] = {
    "baseline": Recipe(),
    "netgated": Recipe(gate="learned"),
    "argate_ws": Recipe(gate="learned", auxiliary=True),
    "argate_plus": Recipe(gate="learned", auxiliary=True, loss_weighting=True, regularization=True),
    "argate_l": Recipe(
        gate="learned",
        auxiliary=True,
        loss_weighting=True,
        regularization=True,
        learned_targets=True,
    ),
    "modality_dropout": Recipe(modality_dropout=0.2),
    "embracenet": Recipe(gate="embrace"),
    "oracle": Recipe(gate="oracle", auxiliary=True),
}
"""The models by name. The first five are the source's; the others are references."""


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """A network, completely: what it is (`model`), what it reads, how wide it is.

    Attributes:
        model: a name in `MODELS`.
        n_sensors, n_times, n_classes: shape of the problem.
        encoder: the unisensory encoders.
        gate_width: hidden units of the FC-con block.
        head_widths: hidden layers after fusion; `match_parameters` moves the first.
        aux_width: hidden units of each auxiliary head; 0 for a linear head.
        embrace_width: width that EmbraceNet docks each sensor's features to before it draws.
        dropout: rate after fusion and in the head, in training.
        fusion: `"concat"` keeps each sensor's features apart, `"sum"` adds them.
        normalizer: of the fusion weights, see `fusion.gating.normalize`.
        weight_sharing: auxiliary paths share the encoders; else they have their own (ablation).
        loss_weighting, regularization, learned_targets: override the recipe (ablation).
        targets: the lattice of Equation 3.2.
    """

    model: str = "argate_l"
    n_sensors: int = 9
    n_times: int = 128
    n_classes: int = 6
    encoder: EncoderConfig = dataclasses.field(default_factory=EncoderConfig)
    gate_width: int = 32
    head_widths: tuple[int, ...] = (128,)
    aux_width: int = 0
    embrace_width: int = 128
    dropout: float = 0.2
    fusion: Literal["concat", "sum"] = "concat"
    scale: Literal["mean", "max"] = "mean"
    normalizer: Normalizer = "softmax"
    weight_sharing: bool = True
    loss_weighting: bool | None = None
    regularization: bool | None = None
    learned_targets: bool | None = None
    targets: TargetConfig = dataclasses.field(default_factory=TargetConfig)

    def __post_init__(self) -> None:
        """Refuse what cannot be built, by name and value."""
        if self.model not in MODELS:
            raise ValueError(f"model={self.model!r} is not known; known: {', '.join(MODELS)}")
        if self.fusion not in ("concat", "sum"):
            raise ValueError(f"fusion={self.fusion!r}: expected 'concat' or 'sum'")
        if not 0.0 <= self.dropout < 1.0:
            raise ValueError(f"dropout={self.dropout}: expected a rate in [0, 1)")
        for name in ("n_sensors", "n_times", "n_classes", "gate_width"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: expected at least 1")

    @property
    def recipe(self) -> Recipe:
        """The model's recipe with this config's ablations applied."""
        base = MODELS[self.model]
        flags = {
            name: value
            for name in ("loss_weighting", "regularization", "learned_targets")
            if (value := getattr(self, name)) is not None
        }
        return dataclasses.replace(base, **flags)


class MainOutput(NamedTuple):
    """What the main model gives: logits, fusion weights and the features they weight."""

    logits: Float[Array, "b c"]
    weights: Float[Array, "b k"]
    features: Float[Array, "k b f"]


def _dropout(key: Array, x: Array, rate: float) -> Array:
    keep = jax.random.bernoulli(key, 1.0 - rate, x.shape)
    return jnp.where(keep, x / (1.0 - rate), 0.0)


class FusionNet(nn.Module):
    """The main model: encoders, fusion weights, fusion, head."""

    config: ModelConfig

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "b k t"],
        key: Array | None = None,
        failed: Bool[Array, "b k"] | None = None,
    ) -> MainOutput:
        """Run the network.

        Args:
            x: windows, `[batch, sensor, time]`, scaled to [-1, 1].
            key: PRNG key in training (dropout, random fusion); None at inference.
            failed: which sensors failed; read by the oracle gate only.
        """
        config, recipe = self.config, self.config.recipe
        b, k, t = x.shape
        features = encoder(config.encoder, t, "encoder")(jnp.transpose(x, (1, 0, 2)))
        weights = jnp.full((b, k), 1.0 / k, x.dtype)
        if recipe.gate == "learned":
            weights = Gate(config.gate_width, config.normalizer, name="gate")(features)
        elif recipe.gate == "oracle":
            if failed is None:
                raise ValueError("the oracle gate needs `failed`, the mask of failed sensors")
            weights = oracle_weights(failed)
        used = features
        if key is not None and recipe.modality_dropout > 0.0:
            used = drop_modalities(jax.random.fold_in(key, 0), used, recipe.modality_dropout)
        if recipe.gate == "embrace":
            docked = nn.relu(stacked_dense(self, "dock", used, config.embrace_width))
            h = embrace(docked, None if key is None else jax.random.fold_in(key, 1))
        else:
            h = apply_weights(used, weights, config.fusion, config.scale)
        for layer, width in enumerate((*config.head_widths, config.n_classes)):
            if key is not None and config.dropout > 0.0:
                h = _dropout(jax.random.fold_in(key, 2 + layer), h, config.dropout)
            h = nn.Dense(width, name=f"head{layer}")(h)
            if layer < len(config.head_widths):
                h = nn.relu(h)
        return MainOutput(h, weights, features)


class AuxiliaryPaths(nn.Module):
    """One classifier per sensor, on shared features or (ablation) on an encoder of its own."""

    config: ModelConfig

    @nn.compact
    def __call__(
        self, x: Float[Array, "b k t"], features: Float[Array, "k b f"]
    ) -> Float[Array, "b k c"]:
        """Return the logits of every unisensory path."""
        config = self.config
        h = features
        if not config.weight_sharing:
            h = encoder(config.encoder, x.shape[-1], "encoder")(jnp.transpose(x, (1, 0, 2)))
        if config.aux_width:
            h = nn.relu(stacked_dense(self, "hidden", h, config.aux_width))
        logits = stacked_dense(self, "logits", h, config.n_classes, scale=0.3)
        return jnp.transpose(logits, (1, 0, 2))


def init(key: Array, config: ModelConfig) -> Params:
    """Draw the parameters: `main`, and `aux` and `targets` where the recipe has them."""
    main_key, aux_key, target_key = jax.random.split(key, 3)
    x = jnp.zeros((1, config.n_sensors, config.n_times))
    failed = jnp.zeros((1, config.n_sensors), bool)
    features = jnp.zeros((config.n_sensors, 1, config.encoder.features))
    params = {"main": FusionNet(config).init(main_key, x, failed=failed)["params"]}
    if config.recipe.auxiliary:
        params["aux"] = AuxiliaryPaths(config).init(aux_key, x, features)["params"]
    if config.recipe.learned_targets:
        params["targets"] = init_targets(target_key, config.targets, config.n_sensors)
    return params


def predict(
    main: Params,
    config: ModelConfig,
    x: Float[Array, "b k t"],
    failed: Bool[Array, "b k"] | None = None,
    *,
    key: Array | None = None,
) -> MainOutput:
    """Run the main model; no auxiliary parameter is read.

    Args:
        main: `export(params)`.
        config: static.
        x: windows, `[batch, sensor, time]`, scaled to [-1, 1].
        failed: which sensors failed; read by the oracle gate only.
        key: PRNG key of dropout and random fusion, in training only.

    Returns:
        Logits, fusion weights and features.
    """
    return cast(MainOutput, FusionNet(config).apply({"params": main}, x, key, failed))


def auxiliary_logits(
    params: Params, config: ModelConfig, x: Float[Array, "b k t"], features: Float[Array, "k b f"]
) -> Float[Array, "b k c"]:
    """Logits of the unisensory paths, from the features of the main model."""
    return cast(Array, AuxiliaryPaths(config).apply({"params": params["aux"]}, x, features))


def export(params: Params) -> Params:
    """What inference needs: the main model's parameters, without auxiliary paths and lattice."""
    return params["main"]


def loss_config(config: ModelConfig, **options: Any) -> LossConfig:
    """The loss terms that belong to this model; `options` are the fields of `LossConfig`."""
    recipe = config.recipe
    return LossConfig(
        auxiliary=recipe.auxiliary,
        loss_weighting=recipe.loss_weighting,
        regularization=recipe.regularization,
        learned_targets=recipe.learned_targets,
        normalizer=config.normalizer,
        **options,
    )


def count_parameters(config: ModelConfig) -> dict[str, int]:
    """Number of trainable values by part (`main`, `aux`, `targets`) and in `total`."""
    shapes = jax.eval_shape(lambda key: init(key, config), jax.random.key(0))
    counts = {
        part: sum(leaf.size for leaf in jax.tree.leaves(tree)) for part, tree in shapes.items()
    }
    return counts | {"total": sum(counts.values())}


def match_parameters(config: ModelConfig, reference: ModelConfig) -> ModelConfig:
    """Choose the width of the first head layer so that both have the same number of parameters.

    The counts are of all trainable values, auxiliary paths and lattice included: a model gets no
    advantage from what it carries in training.

    Raises:
        ValueError: no width brings the totals within 2 %.
    """
    if not config.head_widths:
        raise ValueError("head_widths is empty: matching needs one hidden layer in the head")
    wanted = count_parameters(reference)["total"]

    def at(width: int) -> ModelConfig:
        return dataclasses.replace(config, head_widths=(width, *config.head_widths[1:]))

    low, high = count_parameters(at(1))["total"], count_parameters(at(2))["total"]
    width = max(1, round(1 + (wanted - low) / (high - low)))
    matched = at(width)
    total = count_parameters(matched)["total"]
    if abs(total - wanted) > 0.02 * wanted:
        raise ValueError(
            f"{config.model} has {total} parameters with a head of {width}, {reference.model} has "
            f"{wanted}: not within 2 %; change encoder.features or head_widths"
        )
    return matched
