"""Which features are active, by their mean fusion weights."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from failure import bnn


def active_features(weights: Float[Array, "n d"], share: float | None = None) -> tuple[Any, int]:
    """Features ranked by mean fusion weight, and how many of them are active.

    The rule: the fewest features whose weights sum to `share`; one half without. (The source
    keeps the top N and does not say how N is chosen.)

    Returns:
        `(order [D], best first; N)`.

    Example:
        >>> order, n = active_features(jnp.asarray([[0.1, 0.6, 0.3]]), 0.8)
        >>> order.tolist(), n
        ([1, 2, 0], 2)
    """
    mean = np.asarray(weights, np.float64).mean(0)
    order = np.argsort(-mean, kind="stable")
    total = np.cumsum(mean[order]) / mean.sum()
    return order, int(np.searchsorted(total, (0.5 if share is None else share) - 1e-12) + 1)


def check_active(
    z: Float[Array, "n d"],
    y: Float[Array, " n"],
    order: Any,
    n_active: int,
    *,
    key: Key[Array, ""],
    hidden: int = 32,
    steps: int = 600,
) -> tuple[float, float]:
    """Held-out error of a small fully connected network on the active features, and on all.

    The source's second step: where the two are alike, the active features carry the target.

    Returns:
        `(RMSE on z_act, RMSE on z)` of the last fifth of the rows, outputs standardised.
    """
    cut = max(1, z.shape[0] // 5)
    errors = []
    for columns in (order[:n_active], order):
        config = bnn.BNNConfig(hidden=hidden, steps=steps)
        part = z[:, np.asarray(columns)]
        params, _ = jax.jit(bnn.fit, static_argnums=0)(
            config, bnn.BNNTrainParams(), part[:-cut], y[:-cut, None], key=key
        )
        error = bnn.predict(params, part[-cut:])[:, 0] - y[-cut:]
        errors.append(float(jnp.sqrt(jnp.mean(error**2)) / jnp.std(y)))
    return errors[0], errors[1]
