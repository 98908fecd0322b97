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
from jaxtyping import Array, Key

from fusion._checkpoints import Checkpoints, settings_of
from fusion._checks import check_choice, check_count, check_key, check_number, check_type
from fusion.config import HyperParams, ModelConfig, TrainConfig
from fusion.data.dataset import Dataset
from fusion.failure_kinds import Kinds, check_kinds
from fusion.failures import Protocol, corrupt
from fusion.models import export
from fusion.prediction import predict_batches
from fusion.train import TrainState, init_state, make_epoch


@dataclasses.dataclass(frozen=True)
class Corruption:
    """Which channels fail in training and in test, and how.

    Attributes:
        train, test: protocols (they differ in the generalisation test only).
        kind: failure in training, or several of which each example draws one; test_kind: in test,
            the same when None.
        redraw: draw masks and noise anew in every epoch; False is the literal reading of the
            source, drawn once.

    Raises:
        ValueError: an unknown kind, or protocols for different numbers of channels.
        TypeError: what is no protocol.
    """

    train: Protocol
    test: Protocol
    kind: Kinds = "uniform"
    test_kind: Kinds | None = None
    redraw: bool = True

    def __post_init__(self) -> None:
        """Refuse what is no protocol and no kind of failure."""
        for name in ("train", "test"):
            check_type(name, getattr(self, name), Protocol, "make it with fusion.random_failing")
        if self.train.n_channels != self.test.n_channels:
            raise ValueError(
                f"test.n_channels={self.test.n_channels}: expected {self.train.n_channels} as in "
                "training; build both protocols from the channels of one data set"
            )
        check_kinds("kind", self.kind)
        if self.test_kind is not None:
            check_kinds("test_kind", self.test_kind)
        check_choice("redraw", self.redraw, (True, False))


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
    return jax.jit(
        lambda main, x, failed: predict_batches(
            model, main, x, failed if model.reads_failed else None
        )
    )


_corrupt = jax.jit(corrupt, static_argnums=(0, 2))


def _floats(metrics: Any) -> dict[str, float]:
    row = {name: float(value) for name, value in metrics.loss._asdict().items()}
    return row | {
        name: float(getattr(metrics, name))
        for name in ("accuracy", "weight_clean", "weight_failed")
    }


def fit(
    model: ModelConfig,
    train: TrainConfig,
    hyper: HyperParams,
    data: Dataset,
    noise: Corruption,
    *,
    key: Key[Array, ""],
    checkpoint_dir: Path | None = None,
    checkpoint_every: int = 10,
    checkpoint_minutes: float = 2.0,
    resume: bool = False,
    on_epoch: Callable[[int, dict[str, float]], None] | None = None,
) -> FitResult:
    """Train one network on the training rows of `data`.

    Args:
        model, train, hyper: the network and how it is trained.
        data: windows in [-1, 1] and labels.
        noise: which channels fail.
        key: decides everything random; equal keys give equal corruption for all models.
        checkpoint_dir: where to keep checkpoints; none are kept without it.
        checkpoint_every: epochs between checkpoints; the last epoch and an interrupt save too.
        checkpoint_minutes: time after which an epoch saves whatever its number.
        resume: go on from the newest checkpoint in `checkpoint_dir`, with the same settings.
        on_epoch: called with (epochs done, metrics) after every epoch.

    Returns:
        The state after the last epoch and the metrics of every epoch.

    Raises:
        TrainingDiverged: the loss is not finite; the last finite state has been saved.
        ValueError: model and data set disagree in shape; checkpoints are there and `resume` is
            not set; `resume` is set without a folder, or the checkpoints have other settings,
            data or key.
        TypeError: an argument that is not of its type.
    """
    _check(model, data, noise)
    check_type("train", train, TrainConfig, "make it with fusion.TrainConfig")
    check_type("hyper", hyper, HyperParams, "make it with fusion.HyperParams")
    check_key(key)
    if resume and checkpoint_dir is None:
        raise ValueError("resume=True: expected checkpoint_dir with it; give the run's folder")
    check_count("checkpoint_every", checkpoint_every)
    check_number("checkpoint_minutes", checkpoint_minutes, 0.0, fix="0 saves every epoch")
    init_key, epoch_key, noise_key = (jax.random.fold_in(key, i) for i in range(3))
    x, y = jnp.asarray(data.train_x), jnp.asarray(data.train_y)
    state = init_state(init_key, model, train, (x, y))
    history: list[dict[str, float]] = []
    start, checkpoints = 0, None
    if checkpoint_dir is not None:
        settings = settings_of(
            model=model,
            train=train,
            hyper=hyper,
            noise=noise,
            key=np.asarray(jax.random.key_data(key)),
            train_x=data.train_x,
            train_y=data.train_y,
        )
        checkpoints = Checkpoints(Path(checkpoint_dir), settings, checkpoint_minutes)
        if (held := checkpoints.restore(state, resume=resume)) is not None:
            start, state, history = held
    hyper = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hyper)
    step = _epoch(model, train, len(x))
    done = start
    try:
        for epoch in range(start, train.epochs):
            draw = jax.random.fold_in(noise_key, epoch if noise.redraw else 0)
            if epoch == start or noise.redraw:
                noisy, failed = _corrupt(noise.train, x, noise.kind, key=draw)
            step_key = jax.random.fold_in(epoch_key, epoch)
            new_state, metrics = step(hyper, state, noisy, y, failed, key=step_key)
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
            due = checkpoints is not None and checkpoints.is_due()
            if checkpoints is not None and (done % checkpoint_every == 0 or due):
                checkpoints.save(done, state, history)
    finally:
        # Reached on success, Ctrl-C and divergence alike: what was computed is kept.
        if checkpoints is not None:
            checkpoints.save(done, state, history[:done])
            checkpoints.close()
    return FitResult(state, history)


