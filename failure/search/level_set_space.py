"""The search space of level sets: learned again from gradients, about the best evaluation."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from failure import level_sets
from failure.search.level_set_features import LevelSetFeatures
from failure.search.methods import SearchConfig
from failure.search.subspace import Gradient, Remembered

REACH = 4.0
"""Half width of the trust region at first [sigma]."""

LEAST = 0.3
"""...and at least [sigma]."""

STEPS = 200
"""Steps of each training: it is done again every few simulations."""

ROWS = 32
"""Gradients are repeated up to a multiple of this many: one program serves several trainings."""


def trust_region(y: Float[np.ndarray, " n"], every: int) -> float:
    """Half width [sigma]: halved for every `every` evaluations in a row without a better one."""
    best = int(np.argmax(np.nan_to_num(y, nan=-np.inf)))
    return max(REACH * 0.5 ** ((len(y) - 1 - best) // max(every, 1)), LEAST)


def level_sets_of_gradient(gradient: Gradient) -> Any:
    """A `train` of `run` or `ask` that learns level sets from the simulator's own gradients.

    The map is learned again at every training from all gradients so far, those of failures
    included, and the trust region moves to the best evaluation so far. Each gradient is paid once.

    Args:
        gradient: `x [n, D] -> dy/dx [n, D]`, larger y is worse.

    Returns:
        `train(config, keys, x, y) -> LevelSetFeatures`.
    """
    known = Remembered(gradient)

    def train(config: SearchConfig, keys: Any, x: np.ndarray, y: np.ndarray) -> LevelSetFeatures:
        assert config.embedding_dim is not None
        sizes = level_sets.LevelSetConfig(n_active=config.embedding_dim, steps=STEPS)
        known.learn(x)
        spaces = []
        for k, block in enumerate(x):
            slopes = known(block)
            good = np.all(np.isfinite(slopes), axis=1) & np.any(slopes != 0.0, axis=1)
            rows, slopes = block[good], slopes[good]
            if len(rows) == 0:
                raise ValueError("gradient: expected at least one finite row that is not zero")
            size = ROWS * -(-len(rows) // ROWS)
            # Newest first: what is repeated is what has been found, not the initial design.
            pick = np.resize(np.arange(len(rows))[::-1], size)
            found, _ = level_sets.fit(rows[pick], slopes[pick], key=keys[k], config=sizes)
            best = block[int(np.argmax(np.nan_to_num(y[k], nan=-np.inf)))]
            with jax.enable_x64(True):
                z = np.asarray(level_sets.features(found, jnp.asarray(best[None])))[0]
            reach = trust_region(y[k], config.retrain_every or 3)
            d = sizes.n_active
            spaces.append(
                LevelSetFeatures(
                    found.rotation, found.scale, found.network, z[:d],
                    np.float64(2.0 * reach / float(found.scale)), z[d:],
                )
            )  # fmt: skip
        with jax.enable_x64(True):
            return jax.tree.map(
                lambda *leaves: jnp.stack([jnp.asarray(a) for a in leaves]), *spaces
            )

    return train
