"""The bound where one sensor works: for each sensor a network of its own that never meets another.

A gate that picks the working sensor without fail, and a head that loses nothing by serving all of
them, would be as accurate as these networks are on the rows in which their sensor is left.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from fusion.data import Dataset
    from fusion.loop import Corruption


def only(dataset: Dataset, sensor: int) -> Dataset:
    """The data set with one of its sensors."""
    from fusion.data.dataset import Scale

    def pick(x: np.ndarray) -> np.ndarray:
        return x[:, sensor : sensor + 1]

    scale = dataset.scale
    return dataclasses.replace(
        dataset,
        train_x=pick(dataset.train_x),
        test_x=pick(dataset.test_x),
        channels=(dataset.channels[sensor],),
        scale=Scale(scale.low[sensor : sensor + 1], scale.high[sensor : sensor + 1]),
    )


def _predicted(dataset: Dataset, preset: str, seed: int) -> np.ndarray:
    """Classes of the test rows by a network without a gate, trained while all sensors work."""
    import jax

    from fusion.failures import no_failure
    from fusion.loop import Corruption, fit, test_output
    from fusion.presets import preset as settings_of

    settings = settings_of(dataset, "baseline", preset)
    works, key = no_failure(dataset.channels), jax.random.key(seed)
    noise = Corruption(works, works, "uniform")
    fitted = fit(*settings, dataset, noise, key=key)
    output = test_output(settings.model, fitted.state, dataset, noise, key=key)
    return np.asarray(output.logits).argmax(-1)


def dedicated(dataset: Dataset, noise: Corruption, seed: int, *, preset: str) -> dict[str, Any]:
    """Accuracy of the network that belongs to the working sensors of each test row.

    Args:
        dataset: its test rows are scored.
        noise: of the table's row: in its corrupted test rows one sensor works.
        seed: of the trainings, and of the rows' masks as in `fusion.test_output`.
        preset: of the trainings. Without failures there is nothing new to see in more epochs, and
            sixty of them are worse than the preset's fifteen on HAR.

    Raises:
        ValueError: another number of sensors is left.
    """
    import jax
    import jax.numpy as jnp

    from fusion.evaluate import split_accuracy
    from fusion.failures import corrupt

    protocol, k = noise.test, dataset.n_channels
    if not protocol.low == protocol.high == k - 1:
        raise ValueError(
            f"noise.test.low={protocol.low}, noise.test.high={protocol.high}: expected {k - 1} of "
            f"{k} sensors to fail; leave `dedicated` out of this row"
        )
    key = jax.random.fold_in(jax.random.key(seed), 3)  # that of `test_output`
    failed = np.asarray(corrupt(protocol, jnp.asarray(dataset.test_x), noise.kind, key=key)[1])
    by_sensor = np.stack([_predicted(only(dataset, sensor), preset, seed) for sensor in range(k)])
    predicted = by_sensor[(~failed).argmax(1), np.arange(len(failed))]
    clean = ~failed.any(1)
    predicted[clean] = _predicted(dataset, preset, seed)[clean]
    found = split_accuracy(dataset.test_y, predicted, failed)
    return {
        "accuracy": 100.0 * found.overall,
        "accuracy_clean": 100.0 * found.clean,
        "accuracy_corrupted": 100.0 * found.corrupted,
    }
