"""Rev-ARGate: a reversible network before a gated regression; features ranked by weight."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key

from failure import bnn, revnet
from failure.search.spaces import ReversedFeatures, Task, unit_scale
from fusion.gating import Gate, apply_weights
from fusion.losses import LossParams, loss_targets
from fusion.targets import TargetConfig, apply_targets, init_targets, project_targets

__all__ = [
    "RevArgateConfig",
    "RevArgateParams",
    "active_features",
    "check_active",
    "fit",
    "fusion_weights",
    "init",
    "loss",
    "make_space",
    "predict",
    "train_space",
]


@dataclass(frozen=True)
class RevArgateConfig:
    """Sizes, loss weights and training; the source states none of these (see docs/rev_argate.md).

    Attributes:
        depth: RevNet blocks.
        step: time step h of a block.
        feature_width: width of the path behind each feature.
        gate_width: hidden units of the gate.
        loss: weights of the auxiliary losses (Equation 4.6), of the fusion-weight regularisation
            and of the anchor of the learned targets (0 is the loss as printed), and the
            temperature of the fixed targets that they are anchored to.
        steps: Adam steps on all data.
        learning_rate: of Adam, cosine decay.
        weight_decay: decoupled; 50 simulations in 60 dimensions overfit without.
        restoration: the Bayesian network.
    """

    depth: int = 6
    step: float = 0.25
    feature_width: int = 4
    gate_width: int = 32
    loss: LossParams = field(
        default_factory=lambda: LossParams(alpha=1.0, beta=1.0, tau=0.05, anchor=1.0)
    )
    steps: int = 600
    learning_rate: float = 3e-3
    weight_decay: float = 1e-3
    targets: TargetConfig = field(default_factory=lambda: TargetConfig(loss_range=(0.0, 2.0)))
    restoration: bnn.BNNConfig = field(default_factory=lambda: bnn.BNNConfig(hidden=32, steps=500))


class RevArgateParams(NamedTuple):
    """Weights of the RevNet, the K = D feature paths, gate, main and auxiliary heads, targets.

    `paths` is `(slope [K, F], offset [K, F])`, `head` is `(w [K F], b [])` and
    `aux_heads` is `(w [K, F], b [K])`.
    """

    network: revnet.RevNetParams
    paths: tuple[Array, Array]
    gate: Any
    head: tuple[Array, Array]
    aux_heads: tuple[Array, Array]
    targets: Any


def init(key: Key[Array, ""], config: RevArgateConfig, dim: int) -> RevArgateParams:
    """Random weights for `dim` inputs; the gate starts at equal weights."""
    keys = jax.random.split(key, 6)
    width = config.feature_width
    gate = Gate(config.gate_width, "softmax")
    return RevArgateParams(
        network=revnet.init(keys[0], dim, depth=config.depth, step=config.step),
        paths=(
            jax.random.normal(keys[1], (dim, width)),
            jax.random.normal(keys[2], (dim, width)),
        ),
        gate=gate.init(keys[3], jnp.zeros((dim, 1, width))),
        head=(jax.random.normal(keys[4], (dim * width,)) / math.sqrt(dim * width), jnp.zeros(())),
        aux_heads=(jnp.zeros((dim, width)), jnp.zeros((dim,))),
        targets=init_targets(keys[5], config.targets, dim),
    )


def _features(params: RevArgateParams, x: Array) -> Array:
    """Paths behind the RevNet's features, `[K, n, F]`."""
    # Six blocks of a few hundred rows: to keep them is cheaper than to undo them.
    z = revnet.forward_stored(params.network, x)
    slope, offset = params.paths
    return jnp.tanh(z.T[:, :, None] * slope[:, None, :] + offset[:, None, :])


def fusion_weights(
    config: RevArgateConfig, params: RevArgateParams, x: Float[Array, "n d"]
) -> Float[Array, "n d"]:
    """Fusion weight of every feature for every row; rows sum to one."""
    weights: Array = Gate(config.gate_width, "softmax").apply(params.gate, _features(params, x))  # type: ignore[assignment]
    return weights


def predict(
    config: RevArgateConfig, params: RevArgateParams, x: Float[Array, "n d"]
) -> Float[Array, " n"]:
    """Standardised output of the main model; `x` in units of its standard deviation."""
    features = _features(params, x)
    weights: Array = Gate(config.gate_width, "softmax").apply(params.gate, features)  # type: ignore[assignment]
    w, b = params.head
    return apply_weights(features, weights, "concat", "mean") @ w + b


