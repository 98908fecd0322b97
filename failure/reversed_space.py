"""The search space of Rev-ARGate: trained on evaluations, run backwards by the search."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from failure import bnn, revnet
from failure.rev_argate import (
    RevArgateConfig,
    RevArgateTrainParams,
    fit,
    fusion_weights,
)
from failure.search.spaces import ReversedFeatures
from failure.search.task import Task, unit_scale


def make_space(
    config: RevArgateConfig,
    training: RevArgateTrainParams,
    task: Task,
    n_active: int,
    restore: bool,
    x: Float[Array, "n d"],
    y: Float[Array, " n"],
    *,
    key: Key[Array, ""],
) -> tuple[ReversedFeatures, Float[Array, " d"]]:
    r"""Train on simulated samples and build the search space z_act -> x.

    Active features range over :math:`m_k \pm \sqrt{d}\, s_k` with the mean and deviation of the
    training data: the cube :math:`[-\sqrt d, \sqrt d]^d` of the source in units of the feature.

    Args:
        config: sizes and steps.
        training: loss weights and rates.
        task: the feasible set of x.
        n_active: d, the number of features kept.
        restore: train the Bayesian network for the others; zeros without.
        x: simulated parameters in sigma.
        y: outputs, NaN where invalid.
        key: random key.

    Returns:
        `(space, mean fusion weight of every feature)`.
    """
    key_fit, key_bnn = jax.random.split(key)
    x_scale = jnp.asarray(unit_scale(task) / math.sqrt(12.0), x.dtype)
    good = jnp.isfinite(y)
    mask = good.astype(x.dtype)
    count = jnp.maximum(jnp.sum(mask), 2.0)
    filled = jnp.where(good, y, jnp.zeros_like(y))
    mean = jnp.sum(filled) / count
    centred = jnp.where(good, filled - mean, jnp.zeros_like(y))
    sd = jnp.sqrt(jnp.sum(centred**2) / count)
    target = centred / jnp.where(sd > 0, sd, jnp.ones_like(sd))
    params, _ = fit(config, training, x / x_scale, target, mask, key=key_fit)
    weights = jnp.mean(fusion_weights(config, params, x / x_scale), 0)
    order = jnp.argsort(-weights)
    z = revnet.forward(params.network, x / x_scale)[:, order]
    active, rest = z[:, :n_active], z[:, n_active:]
    spread = jnp.std(active, 0)
    restoration = None
    if restore and n_active < x.shape[1]:
        restoration, _ = bnn.fit(
            config.restoration, training.restoration, active, rest, key=key_bnn
        )
    space = ReversedFeatures(
        params.network,
        order,
        jnp.mean(active, 0),
        2.0 * math.sqrt(n_active) * spread,
        x_scale,
        restoration,
    )
    return space, weights


def train_space(config: Any, keys: Any, x: np.ndarray, y: np.ndarray) -> ReversedFeatures:
    """Spaces of all seeds of a search, one program mapped over them.

    Trained in float32; the space comes back in float64, in which the RevNet inverts to 1e-12.
    """
    restore = config.method == "rev_argate_bnn"
    sizes = config.rev_argate or RevArgateConfig()
    training = config.rev_argate_training or RevArgateTrainParams()
    training.check()
    data = jax.random.key_data(keys)
    with jax.enable_x64(False):
        raw = jax.random.wrap_key_data(jnp.asarray(np.asarray(data)))
        spaces = _train(
            sizes,
            config.task,
            config.embedding_dim,
            restore,
            training,
            raw,
            jnp.asarray(x, jnp.float32),
            jnp.asarray(y, jnp.float32),
        )

    def widen(leaf: Any) -> Any:
        leaf = np.asarray(leaf)
        return jnp.asarray(leaf.astype(np.float64) if leaf.dtype == np.float32 else leaf)

    return jax.tree.map(widen, spaces)


def _train_all(
    config: RevArgateConfig,
    task: Task,
    n_active: int,
    restore: bool,
    training: RevArgateTrainParams,
    keys: Array,
    x: Array,
    y: Array,
) -> ReversedFeatures:
    def one(args: tuple[Array, Array, Array]) -> ReversedFeatures:
        key, x, y = args
        return make_space(config, training, task, n_active, restore, x, y, key=key)[0]

    return jax.lax.map(one, (keys, x, y))


_train = jax.jit(_train_all, static_argnums=(0, 1, 2, 3))
