"""Bayesian network from active to inactive features: mean-field variational, linear baseline."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key


@dataclass(frozen=True)
class BNNConfig:
    """Size of the network and length of its training.

    Attributes:
        hidden: hidden units.
        steps: Adam steps.
        n_samples: weight samples per step.

    Raises:
        ValueError: a number below one.
    """

    hidden: int = 64
    steps: int = 2000
    n_samples: int = 1

    def __post_init__(self) -> None:
        """Refuse a network that is none."""
        for name in ("hidden", "steps", "n_samples"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: expected at least 1")


class BNNTrainParams(NamedTuple):
    """Prior and training, floats that a sweep may vary without a new program.

    Attributes:
        prior_scale: standard deviation of a weight times the square root of its fan-in.
        init_log_sd: log standard deviation that all weights start with.
        learning_rate: of Adam, cosine decay.
    """

    prior_scale: float = 1.0
    init_log_sd: float = -4.0
    learning_rate: float = 1e-2


class BNNParams(NamedTuple):
    """Variational posterior: mean and log standard deviation of every weight, observation noise.

    `weights` and `log_sd` are tuples `(w1 [i, h], b1 [h], w2 [h, o], b2 [o])`; inputs and
    outputs are standardised with `x_shift, x_scale, y_shift, y_scale`.
    """

    weights: tuple[Array, Array, Array, Array]
    log_sd: tuple[Array, Array, Array, Array]
    log_noise: Array
    x_shift: Array
    x_scale: Array
    y_shift: Array
    y_scale: Array


def _moments(x: Array) -> tuple[Array, Array]:
    mean, sd = jnp.mean(x, 0), jnp.std(x, 0)
    return mean, jnp.where(sd > 1e-6 * jnp.abs(mean), sd, jnp.ones_like(sd))


def check_rows(x: Array, y: Array) -> None:
    """Refuse inputs and outputs of different or too few rows."""
    if x.shape[0] != y.shape[0] or x.shape[0] < 2:
        raise ValueError(
            f"x has {x.shape[0]} rows and y {y.shape[0]}: expected the same number, at least 2"
        )


def init(
    key: Key[Array, ""],
    config: BNNConfig,
    training: BNNTrainParams,
    x: Float[Array, "n i"],
    y: Float[Array, "m o"],
) -> BNNParams:
    """Initial posterior: small random means, narrow spread, moments of the data."""
    check_rows(x, y)
    n_in, n_out, h = x.shape[1], y.shape[1], config.hidden
    key1, key2 = jax.random.split(key)
    weights = (
        jax.random.normal(key1, (n_in, h), x.dtype) / math.sqrt(n_in),
        jnp.zeros((h,), x.dtype),
        0.1 * jax.random.normal(key2, (h, n_out), x.dtype) / math.sqrt(h),
        jnp.zeros((n_out,), x.dtype),
    )
    log_sd = tuple(jnp.full_like(w, training.init_log_sd) for w in weights)
    return BNNParams(
        weights,
        (log_sd[0], log_sd[1], log_sd[2], log_sd[3]),
        jnp.zeros((n_out,), x.dtype),
        *_moments(x),
        *_moments(y),
    )


def _hidden_and_output(params: BNNParams, x: Array, noise1: Array, noise2: Array) -> Array:
    """Standardised output with local reparameterisation: noise on activations, not on weights."""
    w1, b1, w2, b2 = params.weights
    v1, c1, v2, c2 = (jnp.exp(2.0 * s) for s in params.log_sd)
    a = x @ w1 + b1[None]
    spread1 = jnp.sqrt((x * x) @ v1 + c1[None])
    h = jnp.tanh(a + noise1 * spread1)
    out = h @ w2 + b2[None]
    spread2 = jnp.sqrt((h * h) @ v2 + c2[None])
    return out + noise2 * spread2


def _kl(training: BNNTrainParams, params: BNNParams) -> Array:
    """KL divergence from the factorised posterior to the normal prior."""
    n_in, h = params.weights[0].shape
    total = jnp.zeros((), params.log_noise.dtype)
    scales = (n_in**-0.5, 1.0, h**-0.5, 1.0)
    for mean, log_sd, scale in zip(params.weights, params.log_sd, scales, strict=True):
        prior = jnp.asarray(training.prior_scale * scale, mean.dtype)
        ratio = (jnp.exp(2.0 * log_sd) + mean**2) / prior**2
        total = total + 0.5 * jnp.sum(ratio - 1.0 - 2.0 * log_sd + 2.0 * jnp.log(prior))
    return total


def negative_elbo(
    config: BNNConfig,
    training: BNNTrainParams,
    params: BNNParams,
    x: Float[Array, "n i"],
    y: Float[Array, "n o"],
    *,
    key: Key[Array, ""],
) -> Float[Array, ""]:
    r"""Negative evidence lower bound per data point.

    .. math:: -\mathbb E_q[\log p(y \mid x, w)] + \mathrm{KL}(q(w) \,\|\, p(w))

    Args:
        config: number of samples.
        training: the prior.
        params: the variational posterior.
        x: inputs.
        y: targets.
        key: random key of the activations' noise.

    Source: Blundell et al. (2015), Equation 2; Kingma et al. (2015) for sampling activations.
    """
    n = x.shape[0]
    x = (x - params.x_shift[None]) / params.x_scale[None]
    y = (y - params.y_shift[None]) / params.y_scale[None]
    h, n_out = params.weights[2].shape

    def one(sub: Array) -> Array:
        key1, key2 = jax.random.split(sub)
        noise1 = jax.random.normal(key1, (n, h), x.dtype)
        noise2 = jax.random.normal(key2, (n, n_out), x.dtype)
        error = (y - _hidden_and_output(params, x, noise1, noise2)) ** 2
        precision = jnp.exp(-2.0 * params.log_noise)[None]
        return 0.5 * jnp.sum(error * precision) + n * jnp.sum(params.log_noise)

    fit_term = jnp.mean(jax.vmap(one)(jax.random.split(key, config.n_samples)))
    return (fit_term + _kl(training, params)) / n


def fit(
    config: BNNConfig,
    training: BNNTrainParams,
    x: Float[Array, "n i"],
    y: Float[Array, "m o"],
    *,
    key: Key[Array, ""],
) -> tuple[BNNParams, Float[Array, " t"]]:
    """Train the posterior by Adam in one scan.

    Args:
        config: sizes and steps.
        training: prior and learning rate.
        x: inputs `z_act`.
        y: targets `z_inact`.
        key: random key.

    Returns:
        `(posterior, negative ELBO of every step)`.

    Raises:
        ValueError: rows of `x` and `y` differ, or fewer than 2.
    """
    key_init, key_fit = jax.random.split(key)
    params = init(key_init, config, training, x, y)
    with jax.numpy_dtype_promotion("standard"):
        optimiser = optax.adam(optax.cosine_decay_schedule(1.0, config.steps))
    free = (params.weights, params.log_sd, params.log_noise)

    def join(free: Any) -> BNNParams:
        return params._replace(weights=free[0], log_sd=free[1], log_noise=free[2])

    def step(carry: tuple, sub: Array) -> tuple[tuple, Array]:
        free, state = carry
        loss, grad = jax.value_and_grad(
            lambda f: negative_elbo(config, training, join(f), x, y, key=sub)
        )(free)
        # optax raises a Python float to an integer power, which strict promotion forbids.
        with jax.numpy_dtype_promotion("standard"):
            update, state = optimiser.update(grad, state)
        # The rate is a number of the run, not of the program: a sweep over it compiles nothing.
        update = jax.tree.map(lambda u: jnp.asarray(training.learning_rate, u.dtype) * u, update)
        return (optax.apply_updates(free, update), state), loss

    keys = jax.random.split(key_fit, config.steps)
    (free, _), losses = jax.lax.scan(step, (free, optimiser.init(free)), keys)
    return join(free), losses


def sample(
    params: BNNParams, x: Float[Array, "n i"], n_samples: int, *, key: Key[Array, ""]
) -> Float[Array, "s n o"]:
    """Draw functions from the posterior (without observation noise), one weight set per sample."""
    scaled = (x - params.x_shift[None]) / params.x_scale[None]

    def one(sub: Array) -> Array:
        keys = jax.random.split(sub, 4)
        w1, b1, w2, b2 = (
            mean + jnp.exp(log_sd) * jax.random.normal(k, mean.shape, mean.dtype)
            for mean, log_sd, k in zip(params.weights, params.log_sd, keys, strict=True)
        )
        return jnp.tanh(scaled @ w1 + b1[None]) @ w2 + b2[None]

    draws = jax.vmap(one)(jax.random.split(key, n_samples))
    return draws * params.y_scale[None, None] + params.y_shift[None, None]


def predict(params: BNNParams, x: Float[Array, "n i"]) -> Float[Array, "n o"]:
    """Output at the posterior mean of the weights: deterministic, as a restoration needs it.

    The mean over `sample` differs by the curvature of the hidden layer only.
    """
    w1, b1, w2, b2 = params.weights
    scaled = (x - params.x_shift[None]) / params.x_scale[None]
    out = jnp.tanh(scaled @ w1 + b1[None]) @ w2 + b2[None]
    return out * params.y_scale[None] + params.y_shift[None]
