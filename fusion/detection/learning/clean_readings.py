"""What clean readings look like, told to the gate before training begins."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from fusion.detection.config import DetectorConfig
from fusion.detection.learning.examples import Example
from fusion.detection.learning.training import (
    DetectorState,
    DetectorTrainConfig,
    training_inputs,
)
from fusion.detection.sensors.deviation import fit_clean
from fusion.detection.sensors.quality import quality_statistics

MOST_FRAMES = 256
_DRAWS = 8  # of each frame, of few


def with_clean_readings(
    config: DetectorConfig,
    train: DetectorTrainConfig,
    state: DetectorState,
    n_frames: int,
    read: Callable[[int], Example],
    *,
    key: PRNGKeyArray,
) -> DetectorState:
    """A state whose gate knows mean and covariance of the statistics of clean training frames.

    Args:
        config, train: static; frames flip, turn and shift in colour as in training, none fails.
        state: as from `init_training`; returned as it is where the network reads no statistics.
        n_frames, read: number of training frames and the example of frame i; at most `MOST_FRAMES`
            are read, at even distances.
        key: of flips, turns and colours.
    """
    if "clean" not in state.params["main"]:
        return state
    working = dataclasses.replace(train, failure_share=0.0)

    @jax.jit
    def statistics(example: Example, key: PRNGKeyArray) -> tuple[jax.Array, jax.Array]:
        inputs, _ = training_inputs(config, working, example, key=key)
        return quality_statistics(config.bev, inputs.image[None], inputs.bev[None])

    draws = min(MOST_FRAMES, _DRAWS * n_frames)
    frames = np.arange(draws) * n_frames // draws  # at even distances; of few each several times
    rows = [
        statistics(read(int(i)), jax.random.fold_in(key, draw)) for draw, i in enumerate(frames)
    ]
    clean = dict(state.params["main"]["clean"])
    for k, sensor in enumerate(("camera", "lidar")):
        fitted = fit_clean(np.concatenate([np.asarray(row[k]) for row in rows]))
        clean[f"{sensor}_mean"] = jnp.asarray(fitted.mean)
        clean[f"{sensor}_whiten"] = jnp.asarray(fitted.whiten)
    main = state.params["main"] | {"clean": clean}
    return state._replace(params=state.params | {"main": main})