def loss(
    config: RevArgateConfig,
    params: RevArgateParams,
    x: Float[Array, "n d"],
    y: Float[Array, " n"],
    mask: Float[Array, " n"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    r"""Training loss of the gated regression.

    .. math::
        L = L_{main} + \alpha \sum_k w_k L^{aux}_k + \beta \sum_k (w_k - f_k(L^{aux}))^2
            + \lambda \sum_k (f_k(L^{aux}) - \mathrm{softmax}(-L^{aux} / \tau)_k)^2

    with squared errors, means over the rows, and :math:`f_k` falling in its own loss.

    Args:
        config: :math:`\alpha, \beta, \tau` and :math:`\lambda` = `anchor` in `config.loss`.
        params: all weights.
        x: inputs, unit variance.
        y: standardised outputs.
        mask: 1 for rows that count.

    Returns:
        `(loss, main part)`.

    Source: Shim (2020), Eq. 4.6. Deviation: the auxiliary losses are means over the
    data (a feature's relevance is a property of the circuit, not of one sample), no gradient
    passes from the targets back into them, and the anchor term keeps learned targets from merely
    copying the weights.
    """
    count = jnp.maximum(jnp.sum(mask), 1.0)
    features = _features(params, x)
    weights: Array = Gate(config.gate_width, "softmax").apply(params.gate, features)  # type: ignore[assignment]
    w, b = params.head
    error = apply_weights(features, weights, "concat", "mean") @ w + b - y
    main = jnp.sum(mask * error**2) / count
    aux_w, aux_b = params.aux_heads
    aux = jnp.einsum("knf,kf->nk", features, aux_w) + aux_b[None]
    aux_losses = jnp.sum(mask[:, None] * (aux - y[:, None]) ** 2, 0) / count
    mean_weights = jnp.sum(mask[:, None] * weights, 0) / count
    auxiliary = jnp.sum(mean_weights * aux_losses)
    seen = jax.lax.stop_gradient(aux_losses)[None]
    targets = apply_targets(config.targets, params.targets, seen)
    fixed = loss_targets(seen, "softmax", config.loss.tau)
    pull = jnp.sum(mask * jnp.sum((weights - targets) ** 2, 1)) / count
    anchor = jnp.sum((targets - fixed) ** 2)
    weigh = config.loss
    total = main + weigh.alpha * auxiliary + weigh.beta * pull + weigh.anchor * anchor
    return total, main


def fit(
    key: Key[Array, ""],
    config: RevArgateConfig,
    x: Float[Array, "n d"],
    y: Float[Array, " n"],
    mask: Float[Array, " n"],
) -> tuple[RevArgateParams, Float[Array, " t"]]:
    """Train by Adam on all rows, one scan; lattices are projected after every step.

    Returns:
        `(params, main loss of every step)`.
    """
    params = init(key, config, x.shape[1])
    schedule = optax.cosine_decay_schedule(config.learning_rate, config.steps)
    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0), optax.adamw(schedule, weight_decay=config.weight_decay)
    )

    def step(carry: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], Array]:
        params, state = carry
        (_, main), grad = jax.value_and_grad(lambda p: loss(config, p, x, y, mask), has_aux=True)(
            params
        )
        # The time step h is a constant of the network, not a weight.
        grad = grad._replace(network=grad.network._replace(step=jnp.zeros_like(grad.network.step)))
        # optax raises a Python float to an integer power, which strict promotion forbids.
        with jax.numpy_dtype_promotion("standard"):
            update, state = optimiser.update(grad, state, params)
        update = update._replace(
            network=update.network._replace(step=jnp.zeros_like(update.network.step))
        )
        params = optax.apply_updates(params, update)
        params = params._replace(targets=project_targets(config.targets, params.targets))
        return (params, state), main

    (params, _), losses = jax.lax.scan(
        step, (params, optimiser.init(params)), None, length=config.steps
    )
    return params, losses


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
    key: Key[Array, ""],
    z: Float[Array, "n d"],
    y: Float[Array, " n"],
    order: Any,
    n_active: int,
    *,
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
        params, _ = jax.jit(bnn.fit, static_argnums=1)(key, config, part[:-cut], y[:-cut, None])
        error = bnn.predict(params, part[-cut:])[:, 0] - y[-cut:]
        errors.append(float(jnp.sqrt(jnp.mean(error**2)) / jnp.std(y)))
    return errors[0], errors[1]


def make_space(
    key: Key[Array, ""],
    config: RevArgateConfig,
    task: Task,
    n_active: int,
    restore: bool,
    x: Float[Array, "n d"],
    y: Float[Array, " n"],
) -> tuple[ReversedFeatures, Float[Array, " d"]]:
    r"""Train on simulated samples and build the search space z_act -> x.

    Active features range over :math:`m_k \pm \sqrt{d}\, s_k` with the mean and deviation of the
    training data: the cube :math:`[-\sqrt d, \sqrt d]^d` of the source in units of the feature.

    Args:
        key: random key.
        config: sizes and training.
        task: the feasible set of x.
        n_active: d, the number of features kept.
        restore: train the Bayesian network for the others; zeros without.
        x: simulated parameters in sigma.
        y: outputs, NaN where invalid.

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
    params, _ = fit(key_fit, config, x / x_scale, target, mask)
    weights = jnp.mean(fusion_weights(config, params, x / x_scale), 0)
    order = jnp.argsort(-weights)
    z = revnet.forward(params.network, x / x_scale)[:, order]
    active, rest = z[:, :n_active], z[:, n_active:]
    spread = jnp.std(active, 0)
    restoration = None
    if restore and n_active < x.shape[1]:
        restoration, _ = bnn.fit(key_bnn, config.restoration, active, rest)
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
    settings = config.rev_argate or RevArgateConfig()
    data = jax.random.key_data(keys)
    with jax.enable_x64(False):
        raw = jax.random.wrap_key_data(jnp.asarray(np.asarray(data)))
        spaces = _train(
            settings,
            config.task,
            config.embedding_dim,
            restore,
            raw,
            jnp.asarray(x, jnp.float32),
            jnp.asarray(y, jnp.float32),
        )

    def widen(leaf: Any) -> Any:
        leaf = np.asarray(leaf)
        return jnp.asarray(leaf.astype(np.float64) if leaf.dtype == np.float32 else leaf)

    return jax.tree.map(widen, spaces)


def _train_all(
    settings: RevArgateConfig,
    task: Task,
    n_active: int,
    restore: bool,
    keys: Array,
    x: Array,
    y: Array,
) -> ReversedFeatures:
    def one(args: tuple[Array, Array, Array]) -> ReversedFeatures:
        return make_space(args[0], settings, task, n_active, restore, args[1], args[2])[0]

    return jax.lax.map(one, (keys, x, y))


_train = jax.jit(_train_all, static_argnums=(0, 1, 2, 3))