def test_output(
    model: ModelConfig,
    state: TrainState,
    data: Dataset,
    noise: Corruption,
    *,
    key: Key[Array, ""],
    kind: Kinds | None = None,
) -> TestOutput:
    """Run the exported main model on the corrupted test rows `[N, K, T]`.

    Args:
        model: as in `fit`.
        state: trained.
        data, noise: as in `fit`.
        key: the run's key; the test corruption depends on it and on nothing else, so that all
            models of a seed are compared on the same examples.
        kind: another failure kind than `noise.test_kind` (for robustness scores).

    Returns:
        Logits, fusion weights, mask of failed sensors and labels, in the order of the test rows.

    Raises:
        ValueError: an unknown kind, or the network and the data set disagree in shape.
        TypeError: an argument that is not of its type, such as a `FitResult` for its state.
    """
    _check(model, data, noise)
    check_type("state", state, TrainState, "give fit(...).state")
    check_key(key)
    if kind is not None:
        check_kinds("kind", kind)
    kind = kind or noise.test_kind or noise.kind
    test_key = jax.random.fold_in(key, 3)
    x, failed = _corrupt(noise.test, jnp.asarray(data.test_x), kind, key=test_key)
    logits, weights = _evaluate(model)(export(state.params), x, failed)
    return TestOutput(np.asarray(logits), np.asarray(weights), np.asarray(failed), data.test_y)


test_output.__test__ = False  # type: ignore[attr-defined]  # not a pytest function
TestOutput.__test__ = False  # type: ignore[attr-defined]


def _check(model: ModelConfig, data: Dataset, noise: Corruption) -> None:
    check_type("model", model, ModelConfig, "make it with fusion.ModelConfig or fusion.preset")
    check_type("data", data, Dataset, "make it with fusion.load or fusion.from_arrays")
    check_type("noise", noise, Corruption, "make it with fusion.Corruption")
    for name, given, found in (
        ("n_sensors", model.n_sensors, data.n_channels),
        ("n_times", model.n_times, data.n_time),
        ("n_classes", model.n_classes, data.n_classes),
    ):
        if given != found:
            raise ValueError(
                f"model.{name}={given}: expected {found} for the data set {data.name!r}; build "
                "the ModelConfig from the data set"
            )
    if noise.train.n_channels != data.n_channels:
        raise ValueError(
            f"noise.train.n_channels={noise.train.n_channels}: expected {data.n_channels} for the "
            f"data set {data.name!r}; build the protocols from its channels"
        )
