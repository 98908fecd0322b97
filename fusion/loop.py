"""The host loop around `fusion.train`: corruption, checkpoints, resume, and a clear stop.

The keys of epoch e come from the run's key and e alone. A resumed run therefore continues with the
same bits as one that was never interrupted, and all models of one seed see the same corruption.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from fusion.data.dataset import Dataset
from fusion.failures import FailureKind, Protocol, corrupt
from fusion.models import ModelConfig, export
from fusion.train import HyperParams, TrainConfig, TrainState, evaluate, init_state, make_epoch

__all__ = ["Corruption", "FitResult", "TestOutput", "TrainingDiverged", "fit", "test_output"]


@dataclasses.dataclass(frozen=True)
class Corruption:
    """Which channels fail in training and in test, and how.

    Attributes:
        train, test: protocols (they differ in the generalisation test only).
        kind: failure in training; test_kind: in test, the same when None.
        redraw: draw masks and noise anew in every epoch; False is the literal reading of the
            source, drawn once.
    """

    train: Protocol
    test: Protocol
    kind: FailureKind = "uniform"
    test_kind: FailureKind | None = None
    redraw: bool = True


class FitResult(NamedTuple):
    """The trained state and one row of metrics per epoch."""

    state: TrainState
    history: list[dict[str, float]]


class TestOutput(NamedTuple):
    """What scores are computed from; arrays over the test examples."""

    logits: np.ndarray
    weights: np.ndarray
    failed: np.ndarray
    labels: np.ndarray


class TrainingDiverged(RuntimeError):
    """The loss stopped being finite; the last finite state was kept in the checkpoint."""


# One compiled program per network and size serves all seeds, corruptions and hyper-parameters.
@functools.lru_cache(maxsize=32)
def _epoch(model: ModelConfig, config: TrainConfig, n: int) -> Callable[..., Any]:
    return jax.jit(make_epoch(model, config, n))


@functools.lru_cache(maxsize=32)
def _evaluate(model: ModelConfig) -> Callable[..., Any]:
    return jax.jit(lambda main, x, failed: evaluate(main, model, x, failed))


_corrupt = jax.jit(corrupt, static_argnums=(2, 3))


def _floats(metrics: Any) -> dict[str, float]:
    row = {name: float(value) for name, value in metrics.loss._asdict().items()}
    return row | {
        name: float(getattr(metrics, name))
        for name in ("accuracy", "weight_clean", "weight_failed")
    }


class _Checkpoints:
    """Orbax checkpoints of (state, history); loading orbax is left until one is wanted."""

    def __init__(self, folder: Path) -> None:
        import orbax.checkpoint as ocp

        self._ocp = ocp
        options = ocp.CheckpointManagerOptions(max_to_keep=2, enable_async_checkpointing=False)
        self._manager = ocp.CheckpointManager(folder.resolve(), options=options)

    def save(self, epoch: int, state: TrainState, history: list[dict[str, float]]) -> None:
        if epoch == 0 or epoch in self._manager.all_steps():
            return
        args = self._ocp.args
        self._manager.save(
            epoch,
            args=args.Composite(state=args.StandardSave(state), history=args.JsonSave(history)),
        )

    def restore(self, like: TrainState) -> tuple[int, TrainState, list[dict[str, float]]] | None:
        epoch = self._manager.latest_step()
        if epoch is None:
            return None
        args = self._ocp.args
        held = self._manager.restore(
            epoch,
            args=args.Composite(state=args.StandardRestore(like), history=args.JsonRestore()),
        )
        return epoch, held["state"], list(held["history"])

    def close(self) -> None:
        self._manager.close()


def fit(
    key: Array,
    dataset: Dataset,
    model: ModelConfig,
    config: TrainConfig,
    hyper: HyperParams,
    corruption: Corruption,
    *,
    checkpoint_dir: Path | None = None,
    checkpoint_every: int = 10,
    resume: bool = False,
    on_epoch: Callable[[int, dict[str, float]], None] | None = None,
) -> FitResult:
    """Train one network on the training rows of `dataset`.

    Args:
        key: decides everything random; equal keys give equal corruption for all models.
        dataset: windows in [-1, 1] and labels.
        model, config, hyper: the network and how it is trained.
        corruption: which channels fail.
        checkpoint_dir: where to keep checkpoints; none are kept without it.
        checkpoint_every: epochs between checkpoints; the last epoch and an interrupt save too.
        resume: go on from the newest checkpoint in `checkpoint_dir`.
        on_epoch: called with (epochs done, metrics) after every epoch.

    Returns:
        The state after the last epoch and the metrics of every epoch.

    Raises:
        TrainingDiverged: the loss is not finite; the last finite state has been saved.
        ValueError: model and dataset disagree in shape, or checkpoints are there and `resume` is
            not set.
    """
    _check(dataset, model)
    init_key, epoch_key, noise_key = (jax.random.fold_in(key, i) for i in range(3))
    state = init_state(init_key, model, config)
    history: list[dict[str, float]] = []
    checkpoints = None if checkpoint_dir is None else _Checkpoints(checkpoint_dir)
    start = 0
    if checkpoints is not None and (held := checkpoints.restore(state)) is not None:
        if not resume:
            raise ValueError(
                f"{checkpoint_dir} holds checkpoints of another run; resume it, or choose an empty "
                "folder"
            )
        start, state, history = held
    x, y = jnp.asarray(dataset.train_x), jnp.asarray(dataset.train_y)
    hyper = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hyper)
    step = _epoch(model, config, len(x))
    done = start
    try:
        for epoch in range(start, config.epochs):
            draw = jax.random.fold_in(noise_key, epoch if corruption.redraw else 0)
            if epoch == start or corruption.redraw:
                noisy, failed = _corrupt(draw, x, corruption.train, corruption.kind)
            new_state, metrics = step(
                state, hyper, jax.random.fold_in(epoch_key, epoch), noisy, y, failed
            )
            row = _floats(metrics)
            if not np.isfinite(row["total"]):
                raise TrainingDiverged(
                    f"the loss of epoch {epoch + 1} is {row['total']} (learning rate "
                    f"{float(hyper.learning_rate):g}); the state after epoch {epoch} was kept. "
                    "Lower the learning rate, alpha or beta"
                )
            state, done = new_state, epoch + 1
            history.append(row)
            if on_epoch is not None:
                on_epoch(done, row)
            if checkpoints is not None and done % checkpoint_every == 0:
                checkpoints.save(done, state, history)
    finally:
        # Reached on success, Ctrl-C and divergence alike: what was computed is kept.
        if checkpoints is not None:
            checkpoints.save(done, state, history[:done])
            checkpoints.close()
    return FitResult(state, history)


def test_output(
    key: Array,
    state: TrainState,
    dataset: Dataset,
    model: ModelConfig,
    corruption: Corruption,
    *,
    kind: FailureKind | None = None,
) -> TestOutput:
    """Run the exported main model on the corrupted test rows `[N, K, T]`.

    Args:
        key: the run's key; the test corruption depends on it and on nothing else, so that all
            models of a seed are compared on the same examples.
        state: trained.
        dataset, model, corruption: as in `fit`.
        kind: another failure kind than `corruption.test_kind` (for robustness scores).

    Returns:
        Logits, fusion weights, mask of failed sensors and labels, in the order of the test rows.
    """
    _check(dataset, model)
    kind = kind or corruption.test_kind or corruption.kind
    test_key = jax.random.fold_in(key, 3)
    x, failed = _corrupt(test_key, jnp.asarray(dataset.test_x), corruption.test, kind)
    logits, weights = _evaluate(model)(export(state.params), x, failed)
    return TestOutput(np.asarray(logits), np.asarray(weights), np.asarray(failed), dataset.test_y)


test_output.__test__ = False  # type: ignore[attr-defined]  # not a pytest function
TestOutput.__test__ = False  # type: ignore[attr-defined]


def _check(dataset: Dataset, model: ModelConfig) -> None:
    shape = (dataset.n_channels, dataset.n_time, dataset.n_classes)
    wanted = (model.n_sensors, model.n_times, model.n_classes)
    if shape != wanted:
        raise ValueError(
            f"the data set {dataset.name!r} has (sensors, samples, classes) = {shape}, the model "
            f"is for {wanted}; build the ModelConfig from the data set"
        )
