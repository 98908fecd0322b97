"""Study `argate`: train a sensor-fusion network, score it on corrupted validation rows.

Axes are the leaves of `fusion.config.HyperParams`: `learning_rate`, `weight_decay`, `loss.alpha`,
`loss.beta`, `loss.tau`, `loss.anchor`. Held-out training rows are scored, never the test rows: a
sweep chooses, and what is chosen on test rows cannot be reported on them.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from fusion import failures
from fusion.data import load, validation_split
from fusion.models import export
from fusion.prediction import predict_batches
from fusion.presets import preset as named_preset
from fusion.train import init_state, make_epoch, make_train
from snn_fusion_failure.sweeps.study import Carry, Metric, Study


def make(
    dataset: str = "simulated",
    model: str = "argate_l",
    preset: str = "quick",
    n_clean: int = 1,
    kind: str = "uniform",
    epochs: int = 0,
    split_seed: int = 0,
) -> Study:
    """A model on a data set (`$FUSION_DATA_DIR` for har and driver); `epochs=0`: the preset's."""
    data = validation_split(load(dataset), seed=split_seed)
    config, train_config, hyper = named_preset(data, model, preset)
    if epochs:
        train_config = dataclasses.replace(train_config, epochs=epochs)
    protocol = failures.random_failing(data.channels, n_clean)
    make_train(config, train_config, len(data.train_y), protocol, kind)  # refuses what cannot run
    epoch = make_epoch(config, train_config, len(data.train_y))
    train_x, train_y = jnp.asarray(data.train_x), jnp.asarray(data.train_y)
    score_x, score_y = jnp.asarray(data.test_x), jnp.asarray(data.test_y)

    def start(params: Any, key: Any) -> Any:
        return init_state(jax.random.fold_in(key, 0), config, train_config)

    def advance(params: Any, key: Any, state: Any, begin: int, end: int) -> Any:
        """Epochs `begin` to `end - 1` of `fusion.train.make_train`, then the score."""

        def body(state: Any, index: Any) -> Any:
            draw = jax.random.fold_in(jax.random.fold_in(key, 2), index)
            noisy, failed = failures.corrupt(protocol, train_x, kind, key=draw)
            step_key = jax.random.fold_in(jax.random.fold_in(key, 1), index)
            return epoch(params, state, noisy, train_y, failed, key=step_key)

        state, metrics = jax.lax.scan(body, state, jnp.arange(begin, end))
        x, failed = failures.corrupt(protocol, score_x, kind, key=jax.random.fold_in(key, 3))
        told = failed if config.reads_failed else None
        logits, _ = predict_batches(config, export(state.params), x, told)
        hit = (jnp.argmax(logits, -1) == score_y).astype(jnp.float32)
        broken = jnp.any(failed, axis=1)
        loss = metrics.loss.total[-1]
        # Without a finite loss the accuracy of what is left means nothing.
        valid = jnp.where(jnp.isfinite(loss), 1.0, jnp.nan)
        return state, {
            "accuracy": valid * 100.0 * jnp.mean(hit),
            "accuracy_clean": valid * 100.0 * jnp.mean(hit, where=~broken),
            "accuracy_corrupted": valid * 100.0 * jnp.mean(hit, where=broken),
            "loss": loss,
        }

    total = train_config.epochs

    def trial(params: Any, key: Any) -> Any:
        return advance(params, key, start(params, key), 0, total)[1]

    def advance_all(params: Any, keys: Any, carry: Any, begin: int, end: int) -> Any:
        return jax.vmap(lambda p, k, c: advance(p, k, c, begin, end))(params, keys, carry)

    def check(params: Any) -> None:
        for name, values in (
            ("learning_rate", params.learning_rate), ("loss.tau", params.loss.tau),
        ):  # fmt: skip
            if (values <= 0.0).any():
                raise ValueError(f"{name} = {values.min():g}: expected a positive number")

    return Study(
        name="argate",
        options={},
        params=hyper,
        run=jax.vmap(trial),
        metrics={
            "accuracy": Metric("%", "accuracy on the corrupted validation rows", "max"),
            "accuracy_clean": Metric("%", "the same, rows without a failed channel", "max", True),
            "accuracy_corrupted": Metric("%", "the same, rows with failed channels", "max", True),
            "loss": Metric("", "training loss of the last epoch", "min"),
        },
        objective="accuracy",
        check=check,
        budget_text="epochs",
        carry=Carry(jax.vmap(start), advance_all, total),
    )
