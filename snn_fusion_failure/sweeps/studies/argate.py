"""Study `argate`: train a sensor-fusion network, score it on corrupted validation rows.

Axes are the leaves of `fusion.train.HyperParams`: `learning_rate`, `weight_decay`, `loss.alpha`,
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
from fusion.presets import preset as named_preset
from fusion.train import make_train, predict_batches
from snn_fusion_failure.sweeps.study import Metric, Study

__all__ = ["make"]


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
    train = make_train(config, train_config, len(data.train_y), protocol, kind)
    train_x, train_y = jnp.asarray(data.train_x), jnp.asarray(data.train_y)
    score_x, score_y = jnp.asarray(data.test_x), jnp.asarray(data.test_y)

    def trial(params: Any, key: Any) -> dict[str, Any]:
        state, metrics = train(params, train_x, train_y, key=key)
        x, failed = failures.corrupt(protocol, score_x, kind, key=jax.random.fold_in(key, 3))
        logits, _ = predict_batches(config, export(state.params), x, failed)
        hit = (jnp.argmax(logits, -1) == score_y).astype(jnp.float32)
        broken = jnp.any(failed, axis=1)
        loss = metrics.loss.total[-1]
        # Without a finite loss the accuracy of what is left means nothing.
        valid = jnp.where(jnp.isfinite(loss), 1.0, jnp.nan)
        return {
            "accuracy": valid * 100.0 * jnp.mean(hit),
            "accuracy_clean": valid * 100.0 * jnp.mean(hit, where=~broken),
            "accuracy_corrupted": valid * 100.0 * jnp.mean(hit, where=broken),
            "loss": loss,
        }

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
        with_budget=None,
    )
