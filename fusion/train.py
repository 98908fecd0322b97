"""Training: one epoch is one `lax.scan`; seeds and hyper-parameters are arguments, so they vmap.

`init_state` and `make_epoch` are pure; jit and vmap are the caller's. `fusion.fit` is the host loop
around them: corruption, checkpoints, resume, and a clear stop on a loss that is not finite.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key

from fusion._checks import check_key
from fusion.bayesian_gate import gate_divergence
from fusion.bilevel import held_out_gradient
from fusion.config import HyperParams, ModelConfig, TrainConfig
from fusion.failure_kinds import Kinds, check_kinds
from fusion.failures import Protocol, corrupt
from fusion.losses import LossTerms, argate_loss, cross_entropy, mask_penalty
from fusion.models import MainOutput, Params, auxiliary_logits, export, init, predict
from fusion.neighbours import recall, remember
from fusion.spiking.reward_stdp import reward_gradient
from fusion.targets import apply_targets, project_targets


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


def init_state(
    key: Key[Array, ""],
    model: ModelConfig,
    config: TrainConfig,
    clean: tuple[Float[Array, "n k t"], Int[Array, " n"]] | None = None,
) -> TrainState:
    """Fresh parameters and optimizer state.

    Args:
        key: of the parameters.
        model, config: static.
        clean: training rows and classes, which a neighbourhood head remembers.

    Raises:
        ValueError: a neighbourhood head without rows.
    """
    params = init(key, model)
    state = TrainState(params, _optimizer(config).init(params), jnp.zeros((), jnp.int32))
    if model.head != "neighbourhood":
        return state
    if clean is None:
        raise ValueError(
            "clean=None: expected the training rows that head='neighbourhood' remembers; give them"
        )
    # Shuffled, so that a block of it is a random part of it; `number` is the row's place.
    order = jax.random.permutation(jax.random.fold_in(key, 3), len(clean[1]))
    held = remember(model.encoder.levels, *clean)
    memory = {"rows": held.rows[order], "labels": held.labels[order], "number": order}
    return state._replace(params=params | {"memory": memory})


def _without_memory(params: Params) -> Params:
    """What is trained."""
    return {part: tree for part, tree in params.items() if part != "memory"}


def batch_loss(
    model: ModelConfig,
    hyper: HyperParams,
    params: Params,
    x: Float[Array, "b k t"],
    y: Int[Array, " b"],
    failed: Bool[Array, "b k"],
    *,
    excluded: Bool[Array, "b m"] | None = None,
    n_examples: int | None = None,
    key: Key[Array, ""] | None = None,
) -> tuple[Float[Array, ""], tuple[LossTerms, MainOutput]]:
    """The training loss of one batch, with its terms and the main model's output.

    `failed` is a part of the batch, as in `fusion.failures.corrupt`: the oracle's gate and mask
    supervision read it, the metrics of a step do for all models. Differentiable in `params` and in
    `hyper.loss`; see `fusion.losses.argate_loss`. A variational gate adds its divergence from the
    prior over `n_examples`, the training rows; over the rows of the batch when None.
    """
    told = failed if model.reads_failed else None
    out = predict(model, export(params), x, told, excluded=excluded, key=key)
    aux_losses = targets = aux_logits = None
    config = model.recipe.loss
    if config.auxiliary:
        aux_logits = auxiliary_logits(model, params, x, out.features)
        labels = jnp.broadcast_to(y[:, None], aux_logits.shape[:2])
        aux_losses = cross_entropy(aux_logits, labels)
        if config.learned_targets:
            seen = jax.lax.stop_gradient(aux_losses) if config.stop_targets else aux_losses
            targets = apply_targets(model.targets, params["targets"], seen)
    given = aux_losses, targets, aux_logits
    loss = argate_loss(config, hyper.loss, out.logits, y, out.weights, *given)
    if config.mask_supervision:
        penalty = jnp.mean(mask_penalty(out.weights, failed))
        loss = loss._replace(total=loss.total + hyper.loss.mask * penalty)
    if model.variational:
        apart = gate_divergence(params["main"]["gate"], model.gate_prior) / (n_examples or len(y))
        loss = loss._replace(total=loss.total + hyper.loss.divergence * apart)
    if model.encoder.learns_by_reward and aux_losses is not None:
        rewarded = reward_gradient(model.encoder, params["main"]["encoder"], x, aux_losses)
        loss = loss._replace(total=loss.total + rewarded)
    return loss.total, (loss, out)


def train_step(
    model: ModelConfig,
    config: TrainConfig,
    hyper: HyperParams,
    state: TrainState,
    rate: Float[Array, ""],
    x: Float[Array, "b k t"],
    y: Int[Array, " b"],
    failed: Bool[Array, "b k"],
    *,
    rows: Int[Array, " b"] | None = None,
    n_examples: int | None = None,
    key: Key[Array, ""],
) -> tuple[TrainState, EpochMetrics]:
    r"""One step of Adam with decoupled weight decay, then the projection of the lattice.

    .. math:: \theta \leftarrow \Pi\left(\theta - \eta\,(\text{Adam}(g) + \lambda\,\theta)\right)

    Args:
        model, config: static.
        hyper: learning rate, weight decay :math:`\lambda` and loss weights.
        state: parameters, optimizer state and step number.
        rate: the learning rate :math:`\eta` of this step.
        x, y, failed: the batch.
        rows: their numbers among the training rows, so that a neighbourhood head leaves each
            example out of its own neighbours.
        n_examples: all training rows, see `batch_loss`.
        key: of dropout, jitter and the rows that are compared with.

    Returns:
        The new state and the batch's metrics. Weight decay is not applied to the lattice, whose
        values are targets rather than weights.
    """
    if config.jitter > 0.0:
        gain = jax.random.normal(jax.random.fold_in(key, 100), x.shape[:2])
        x = x * (1.0 + config.jitter * gain)[:, :, None]

    seen: dict[str, Any] = {}
    trained, excluded = _without_memory(state.params), None
    if "memory" in state.params:
        seen, number = recall(
            model.memory_rows, state.params["memory"], key=jax.random.fold_in(key, 101)
        )
        mine = jnp.full(x.shape[:1], -1) if rows is None else rows
        excluded = mine[:, None] == number[None, :]

    def loss(params: Params) -> tuple[Float[Array, ""], tuple[LossTerms, MainOutput]]:
        of: dict[str, Any] = {"excluded": excluded, "n_examples": n_examples, "key": key}
        return batch_loss(model, hyper, params | seen, x, y, failed, **of)

    (_, (terms, out)), grads = jax.value_and_grad(loss, has_aux=True)(trained)
    if model.recipe.loss.target_training == "held_out":

        def terms_of(params: Params, batch: tuple[Array, ...]) -> LossTerms:
            hidden = None if excluded is None else batch[3]
            of: dict[str, Any] = {"excluded": hidden, "n_examples": n_examples}
            return batch_loss(model, hyper, params | seen, *batch[:3], **of)[1][0]

        seen_by = jnp.zeros((len(y), 1), bool) if excluded is None else excluded
        grads["targets"] = held_out_gradient(
            trained,
            (x, y, failed, seen_by),
            rate,
            penalized=lambda p, batch: terms_of(p, batch).total,
            main=lambda p, batch: terms_of(p, batch).main,
        )
    updates, opt_state = _optimizer(config).update(grads, state.opt_state, trained)
    params: Params = {}
    for part, tree in trained.items():
        decay = 0.0 if part == "targets" else hyper.weight_decay
        params[part] = jax.tree.map(
            lambda p, u, d=decay: p - rate * (u + d * p), tree, updates[part]
        )
    if "targets" in params:
        params["targets"] = project_targets(model.targets, params["targets"])
    if "memory" in state.params:
        params["memory"] = state.params["memory"]
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
    """Build `epoch(hyper, state, x, y, failed, *, key) -> (state, metrics)`, a pure function.

    One epoch is one scan over shuffled batches. Jit it once; it then serves every seed, every
    corruption and every value of `hyper`. To train S seeds together, vmap it over `state`, `key`
    and whatever else differs.

    Returns:
        The function; metrics are means over the steps.

    Raises:
        ValueError: fewer examples than one batch.
    """
    n_batches = n_examples // config.batch_size
    if n_batches == 0:
        raise ValueError(
            f"batch_size={config.batch_size}: expected at most {n_examples}, the number of "
            "training examples; lower it"
        )
    total_steps = config.epochs * n_batches

    def epoch(
        hyper: HyperParams,
        state: TrainState,
        x: Float[Array, "n k t"],
        y: Int[Array, " n"],
        failed: Bool[Array, "n k"],
        *,
        key: Key[Array, ""],
    ) -> tuple[TrainState, EpochMetrics]:
        check_key(key)
        order_key, step_key = jax.random.split(key)
        order = jax.random.permutation(order_key, n_examples)
        order = order[: n_batches * config.batch_size].reshape(n_batches, config.batch_size)

        def step(state: TrainState, inputs: tuple[Array, Array]) -> tuple[TrainState, EpochMetrics]:
            index, key = inputs
            rate = jnp.asarray(hyper.learning_rate, jnp.float32)
            if config.schedule == "cosine":
                phase = jnp.minimum(1.0, state.step.astype(jnp.float32) / total_steps)
                rate = rate * 0.5 * (1.0 + jnp.cos(jnp.pi * phase))
            batch = x[index], y[index], failed[index]
            of: dict[str, Any] = {"rows": index, "n_examples": n_examples, "key": key}
            return train_step(model, config, hyper, state, rate, *batch, **of)

        state, metrics = jax.lax.scan(step, state, (order, jax.random.split(step_key, n_batches)))
        return state, jax.tree.map(jnp.mean, metrics)

    return epoch


def make_train(
    model: ModelConfig,
    config: TrainConfig,
    n_examples: int,
    protocol: Protocol,
    kind: Kinds = "uniform",
    *,
    redraw: bool = True,
) -> Callable[..., tuple[TrainState, EpochMetrics]]:
    """Build `train(hyper, x, y, *, key) -> (state, metrics)`, the whole run as one pure function.

    For sweeps: `jax.vmap(lambda key: train(hyper, x, y, key=key))` trains a batch of seeds and
    `jax.vmap(lambda hyper: train(hyper, x, y, key=key))` a batch of hyper-parameters in one
    program. It draws the keys of `fusion.fit`: one run of either gives the same network.

    Returns:
        A function whose metrics have a leading axis of epochs.

    Raises:
        ValueError: an unknown kind, a protocol for another number of sensors, too few examples.

    Example:
        >>> clean = Protocol(n_channels=3, low=0, high=0)
        >>> train = make_train(ModelConfig("baseline", n_sensors=3), TrainConfig(), 640, clean)
    """
    check_kinds("kind", kind)
    if protocol.n_channels != model.n_sensors:
        raise ValueError(
            f"protocol.n_channels={protocol.n_channels}: expected {model.n_sensors}, the sensors "
            "of the model; build both from the channels of one data set"
        )
    epoch = make_epoch(model, config, n_examples)

    def train(
        hyper: HyperParams, x: Float[Array, "n k t"], y: Int[Array, " n"], *, key: Key[Array, ""]
    ) -> tuple[TrainState, EpochMetrics]:
        check_key(key)
        init_key, epoch_key, noise_key = (jax.random.fold_in(key, i) for i in range(3))

        def body(state: TrainState, index: Array) -> tuple[TrainState, EpochMetrics]:
            draw = jax.random.fold_in(noise_key, index if redraw else 0)
            noisy, failed = corrupt(protocol, x, kind, key=draw)
            step_key = jax.random.fold_in(epoch_key, index)
            return epoch(hyper, state, noisy, y, failed, key=step_key)

        start = init_state(init_key, model, config, (x, y))
        return jax.lax.scan(body, start, jnp.arange(config.epochs))

    return train
