"""ARGate for the sensors of a folder: unequal shapes, channels that fail together, any target.

`network` builds it around `fusion.modules`, `fit` trains it, `scores` tells how good it is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Key

from fusion._checks import check_choice, check_count, check_key, check_number
from fusion.config import MODELS
from fusion.data.csv_folder import SensorFolder, SensorRows
from fusion.failure_kinds import Kinds, apply_failure
from fusion.failures import Protocol, draw_mask
from fusion.losses import LossConfig, LossParams, cross_entropy
from fusion.modules import ARGate, ARGateLoss, LatticeTargets, project_argate
from fusion.targets import TargetConfig

RECIPES = ("equal_weights", "netgated", "argate_ws", "argate_plus", "argate_l")
"""Models that can be built; `equal_weights` is a gate that never learns."""


@dataclasses.dataclass(frozen=True)
class FolderConfig:
    """Network and training.

    Attributes:
        model: one of `RECIPES`.
        features: of each sensor; width: of gate and head.
        epochs, batch_size, learning_rate, weight_decay: of AdamW with a cosine schedule.

    Raises:
        ValueError, TypeError: what cannot be built, by name and value.
    """

    model: str = "argate_l"
    features: int = 24
    width: int = 32
    epochs: int = 30
    batch_size: int = 32
    learning_rate: float = 5e-3
    weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        check_choice("model", self.model, RECIPES)
        for name in ("features", "width", "epochs", "batch_size"):
            check_count(name, getattr(self, name))
        check_number("learning_rate", self.learning_rate, 0.0, above=True)
        check_number("weight_decay", self.weight_decay, 0.0)

    @property
    def loss(self) -> LossConfig:
        """Terms of the recipe, all auxiliary paths alike."""
        return dataclasses.replace(MODELS[self.model].loss, label_smoothing=0.0, uniform_floor=1.0)


class SensorEncoder(nn.Module):
    """Windows of one sensor `[batch, channel, sample]` to features `[batch, feature]`.

    Convolutions over all channels, pooled, beside mean, spread and size of steps of each channel;
    single samples have the mean alone.
    """

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "b c t"]) -> Float[Array, "b f"]:
        """Return the features."""
        parts = [3.0 * x.mean(-1)]
        if x.shape[-1] > 1:
            step = jnp.mean(jnp.abs(jnp.diff(x, axis=-1)), axis=-1)
            spread = jnp.sqrt(jnp.var(x, axis=-1) + 1e-6)
            h = nn.relu(nn.Conv(16, (5,), name="conv0")(jnp.swapaxes(x, 1, 2)))
            h = nn.relu(nn.Conv(16, (5,), strides=(2,), name="conv1")(h))
            parts += [3.0 * spread, 5.0 * step, h.mean(1), h.max(1)]
        h = nn.relu(nn.Dense(self.features, name="mix")(jnp.concatenate(parts, axis=-1)))
        return nn.relu(nn.Dense(self.features, name="out")(h))


def fusion_of(config: FolderConfig, n_sensors: int, n_outputs: int, *, training: bool) -> ARGate:
    """The network, with auxiliary heads and targets where `training` needs them."""
    heads = n_sensors if training and config.loss.auxiliary else 0
    return ARGate(
        tuple(SensorEncoder(config.features) for _ in range(n_sensors)),
        nn.Sequential([nn.Dense(config.width), nn.relu, nn.Dense(n_outputs)]),
        tuple(nn.Dense(n_outputs) for _ in range(heads)),
        LatticeTargets() if training and config.loss.learned_targets else None,
        gate_width=config.width,
    )


def network(config: FolderConfig, data: SensorFolder) -> ARGateLoss:
    """The network with its loss; parameters of the network alone are under `model`.

    The task loss of an example is the cross entropy of its class times the weight of the class, the
    squared error of its scaled numbers, or the cross entropy of its labels, the mean over columns.
    """
    n_outputs = len(data.names)
    model = fusion_of(config, len(data.sensors), n_outputs, training=True)
    weights = data.class_weights
    weights = np.ones(n_outputs, np.float32) if weights is None else weights

    def task_loss(out: Array, target: Array) -> Array:
        if data.kind == "classes":
            return jnp.asarray(weights)[target] * cross_entropy(out, target)
        if data.kind == "numbers":
            return jnp.mean((out - target) ** 2, axis=-1)
        return jnp.mean(optax.sigmoid_binary_cross_entropy(out, target), axis=-1)

    return ARGateLoss(model, config.loss, task_loss)


def corrupt_sensors(
    protocol: Protocol,
    readings: tuple[Float[Array, "b _ _"], ...],
    kind: Kinds = "uniform",
    *,
    key: Key[Array, ""],
) -> tuple[list[Float[Array, "b _ _"]], Bool[Array, "b k"]]:
    """Draw the failing sensors of every example; all channels of a sensor fail together.

    Args:
        protocol: over the sensors.
        readings: of each sensor, in [-1, 1].
        kind: how they fail, see `fusion.failures.corrupt`.

    Returns:
        Readings, and the mask of failed sensors.
    """
    check_key(key)
    mask_key, value_key = jax.random.split(key)
    failed = draw_mask(protocol, readings[0].shape[0], key=mask_key)
    changed = [
        apply_failure(
            x,
            jnp.repeat(failed[:, s : s + 1], x.shape[1], axis=1),
            kind,
            key=jax.random.fold_in(value_key, s),
        )
        for s, x in enumerate(readings)
    ]
    return changed, failed


class FolderFit(NamedTuple):
    """Trained parameters of an `ARGateLoss`, and the loss of every epoch."""

    params: Any
    history: list[float]


def fit(
    config: FolderConfig,
    data: SensorFolder,
    protocol: Protocol,
    kind: Kinds = "uniform",
    *,
    key: Key[Array, ""],
    params: LossParams = LossParams(tau=0.5, anchor=0.3),  # noqa: B008
    on_epoch: Callable[[int, float], None] | None = None,
) -> FolderFit:
    """Train on the training rows, with failures drawn anew in every step.

    Args:
        config, data: network and rows.
        protocol, kind: which sensors fail, and how.
        key: decides everything random.
        params: alpha, beta, tau and anchor of the loss.
        on_epoch: called with (epochs done, mean loss).

    Raises:
        ValueError: the loss is not finite; a protocol of another number of sensors.
    """
    check_key(key)
    if protocol.n_channels != len(data.sensors):
        raise ValueError(
            f"protocol.n_channels={protocol.n_channels}: expected {len(data.sensors)}, the "
            "sensors; their channels fail together"
        )
    loss = network(config, data)
    rows = jax.tree.map(jnp.asarray, _arrays(data.train))
    n = len(data.train.ids)
    size = min(config.batch_size, n)
    steps = n // size
    schedule = optax.cosine_decay_schedule(config.learning_rate, config.epochs * steps)
    optimizer = optax.chain(
        optax.clip_by_global_norm(5.0), optax.adamw(schedule, weight_decay=config.weight_decay)
    )

    def batch_of(index: Array) -> Any:
        return jax.tree.map(lambda a: a[index], rows)

    def step(carry: Any, given: tuple[Array, Array]) -> tuple[Any, Array]:
        weights, state = carry
        readings, available, target = batch_of(given[0])
        noisy, _ = corrupt_sensors(protocol, readings, kind, key=given[1])

        def total(weights: Any) -> Array:
            terms = loss.apply({"params": weights}, params, noisy, target, available)
            return cast(Any, terms).total

        value, slopes = jax.value_and_grad(total)(weights)
        updates, state = optimizer.update(slopes, state, weights)
        if config.model == "equal_weights":
            updates["model"]["gate"] = jax.tree.map(jnp.zeros_like, updates["model"]["gate"])
        moved = project_argate(TargetConfig(), optax.apply_updates(weights, updates))
        return (moved, state), value

    @jax.jit
    def epoch(carry: Any, key: Array) -> tuple[Any, Array]:
        order_key, step_key = jax.random.split(key)
        order = jax.random.permutation(order_key, n)[: steps * size].reshape(steps, size)
        carry, values = jax.lax.scan(step, carry, (order, jax.random.split(step_key, steps)))
        return carry, jnp.mean(values)

    readings, available, target = batch_of(jnp.arange(1))
    weights = loss.init(key, params, list(readings), target, available)["params"]
    carry, history = (weights, optimizer.init(weights)), []
    for done in range(config.epochs):
        carry, value = epoch(carry, jax.random.fold_in(key, 1 + done))
        history.append(float(value))
        if not np.isfinite(history[-1]):
            raise ValueError(f"learning_rate={config.learning_rate}: the loss is not finite; lower")
        if on_epoch is not None:
            on_epoch(done + 1, history[-1])
    return FolderFit(carry[0], history)


def _arrays(rows: SensorRows) -> tuple[Any, ...]:
    return rows.readings, rows.available, rows.target


class FolderOutput(NamedTuple):
    """What scores are computed from; arrays over the rows, numbers in the target's own units."""

    output: np.ndarray
    target: np.ndarray
    weights: np.ndarray
    failed: np.ndarray


def run(
    config: FolderConfig,
    params: Any,
    data: SensorFolder,
    protocol: Protocol,
    kind: Kinds = "uniform",
    *,
    key: Key[Array, ""],
) -> FolderOutput:
    """The trained network on the test rows under failures.

    Returns:
        Outputs (logits, or numbers), targets, fusion weights, failed sensors.
    """
    readings = tuple(map(jnp.asarray, data.test.readings))
    noisy, failed = corrupt_sensors(protocol, readings, kind, key=key)
    model = network(config, data).model
    there = jnp.asarray(data.test.available)
    found: Any = jax.jit(model.apply)({"params": params["model"]}, noisy, there)
    output, target = np.asarray(found.output, np.float64), data.test.target
    if data.kind == "numbers":
        output, target = (a * data.spread + data.centre for a in (output, target))
    return FolderOutput(output, target, np.asarray(found.weights), np.asarray(failed & there))
