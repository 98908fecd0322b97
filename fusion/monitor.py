"""Which sensors have failed, told from each sensor's own features, at a stated false-alarm rate.

A fusion weight says how much a sensor is worth beside the others, not whether it works. The monitor
is one logistic regression per sensor on the features that the encoders make anyway, trained on
simulated failures of every kind; its threshold is a quantile over working sensors.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from fusion._checks import check_choice, check_key, check_number
from fusion.config import ModelConfig
from fusion.failure_kinds import FAILURE_KINDS, FailureKind, apply_failure
from fusion.models import Params, predict

STEPS = 300
RIDGE = 1e-3


class MonitorParams(NamedTuple):
    """A logistic regression per sensor on standardized features, and when it calls.

    Attributes:
        mean, spread: of the features in training, working and failed, `[sensor, feature]`.
        slope: `[sensor, feature]`; offset: `[sensor]`.
        threshold: failure probability above which a sensor is called failed, `[sensor]`.
    """

    mean: Float[Array, "k f"]
    spread: Float[Array, "k f"]
    slope: Float[Array, "k f"]
    offset: Float[Array, " k"]
    threshold: Float[Array, " k"]


def failure_probability(
    params: MonitorParams, features: Float[Array, "k b f"]
) -> Float[Array, "b k"]:
    r"""Probability that each sensor has failed, from its own features.

    .. math:: p_k = \sigma\left(a_k^T \frac{z_k - \mu_k}{s_k} + b_k\right)

    Failures were as frequent as working sensors in training; where they are rarer, the odds are
    too high by the ratio, the order is the same, and `threshold` is not touched by it.
    """
    z = (features - params.mean[:, None, :]) / params.spread[:, None, :]
    score = jnp.einsum("kbf,kf->kb", z, params.slope) + params.offset[:, None]
    return jax.nn.sigmoid(score).T


def _logistic(z: Float[Array, "k b f"], failed: Float[Array, "k b"]) -> tuple[Array, Array]:
    """Slopes and offsets by Nesterov's gradient descent; the step is below one over the curvature.

    The curvature of the loss is at most a quarter of the largest eigenvalue of the features' second
    moments, which the largest sum of a row bounds.
    """
    moments = jnp.einsum("kbf,kbg->kfg", z, z) / z.shape[1]
    bound = jnp.max(jnp.sum(jnp.abs(moments), axis=2), axis=1)
    rate = 1.0 / (0.25 * (bound + 1.0) + 2.0 * RIDGE)

    def loss(weights: tuple[Array, Array]) -> Array:
        slope, offset = weights
        score = jnp.einsum("kbf,kf->kb", z, slope) + offset[:, None]
        fit = jax.nn.softplus(score) - failed * score
        return jnp.sum(jnp.mean(fit, axis=1)) + RIDGE * jnp.sum(slope**2)

    def step(carry: tuple, number: Array) -> tuple[tuple, None]:
        (slope, offset), (ahead_slope, ahead_offset) = carry
        by_slope, by_offset = jax.grad(loss)((ahead_slope, ahead_offset))
        new = (ahead_slope - rate[:, None] * by_slope, ahead_offset - rate * by_offset)
        push = number / (number + 3.0)
        ahead = (new[0] + push * (new[0] - slope), new[1] + push * (new[1] - offset))
        return (new, ahead), None

    start = (jnp.zeros(z.shape[::2], z.dtype), jnp.zeros(z.shape[0], z.dtype))
    numbers = jnp.arange(STEPS, dtype=z.dtype)
    (weights, _), _ = jax.lax.scan(step, (start, start), numbers)
    return weights


@functools.partial(jax.jit, static_argnums=(0, 3, 4))
def _fit(
    config: ModelConfig,
    main: Params,
    x: Float[Array, "n k t"],
    kinds: tuple[str, ...],
    rate: float,
    key: Key[Array, ""],
) -> MonitorParams:
    mask_key, *keys = jax.random.split(key, 1 + len(kinds))
    n, k, _ = x.shape
    failed = jax.random.bernoulli(mask_key, 0.5, (n, k))
    # Every kind fails an equal part of the windows.
    kind_of = jnp.arange(n) % len(kinds)
    broken = x
    for i, (kind, noise_key) in enumerate(zip(kinds, keys, strict=True)):
        here = failed & (kind_of == i)[:, None]
        broken = apply_failure(broken, here, kind, key=noise_key)
    # Weights are not looked at, so the oracle may take all sensors for working ones.
    none = jnp.zeros((n, k), bool) if config.reads_failed else None
    working = predict(config, main, x, none).features
    features = predict(config, main, broken, none).features
    mean = jnp.mean(features, axis=1)
    spread = jnp.std(features, axis=1) + 1e-6
    z = (features - mean[:, None, :]) / spread[:, None, :]
    slope, offset = _logistic(z, failed.T.astype(z.dtype))
    params = MonitorParams(mean, spread, slope, offset, jnp.zeros(k))
    calls = failure_probability(params, working)
    return params._replace(threshold=jnp.quantile(calls, 1.0 - rate, axis=0))


def fit_monitor(
    config: ModelConfig,
    main: Params,
    x: Float[Array, "n k t"],
    *,
    key: Key[Array, ""],
    kinds: Sequence[FailureKind | str] = FAILURE_KINDS,
    false_alarm_rate: float = 0.01,
) -> MonitorParams:
    """Train the monitor on simulated failures of clean windows.

    Args:
        config, main: a trained network and its exported parameters.
        x: clean windows scaled to [-1, 1], best of rows that the network was not trained on.
        key: decides which sensors fail, and how.
        kinds: kinds of failure, equally often.
        false_alarm_rate: share of windows of a working sensor in which it is called failed.

    Returns:
        The parameters of `failure_probability`, with the thresholds of this rate on `x`.

    Raises:
        ValueError: an unknown kind, a rate outside (0, 1), fewer windows than kinds, a legacy key.
    """
    check_key(key)
    for kind in kinds:
        check_choice("kinds", kind, FAILURE_KINDS)
    check_number("false_alarm_rate", false_alarm_rate, 0.0, 1.0, above=True, below=True)
    if len(x) * false_alarm_rate < 1.0:
        raise ValueError(
            f"false_alarm_rate={false_alarm_rate}: expected at least 1 / {len(x)}, one window of "
            "those given; raise it or give more windows"
        )
    return _fit(config, main, jnp.asarray(x), tuple(kinds), float(false_alarm_rate), key)
