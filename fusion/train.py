"""Training: one epoch is one `lax.scan`; seeds and hyper-parameters are arguments, so they vmap.

`init_state` and `make_epoch` are pure; jit and vmap are the caller's. `fit` is the host loop around
them: corruption, checkpoints, resume, and a clear stop on a loss that is not finite.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from fusion.failures import FailureKind, Protocol, corrupt
from fusion.losses import LossParams, LossTerms, argate_loss, cross_entropy
from fusion.models import (
    MainOutput,
    ModelConfig,
    Params,
    auxiliary_logits,
    init,
    loss_config,
    predict,
)
from fusion.targets import apply_targets, project_targets

__all__ = [
    "EpochMetrics",
    "HyperParams",
    "TrainConfig",
    "TrainState",
    "batch_loss",
    "evaluate",
    "init_state",
    "make_epoch",
    "make_train",
    "train_step",
]


class HyperParams(NamedTuple):
    """What a sweep may vary; scalars, so `jax.vmap` runs over them without recompiling."""

    learning_rate: float | Array = 2e-3
    weight_decay: float | Array = 1e-3
    loss: LossParams = LossParams()


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """What recompiles: sizes and choices of the training run.

    Attributes:
        epochs: passes over the training set; also the length of the cosine schedule.
        batch_size: examples per step; the rest of an epoch that fills no batch is left out.
        schedule: of the learning rate, `"cosine"` to zero or `"constant"`.
        clip_norm: bound of the gradient's global norm.
        jitter: standard deviation of a random gain per channel and example, in training.
        stop_targets, stop_weights, uniform_floor, label_smoothing: see `fusion.losses.LossConfig`.
    """

    epochs: int = 20
    batch_size: int = 64
    schedule: Literal["cosine", "constant"] = "cosine"
    clip_norm: float = 5.0
    jitter: float = 0.0
    stop_targets: bool = True
    stop_weights: bool = False
    uniform_floor: float = 0.0
    label_smoothing: float = 0.05

    def __post_init__(self) -> None:
        """Refuse sizes that make no run."""
        for name in ("epochs", "batch_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: expected at least 1")
        if self.schedule not in ("cosine", "constant"):
            raise ValueError(f"schedule={self.schedule!r}: expected 'cosine' or 'constant'")

    def loss_options(self) -> dict[str, Any]:
        """The fields that belong to `LossConfig`."""
        names = ("stop_targets", "stop_weights", "uniform_floor", "label_smoothing")
        return {name: getattr(self, name) for name in names}


class TrainState(NamedTuple):
    """What a step changes."""

    params: Params
    opt_state: optax.OptState
    step: Int[Array, ""]


class EpochMetrics(NamedTuple):
    """Means over the steps of an epoch."""

    loss: LossTerms
    accuracy: Float[Array, ""]
    weight_clean: Float[Array, ""]
    weight_failed: Float[Array, ""]


def _optimizer(config: TrainConfig) -> optax.GradientTransformation:
    return optax.chain(optax.clip_by_global_norm(config.clip_norm), optax.scale_by_adam())


def init_state(key: Array, model: ModelConfig, config: TrainConfig) -> TrainState:
    """Fresh parameters and optimizer state."""
    params = init(key, model)
    return TrainState(params, _optimizer(config).init(params), jnp.zeros((), jnp.int32))


def batch_loss(
    params: Params,
    model: ModelConfig,
    config: TrainConfig,
    hyper: HyperParams,
    key: Array | None,
    x: Float[Array, "b k t"],
    y: Int[Array, " b"],
    failed: Bool[Array, "b k"],
) -> tuple[Float[Array, ""], tuple[LossTerms, MainOutput]]:
    """The training loss of one batch, with its terms and the main model's output.

    Differentiable in `params` and in `hyper.loss`; see `fusion.losses.argate_loss`.
    """
    out = predict(params["main"], model, x, failed, key=key)
    aux_losses = targets = None
    terms = loss_config(model, **config.loss_options())
    if terms.auxiliary:
        aux_logits = auxiliary_logits(params, model, x, out.features)
        labels = jnp.broadcast_to(y[:, None], aux_logits.shape[:2])
        aux_losses = cross_entropy(aux_logits, labels)
        if terms.learned_targets:
            seen = jax.lax.stop_gradient(aux_losses) if terms.stop_targets else aux_losses
            targets = apply_targets(model.targets, params["targets"], seen)
    loss = argate_loss(terms, hyper.loss, out.logits, y, out.weights, aux_losses, targets)
    return loss.total, (loss, out)


def train_step(
    state: TrainState,
    model: ModelConfig,
    config: TrainConfig,
    hyper: HyperParams,
    rate: Float[Array, ""],
    key: Array,
    x: Float[Array, "b k t"],
    y: Int[Array, " b"],
    failed: Bool[Array, "b k"],
) -> tuple[TrainState, EpochMetrics]:
    r"""One step of Adam with decoupled weight decay, then the projection of the lattice.

    .. math:: \theta \leftarrow \Pi\left(\theta - \eta\,(\text{Adam}(g) + \lambda\,\theta)\right)

    Args:
        state: parameters, optimizer state and step number.
        model, config: static.
        hyper: learning rate, weight decay :math:`\lambda` and loss weights.
        rate: the learning rate :math:`\eta` of this step.
        key: of dropout and jitter.
        x, y, failed: the batch.

    Returns:
        The new state and the batch's metrics. Weight decay is not applied to the lattice, whose
        values are targets rather than weights.
    """
    if config.jitter > 0.0:
        gain = jax.random.normal(jax.random.fold_in(key, 100), x.shape[:2])
        x = x * (1.0 + config.jitter * gain)[:, :, None]
    gradient = jax.value_and_grad(batch_loss, has_aux=True)
    (_, (terms, out)), grads = gradient(state.params, model, config, hyper, key, x, y, failed)
    updates, opt_state = _optimizer(config).update(grads, state.opt_state, state.params)
    params: Params = {}
    for part, tree in state.params.items():
        decay = 0.0 if part == "targets" else hyper.weight_decay
        params[part] = jax.tree.map(
            lambda p, u, d=decay: p - rate * (u + d * p), tree, updates[part]
        )
    if "targets" in params:
        params["targets"] = project_targets(model.targets, params["targets"])
    n_failed = jnp.sum(failed)
    metrics = EpochMetrics(
        loss=terms,
        accuracy=jnp.mean((jnp.argmax(out.logits, -1) == y).astype(jnp.float32)),
        weight_clean=jnp.sum(jnp.where(failed, 0.0, out.weights))
        / jnp.maximum(1, failed.size - n_failed),
        weight_failed=jnp.sum(jnp.where(failed, out.weights, 0.0)) / jnp.maximum(1, n_failed),
    )
    return TrainState(params, opt_state, state.step + 1), metrics


def make_epoch(
    model: ModelConfig, config: TrainConfig, n_examples: int
) -> Callable[..., tuple[TrainState, EpochMetrics]]:
    """Build `epoch(state, hyper, key, x, y, failed) -> (state, metrics)`, a pure function.

    One epoch is one scan over shuffled batches. Jit it once; it then serves every seed, every
    corruption and every value of `hyper`. To train S seeds together, vmap it over `state`, `key`
    and whatever else differs.

    Raises:
        ValueError: fewer examples than one batch.
    """
    n_batches = n_examples // config.batch_size
    if n_batches == 0:
        raise ValueError(
            f"{n_examples} training examples fill no batch of {config.batch_size}; "
            "choose a smaller batch_size"
        )
    total_steps = config.epochs * n_batches

    def epoch(
        state: TrainState,
        hyper: HyperParams,
        key: Array,
        x: Float[Array, "n k t"],
        y: Int[Array, " n"],
        failed: Bool[Array, "n k"],
    ) -> tuple[TrainState, EpochMetrics]:
        order_key, step_key = jax.random.split(key)
        order = jax.random.permutation(order_key, n_examples)
        order = order[: n_batches * config.batch_size].reshape(n_batches, config.batch_size)

        def step(state: TrainState, inputs: tuple[Array, Array]) -> tuple[TrainState, EpochMetrics]:
            index, key = inputs
            rate = jnp.asarray(hyper.learning_rate, jnp.float32)
            if config.schedule == "cosine":
                phase = jnp.minimum(1.0, state.step.astype(jnp.float32) / total_steps)
                rate = rate * 0.5 * (1.0 + jnp.cos(jnp.pi * phase))
            return train_step(
                state, model, config, hyper, rate, key, x[index], y[index], failed[index]
            )

        state, metrics = jax.lax.scan(step, state, (order, jax.random.split(step_key, n_batches)))
        return state, jax.tree.map(jnp.mean, metrics)

    return epoch


def evaluate(
    main: Params,
    model: ModelConfig,
    x: Float[Array, "n k t"],
    failed: Bool[Array, "n k"] | None = None,
    *,
    batch_size: int = 256,
) -> tuple[Float[Array, "n c"], Float[Array, "n k"]]:
    """Logits and fusion weights of many examples, by the exported main model, in chunks.

    Args:
        main: `fusion.models.export(params)`; no auxiliary parameter is read.
        model: static.
        x: windows.
        failed: mask of failed sensors, read by the oracle gate only.
        batch_size: examples per chunk; bounds the memory.

    Returns:
        (logits `[n, class]`, fusion weights `[n, sensor]`).
    """
    n = x.shape[0]
    mask = jnp.zeros(x.shape[:2], bool) if failed is None else failed
    batch_size = min(batch_size, n)
    n_chunks = -(-n // batch_size)
    padding = n_chunks * batch_size - n

    def chunked(a: Array) -> Array:
        padded = jnp.concatenate([a, jnp.zeros((padding, *a.shape[1:]), a.dtype)])
        return padded.reshape(n_chunks, batch_size, *a.shape[1:])

    def chunk(inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        out = predict(main, model, inputs[0], inputs[1])
        return out.logits, out.weights

    logits, weights = jax.lax.map(chunk, (chunked(x), chunked(mask)))
    return logits.reshape(-1, model.n_classes)[:n], weights.reshape(-1, model.n_sensors)[:n]


def make_train(
    model: ModelConfig,
    config: TrainConfig,
    n_examples: int,
    protocol: Protocol,
    kind: FailureKind,
    *,
    redraw: bool = True,
) -> Callable[..., tuple[TrainState, EpochMetrics]]:
    """Build `train(key, hyper, x, y) -> (state, metrics)`, the whole run as one pure function.

    For sweeps: `jax.vmap(train, (0, None, None, None))` trains a batch of seeds and
    `jax.vmap(train, (None, 0, None, None))` a batch of hyper-parameters in one program. It draws
    the same keys as `fusion.fit.fit`, so that one run of either gives the same network.

    Returns:
        A function whose metrics have a leading axis of epochs.
    """
    epoch = make_epoch(model, config, n_examples)

    def train(
        key: Array, hyper: HyperParams, x: Float[Array, "n k t"], y: Int[Array, " n"]
    ) -> tuple[TrainState, EpochMetrics]:
        init_key, epoch_key, noise_key = (jax.random.fold_in(key, i) for i in range(3))

        def body(state: TrainState, index: Array) -> tuple[TrainState, EpochMetrics]:
            draw = jax.random.fold_in(noise_key, index if redraw else 0)
            noisy, failed = corrupt(draw, x, protocol, kind)
            return epoch(state, hyper, jax.random.fold_in(epoch_key, index), noisy, y, failed)

        return jax.lax.scan(body, init_state(init_key, model, config), jnp.arange(config.epochs))

    return train
