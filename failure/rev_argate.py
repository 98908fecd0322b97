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
from fusion.gating import Gate, apply_weights
from fusion.losses import LossParams, loss_targets
from fusion.targets import TargetConfig, apply_targets, init_targets, project_targets


@dataclass(frozen=True)
class RevArgateConfig:
    """Sizes and length of training; the source states none of these (see docs/rev_argate.md).

    Attributes:
        depth: RevNet blocks.
        step: time step h of a block.
        feature_width: width of the path behind each feature.
        gate_width: hidden units of the gate.
        steps: Adam steps on all data.
        targets: the lattice networks of the learned targets.
        restoration: the Bayesian network.

    Raises:
        ValueError: a number out of range.
    """

    depth: int = 6
    step: float = 0.25
    feature_width: int = 4
    gate_width: int = 32
    steps: int = 600
    targets: TargetConfig = field(default_factory=lambda: TargetConfig(loss_range=(0.0, 2.0)))
    restoration: bnn.BNNConfig = field(default_factory=lambda: bnn.BNNConfig(hidden=32, steps=500))

    def __post_init__(self) -> None:
        """Refuse a network that is none."""
        for name in ("depth", "feature_width", "gate_width", "steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: expected at least 1")
        if not self.step > 0.0:
            raise ValueError(f"step={self.step}: expected a positive time step")


class RevArgateTrainParams(NamedTuple):
    """Loss weights and rates: floats that a sweep may vary without a new program.

    Attributes:
        loss: weights of the auxiliary losses (Equation 4.6), of the fusion-weight regularisation
            and of the anchor of the learned targets (0 is the loss as printed), and the
            temperature of the fixed targets that they are anchored to.
        learning_rate: of Adam, cosine decay.
        weight_decay: decoupled; 50 simulations in 60 dimensions overfit without.
        restoration: prior and rate of the Bayesian network.
    """

    loss: LossParams = LossParams(alpha=1.0, beta=1.0, tau=0.05, anchor=1.0)
    learning_rate: float | Array = 3e-3
    weight_decay: float | Array = 1e-3
    restoration: bnn.BNNTrainParams = bnn.BNNTrainParams()

    def check(self) -> None:
        """Refuse rates that are none, before they are traced; `loss` checks its own.

        Raises:
            ValueError: a negative rate.
        """
        for name in ("learning_rate", "weight_decay"):
            value = getattr(self, name)
            if not np.all(np.asarray(value) >= 0):
                raise ValueError(f"{name}={value}: expected a number of at least 0")


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
    training: RevArgateTrainParams,
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
        config: sizes.
        training: :math:`\alpha, \beta, \tau` and :math:`\lambda` = `anchor` in `training.loss`.
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
    observed = jax.lax.stop_gradient(aux_losses)[None]
    targets = apply_targets(config.targets, params.targets, observed)
    weight = training.loss
    fixed = loss_targets(observed, "softmax", weight.tau)
    pull = jnp.sum(mask * jnp.sum((weights - targets) ** 2, 1)) / count
    anchor = jnp.sum((targets - fixed) ** 2)
    total = main + weight.alpha * auxiliary + weight.beta * pull + weight.anchor * anchor
    return total, main


def fit(
    config: RevArgateConfig,
    training: RevArgateTrainParams,
    x: Float[Array, "n d"],
    y: Float[Array, " n"],
    mask: Float[Array, " n"],
    *,
    key: Key[Array, ""],
) -> tuple[RevArgateParams, Float[Array, " t"]]:
    """Train by Adam on all rows, one scan; lattices are projected after every step.

    Args:
        config: static sizes.
        training: loss weights and rates; traceable, so that a sweep over them compiles once.
        x: inputs, unit variance.
        y: standardised outputs.
        mask: 1 for rows that count.
        key: random key.

    Returns:
        `(params, main loss of every step)`.
    """
    params = init(key, config, x.shape[1])
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())
    decay = optax.cosine_decay_schedule(1.0, config.steps)

    def step(carry: tuple[Any, Any], t: Array) -> tuple[tuple[Any, Any], Array]:
        params, state = carry
        (_, main), grad = jax.value_and_grad(
            lambda p: loss(config, training, p, x, y, mask), has_aux=True
        )(params)
        # The time step h is a constant of the network, not a weight.
        grad = grad._replace(network=grad.network._replace(step=jnp.zeros_like(grad.network.step)))
        # optax raises a Python float to an integer power, which strict promotion forbids.
        with jax.numpy_dtype_promotion("standard"):
            update, state = optimiser.update(grad, state, params)
            rate = -jnp.asarray(training.learning_rate, x.dtype) * decay(t)
            # Decoupled decay: the part of AdamW that takes its weight from the run.
            update = jax.tree.map(
                lambda u, p: rate * (u + jnp.asarray(training.weight_decay, u.dtype) * p),
                update,
                params,
            )
        update = update._replace(
            network=update.network._replace(step=jnp.zeros_like(update.network.step))
        )
        params = optax.apply_updates(params, update)
        params = params._replace(targets=project_targets(config.targets, params.targets))
        return (params, state), main

    (params, _), losses = jax.lax.scan(
        step, (params, optimiser.init(params)), jnp.arange(config.steps)
    )
    return params, losses
