"""The compared networks: baseline, NetGated, ARGate-WS, ARGate+, ARGate-L, and three references.

All of them share encoders and head; a `Recipe` says what differs. Parameters are one dict:
`main` is what inference needs, `aux` (unisensory heads) and `targets` (the lattice of
Equation 3.2) exist in training only.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from fusion._checks import check_key, check_mask
from fusion._inputs import check_read, check_windows
from fusion.bayesian_gate import VariationalGate
from fusion.config import ModelConfig
from fusion.encoders import encoder
from fusion.gating import (
    Gate,
    apply_weights,
    available_weights,
    drop_modalities,
    embrace,
    oracle_weights,
)
from fusion.neighbours import EPSILON, Memory, neighbour_probabilities, read_memory
from fusion.stacked import stacked_dense
from fusion.tables import TableEncoder
from fusion.targets import init_targets

Params = dict[str, Any]


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
        available: Bool[Array, "b k"] | None = None,
        memory: Memory | None = None,
        excluded: Bool[Array, "b m"] | None = None,
        given: Float[Array, "b k"] | None = None,
    ) -> MainOutput:
        """Run the network.

        Args:
            x: windows, `[batch, sensor, time]`, scaled to [-1, 1].
            key: PRNG key in training (dropout, random fusion); None at inference.
            failed: which sensors failed; read by the oracle gate only.
            available: which sensors are there, see `predict`; all of them when None.
            memory: training rows that a neighbourhood head compares with.
            excluded: rows of the memory that an example may not see.
            given: fusion weights in place of the gate's own.
        """
        config, recipe = self.config, self.config.recipe
        b, k, t = x.shape
        encode = encoder(config.encoder, t, "encoder")
        features = encode(jnp.transpose(x, (1, 0, 2)))
        if available is not None:
            features = jnp.where(available.T[:, :, None], features, jnp.zeros_like(features))
        weights = jnp.full((b, k), 1.0 / k, x.dtype)
        if given is not None:
            weights = given
        elif recipe.gate == "learned" and config.variational:
            gate_key = None if key is None else jax.random.fold_in(key, 50)
            weights = variational_gate(config, "gate")(features, gate_key)
        elif recipe.gate == "learned":
            weights = Gate(config.gate_width, config.normalizer, config.own_scores, name="gate")(
                features
            )
        elif recipe.gate == "oracle":
            if failed is None:
                raise ValueError(
                    "failed=None: expected the mask of failed sensors for the oracle gate; give it"
                )
            weights = oracle_weights(failed if available is None else failed | ~available)
        if available is not None:
            weights = available_weights(weights, available)
        used = features
        if key is not None and recipe.modality_dropout > 0.0:
            drop_key = jax.random.fold_in(key, 0)
            used = drop_modalities(used, recipe.modality_dropout, key=drop_key)
        if recipe.gate == "embrace":
            docked = nn.relu(stacked_dense(self, "dock", used, config.embrace_width))
            keep = None if available is None else available.astype(docked.dtype)
            # At inference it draws, too: the head knows nothing else. The draw is always the same.
            drawn = jax.random.key(0) if key is None else jax.random.fold_in(key, 1)
            h = embrace(docked, keep, key=drawn, shared=key is None)
        else:
            h = apply_weights(used, weights, config.fusion, config.scale)
        for layer, width in enumerate((*config.head_widths, config.n_classes)):
            if key is not None and config.dropout > 0.0:
                h = _dropout(jax.random.fold_in(key, 2 + layer), h, config.dropout)
            h = nn.Dense(width, name=f"head{layer}")(h)
            if layer < len(config.head_widths):
                h = nn.relu(h)
        if config.head == "neighbourhood":
            sharpness = jnp.exp(self.param("log_sharpness", nn.initializers.zeros, ()))
            if memory is not None:
                sharpness = sharpness * (config.sharpening if excluded is None else 1.0)
                shares = neighbour_probabilities(
                    features[..., :-1],
                    weights,
                    cast(TableEncoder, encode).recall(memory.rows),
                    memory.labels,
                    config.n_classes,
                    sharpness,
                    excluded=excluded,
                )
                h = h + jnp.log(shares + EPSILON)
        return MainOutput(h, weights, features)


def variational_gate(config: ModelConfig, name: str | None = None) -> VariationalGate:
    """The gate of a variational network, by itself or as a part with a name."""
    whole = config.gate_kind == "variational_whole"
    sizes = config.gate_width, config.normalizer, config.own_scores, config.gate_prior, whole
    return VariationalGate(*sizes, name=name)


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


def init(key: Key[Array, ""], config: ModelConfig) -> Params:
    """Draw the parameters: `main`, and `aux` and `targets` where the loss has them.

    Raises:
        ValueError: a legacy key.

    Example:
        >>> config = ModelConfig("argate_ws", n_sensors=2, n_times=1, n_classes=3)
        >>> sorted(init(jax.random.key(0), config))
        ['aux', 'main']
    """
    check_key(key)
    main_key, aux_key, target_key = jax.random.split(key, 3)
    x = jnp.zeros((1, config.n_sensors, config.n_times))
    failed = jnp.zeros((1, config.n_sensors), bool)
    features = jnp.zeros((config.n_sensors, 1, config.encoder.width))
    params = {"main": FusionNet(config).init(main_key, x, failed=failed)["params"]}
    loss = config.recipe.loss
    if loss.auxiliary:
        params["aux"] = AuxiliaryPaths(config).init(aux_key, x, features)["params"]
    if loss.learned_targets:
        params["targets"] = init_targets(target_key, config.targets, config.n_sensors)
    return params


def predict(
    config: ModelConfig,
    main: Params,
    x: Float[Array, "b k t"],
    failed: Bool[Array, "b k"] | None = None,
    *,
    available: Bool[Array, "b k"] | None = None,
    excluded: Bool[Array, "b m"] | None = None,
    weights: Float[Array, "b k"] | None = None,
    key: Key[Array, ""] | None = None,
) -> MainOutput:
    """Run the main model; no auxiliary parameter is read.

    A sensor is absent where `available` is False, and, without a key, where its window holds NaN.
    The readings and features of an absent sensor have no influence: the gate reads zeros in their
    place, and the fusion weights of the others are scaled to the sum of all. Without any sensor
    all weights are zero and the logits tell nothing.

    Args:
        config: static.
        main: `export(params)`.
        x: windows, `[batch, sensor, time]`, scaled to [-1, 1].
        failed: which sensors failed, for the oracle gate only (`config.reads_failed`); the other
            models find out by themselves. To tell any model that a sensor is dead, give
            `available`.
        available: False for sensors that sent nothing; all are there when None.
        excluded: rows of the memory that an example may not see, such as itself in training, for a
            neighbourhood head only.
        weights: fusion weights in place of the gate's own; those of absent sensors are taken out.
            Given with `failed`, which they would hide, they are refused.
        key: PRNG key of dropout, random fusion and draws of a variational gate, in training only;
            without it a variational gate has its mean parameters.

    Returns:
        Logits, fusion weights and features.

    Raises:
        ValueError: a shape that is not the model's, a legacy key, an oracle without `failed`,
            `failed` or `excluded` for a model that does not read them.

    Example:
        >>> config = ModelConfig("netgated", n_sensors=3, n_times=1, n_classes=2)
        >>> main = export(init(jax.random.key(0), config))
        >>> x = jnp.array([[[0.1], [jnp.nan], [0.3]]])
        >>> predict(config, main, x).weights.tolist()
        [[0.5, 0.0, 0.5]]
    """
    if key is not None:
        check_key(key)
    check_windows(config, x)
    for name, mask in (("failed", failed), ("available", available), ("weights", weights)):
        if mask is not None:
            check_mask(name, mask, x.shape[:2], numbers=name == "weights")
    check_read(config, failed, excluded, weights)
    if key is None:
        there = ~jnp.any(jnp.isnan(x), axis=-1)
        available = there if available is None else available & there
    if available is not None:
        available = available.astype(bool)
        x = jnp.where(available[:, :, None], x, jnp.zeros_like(x))
    if "main" in main:
        raise ValueError(
            "main=parameters with auxiliary paths: expected those of the main model; take "
            "export(state.params)"
        )
    main, memory = read_memory(main)
    if config.head == "neighbourhood" and memory is None:
        raise ValueError(
            "main=parameters without a memory: expected the rows that head='neighbourhood' "
            "compares with; take export(state.params) of a trained network"
        )
    net = FusionNet(config)
    inputs = x, key, failed, available, memory, excluded, weights
    return cast(MainOutput, net.apply({"params": main}, *inputs))


def auxiliary_logits(
    config: ModelConfig, params: Params, x: Float[Array, "b k t"], features: Float[Array, "k b f"]
) -> Float[Array, "b k c"]:
    """Logits of the unisensory paths, from the features of the main model."""
    return cast(Array, AuxiliaryPaths(config).apply({"params": params["aux"]}, x, features))


def export(params: Params) -> Params:
    """What inference needs: the main model's parameters, without auxiliary paths and lattice.

    A network with a neighbourhood head needs its memory, too: clean training rows.

    Returns:
        The tree that `predict` takes.

    Example:
        >>> from fusion.config import ModelConfig
        >>> params = init(jax.random.key(0), ModelConfig("baseline", n_sensors=3, n_times=1))
        >>> export(params) is params["main"]
        True
    """
    if "memory" in params:
        return params["main"] | {"memory": params["memory"]}
    return params["main"]
