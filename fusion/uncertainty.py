"""What a Bayesian gate says of a window: probabilities, weights with intervals, and doubt.

The predictive distribution is the mean over draws of the gate (`sample_predictive`), or its
approximation by means and variances that one pass carries along (`one_pass_predictive`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Key

from fusion._checks import check_count, check_key, check_number
from fusion.config import ModelConfig
from fusion.models import Params, predict, variational_gate

DRAWS = 32
"""Draws of the gate that the predictive distribution of record is the mean of."""


class Predictive(NamedTuple):
    """The predictive distribution of a batch.

    Attributes:
        probabilities: of the classes.
        weights: expected fusion weights.
        weight_low, weight_high: ends of their central intervals.
        entropy: of `probabilities`, in nats: all doubt.
        epistemic: the part of it that the gate's uncertainty makes, the mutual information of
            class and gate, in nats.
    """

    probabilities: Float[Array, "b c"]
    weights: Float[Array, "b k"]
    weight_low: Float[Array, "b k"]
    weight_high: Float[Array, "b k"]
    entropy: Float[Array, " b"]
    epistemic: Float[Array, " b"]


def _entropy(p: Float[Array, "*s c"]) -> Float[Array, "*s"]:
    return -jnp.sum(p * jnp.log(jnp.maximum(p, 1e-12)), axis=-1)


def summarize_draws(
    logits: Float[Array, "s b c"], weights: Float[Array, "s b k"], level: float = 0.9
) -> Predictive:
    r"""The mixture of S networks, or S draws of one.

    .. math::
        \bar p = \frac1S \sum_s p_s, \qquad
        H(\bar p) = \underbrace{H(\bar p) - \frac1S \sum_s H(p_s)}_{\text{epistemic}}
            + \frac1S \sum_s H(p_s)

    Args:
        logits, weights: of every draw.
        level: share of the draws between `weight_low` and `weight_high`.

    Returns:
        The predictive distribution; intervals are quantiles of the draws.

    Source: Depeweg et al. (2018), for the two parts.
    """
    check_number("level", level, 0.0, 1.0, above=True, below=True, fix="0.9 is usual")
    p = jax.nn.softmax(logits, axis=-1)
    mean = jnp.mean(p, axis=0)
    entropy = _entropy(mean)
    ends = jnp.quantile(weights, jnp.array([0.5 - level / 2.0, 0.5 + level / 2.0]), axis=0)
    epistemic = jnp.maximum(entropy - jnp.mean(_entropy(p), axis=0), 0.0)
    return Predictive(mean, jnp.mean(weights, axis=0), ends[0], ends[1], entropy, epistemic)


def expected_softmax(
    mean: Float[Array, "*b k"], pair_variance: Float[Array, "*b k k"]
) -> Float[Array, "*b k"]:
    r"""Mean-field approximation of the expected softmax of Gaussian scores.

    .. math::
        E[\text{softmax}(s)_k] \approx \frac{q_k}{\sum_j q_j}, \qquad
        \frac{1}{q_k} = \sum_j \exp\left(
            -\frac{m_k - m_j}{\sqrt{1 + \tfrac{\pi}{8} \operatorname{Var}(s_k - s_j)}}\right)

    Each pair of scores is treated by the probit approximation of the logistic function; it is the
    softmax of the means where nothing varies. Error below 0.02 for two scores, see the tests for
    more.

    Args:
        mean: of the scores.
        pair_variance: variance of the difference of each pair of scores.

    Source: Lu, Ie and Sha (2020), mean-field approximation 2; MacKay (1992) for the probit.
    """
    gap = mean[..., :, None] - mean[..., None, :]
    share = -gap / jnp.sqrt(1.0 + jnp.pi / 8.0 * pair_variance)
    return jax.nn.softmax(-jax.nn.logsumexp(share, axis=-1), axis=-1)


def _pairs(covariance: Float[Array, "*b k k"]) -> Float[Array, "*b k k"]:
    own = jnp.diagonal(covariance, axis1=-2, axis2=-1)
    total = own[..., :, None] + own[..., None, :] - 2.0 * covariance
    return jnp.maximum(total, 0.0)


def scores_predictive(
    config: ModelConfig,
    main: Params,
    x: Float[Array, "b k t"],
    mean: Float[Array, "b k"],
    covariance: Float[Array, "b k k"],
    available: Bool[Array, "b k"] | None = None,
    *,
    level: float = 0.9,
) -> Predictive:
    r"""The predictive distribution of Gaussian scores, in one pass.

    .. math::
        \bar w \approx E[\text{softmax}(s)], \qquad
        \ell \sim N\left(\ell(\bar w),\; J C J^T\right), \quad
        J = \frac{\partial \ell}{\partial s}, \qquad
        \bar p \approx E[\text{softmax}(\ell)]

    Symbols: C is the covariance of the scores, :math:`\ell` the logits. The head is linear around
    the expected weights; its K tangents go through it beside the values, and the encoders run once.
    The epistemic part is :math:`\tfrac12 \operatorname{tr}[(\operatorname{diag} p - p p^T) J C
    J^T]` with p the softmax of :math:`\ell(\bar w)`, the mutual information to second order; the
    intervals are those of the log odds of each weight.

    Args:
        config, main: network and exported parameters.
        x: windows, as in `fusion.predict`.
        mean, covariance: of the scores.
        available: as in `fusion.predict`.
        level: of the intervals.
    """
    check_number("level", level, 0.0, 1.0, above=True, below=True, fix="0.9 is usual")
    if config.normalizer == "softmax_sigmoid":
        slope = jax.nn.sigmoid(mean) * (1.0 - jax.nn.sigmoid(mean))
        own = jnp.diagonal(covariance, axis1=1, axis2=2)
        mean = jax.nn.sigmoid(mean / jnp.sqrt(1.0 + jnp.pi / 8.0 * own))
        covariance = slope[:, :, None] * covariance * slope[:, None, :]
    weights = expected_softmax(mean, _pairs(covariance))

    def head(scores: Float[Array, "b k"]) -> tuple[Array, Array]:
        given = jax.nn.softmax(scores, axis=-1)
        out = predict(config, main, x, available=available, weights=given)
        return out.logits, out.weights

    (logits, used), push = jax.linearize(head, jnp.log(jnp.maximum(weights, 1e-12)))
    slopes, _ = push_scores(push, mean)
    spread = jnp.einsum("kbc,bkl,lbd->bcd", slopes, covariance, slopes)
    probabilities = expected_softmax(logits, _pairs(spread))
    p = jax.nn.softmax(logits, axis=-1)
    fisher = jnp.einsum("bc,bcc->b", p, spread) - jnp.einsum("bc,bcd,bd->b", p, spread, p)
    entropy = _entropy(probabilities)
    epistemic = jnp.minimum(jnp.maximum(0.5 * fisher, 0.0), entropy)
    low, high = _odds_interval(mean, covariance, level)
    there = used > 0.0
    kept = jnp.sum(jnp.where(there, weights, 0.0), axis=-1, keepdims=True)
    kept = jnp.maximum(kept, jnp.finfo(weights.dtype).tiny)
    low, high = (jnp.where(there, jnp.minimum(w / kept, 1.0), 0.0) for w in (low, high))
    return Predictive(probabilities, used, low, high, entropy, epistemic)


def _odds_interval(mean: Array, covariance: Array, level: float) -> tuple[Array, Array]:
    """Central intervals of softmax weights: Gaussian log odds, linear around the mean scores."""
    k = mean.shape[-1]
    if k == 1:
        return jnp.ones_like(mean), jnp.ones_like(mean)
    eye = jnp.eye(k, dtype=bool)
    others = jnp.where(eye, -jnp.inf, mean[:, None, :])
    odds = mean - jax.nn.logsumexp(others, axis=-1)
    slope = jnp.where(eye, 1.0, -jax.nn.softmax(others, axis=-1))
    sd = jnp.sqrt(jnp.maximum(jnp.einsum("bkj,bjl,bkl->bk", slope, covariance, slope), 0.0))
    z = jax.scipy.stats.norm.ppf(0.5 + level / 2.0).astype(mean.dtype)
    return jax.nn.sigmoid(odds - z * sd), jax.nn.sigmoid(odds + z * sd)


def draw_keys(n_draws: int, *, key: Key[Array, ""]) -> Key[Array, " s"]:
    """A key for each draw.

    Raises:
        ValueError, TypeError: a legacy key, or no draw.
    """
    check_key(key)
    check_count("n_draws", n_draws)
    return jax.random.split(key, n_draws)


def mix_gates(
    config: ModelConfig,
    main: Params,
    x: Float[Array, "b k t"],
    available: Bool[Array, "b k"] | None,
    weights_of: Callable[[Key[Array, ""]], Float[Array, "b k"]],
    keys: Key[Array, " s"],
    level: float,
) -> Predictive:
    """The mixture over draws of the fusion weights: `weights_of(key)` is one of them."""

    def draw(one: Key[Array, ""]) -> tuple[Array, Array]:
        out = predict(config, main, x, available=available, weights=weights_of(one))
        return out.logits, out.weights

    return summarize_draws(*jax.vmap(draw)(keys), level)


def push_scores(push: Callable[..., Any], scores: Float[Array, "b k"]) -> Any:
    """What `push`, linear in the scores of `jax.linearize`, gives for a unit of each of the K."""
    k = scores.shape[-1]
    unit = jnp.eye(k, dtype=scores.dtype)
    return jax.vmap(push)(jnp.broadcast_to(unit[:, None, :], (k, *scores.shape)))


def _check_variational(config: ModelConfig) -> None:
    if not config.variational:
        raise ValueError(
            f"gate_kind={config.gate_kind!r}: expected a variational gate; train with "
            "gate_kind='variational', or see fusion.posteriors for networks without one"
        )


def sample_predictive(
    config: ModelConfig,
    main: Params,
    x: Float[Array, "b k t"],
    available: Bool[Array, "b k"] | None = None,
    *,
    key: Key[Array, ""],
    n_draws: int = DRAWS,
    level: float = 0.9,
) -> Predictive:
    """The predictive distribution by draws of the gate, in one vmapped call.

    The encoders run once; gate and head run for each draw. Every example has draws of its own.

    Args:
        config: static, with a variational gate.
        main: `fusion.export(params)`.
        x: windows, as in `fusion.predict`; NaN for sensors that are absent.
        available: False for sensors that sent nothing.
        key: of the draws.
        n_draws: their number.
        level: of the intervals of the weights.

    Raises:
        ValueError: a gate without distributions, a legacy key, a level outside (0, 1).

    Example:
        >>> config = ModelConfig("netgated", 3, 1, 2, gate_kind="variational")
        >>> from fusion.models import export, init
        >>> main = export(init(jax.random.key(0), config))
        >>> found = sample_predictive(config, main, jnp.zeros((5, 3, 1)), key=jax.random.key(1))
        >>> found.weights.shape, bool((found.weight_low < found.weight_high).all())
        ((5, 3), True)
    """
    _check_variational(config)
    keys = draw_keys(n_draws, key=key)
    features = predict(config, main, x, available=available).features
    gate = variational_gate(config)

    def weights_of(one: Key[Array, ""]) -> Any:
        return gate.apply({"params": main["gate"]}, features, one)

    return mix_gates(config, main, x, available, weights_of, keys, level)


def one_pass_predictive(
    config: ModelConfig,
    main: Params,
    x: Float[Array, "b k t"],
    available: Bool[Array, "b k"] | None = None,
    *,
    level: float = 0.9,
) -> Predictive:
    """The predictive distribution without draws: means and variances go through the gate.

    Arguments and result as in `sample_predictive`; approximations as in `scores_predictive`.

    Raises:
        ValueError: a gate without distributions, a level outside (0, 1).
    """
    _check_variational(config)
    features = predict(config, main, x, available=available).features
    gate = variational_gate(config)
    moments: Any = gate.apply({"params": main["gate"]}, features, method="moments")
    covariance = jax.vmap(jnp.diag)(moments[1])
    return scores_predictive(config, main, x, moments[0], covariance, available, level=level)


def abstention_threshold(probabilities: Float[ArrayLike, "n c"], *, coverage: float) -> float:
    """The confidence that this share of the examples reaches; choose it on validation rows.

    Raises:
        ValueError: a coverage outside (0, 1].
    """
    check_number("coverage", coverage, 0.0, 1.0, above=True, fix="0.9 answers nine of ten")
    return float(np.quantile(np.asarray(probabilities).max(axis=1), 1.0 - coverage))


def abstain(
    probabilities: Float[Array, "b c"], threshold: float | Float[Array, ""]
) -> Bool[Array, " b"]:
    """True where the largest probability is below the threshold: no answer is given.

    Example:
        >>> abstain(jnp.array([[0.9, 0.1], [0.6, 0.4]]), 0.8).tolist()
        [False, True]
    """
    return jnp.max(probabilities, axis=-1) < threshold
