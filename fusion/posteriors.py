"""Other ways to the same predictive distribution: ensembles, dropout, and Laplace on the gate.

They need no variational gate, and are what `fusion.uncertainty` is measured against.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from fusion._checks import check_count, check_number
from fusion.config import MODELS, ModelConfig
from fusion.gating import Gate, normalize
from fusion.models import Params, predict
from fusion.uncertainty import (
    DRAWS,
    Predictive,
    draw_keys,
    mix_gates,
    push_scores,
    summarize_draws,
)


def ensemble_predictive(
    config: ModelConfig,
    mains: Params,
    x: Float[Array, "b k t"],
    available: Bool[Array, "b k"] | None = None,
    *,
    level: float = 0.9,
) -> Predictive:
    """The mixture of networks that were trained apart, by one vmap over their parameters.

    Args:
        config: static; the same for all.
        mains: exported parameters with a leading axis of members, as `jax.vmap` over seeds gives.
        x, available: as in `fusion.predict`.
        level: of the intervals of the weights.

    Source: Lakshminarayanan et al. (2017).
    """
    out = jax.vmap(lambda main: predict(config, main, x, available=available))(mains)
    return summarize_draws(out.logits, out.weights, level)


def dropout_predictive(
    config: ModelConfig,
    main: Params,
    x: Float[Array, "b k t"],
    *,
    key: Key[Array, ""],
    n_draws: int = DRAWS,
    level: float = 0.9,
) -> Predictive:
    """The mixture over draws of the dropout that the network was trained with.

    Dropout is in the head: the fusion weights of all draws are alike. Give finite windows: absent
    sensors are told by `available` at inference only.

    Raises:
        ValueError: a network without dropout, a legacy key.

    Source: Gal and Ghahramani (2016).
    """
    keys = draw_keys(n_draws, key=key)
    if config.dropout == 0.0:
        raise ValueError(
            "dropout=0.0: expected a rate above 0; a network that was trained without dropout has "
            "nothing to draw"
        )
    out = jax.vmap(lambda one: predict(config, main, x, key=one))(keys)
    return summarize_draws(out.logits, out.weights, level)


class LaplaceGate(NamedTuple):
    """A Gaussian around the gate's trained last layer.

    Attributes:
        covariance: of its parameters, `[inputs + 1, sensor, inputs + 1, sensor]`; the last input is
            the bias.
    """

    covariance: Float[Array, "h k h k"]


def _scores(
    main: Params, features: Float[Array, "k b f"]
) -> tuple[Float[Array, "b k"], Float[Array, "b h"]]:
    """Scores of the gate, and inputs of its last layer with a one for the bias."""
    held = main["gate"]
    gate = Gate(held["fc_con"]["bias"].shape[0], "softmax", own_scores="own" in held)
    scores, hidden = cast(
        "tuple[Array, Array]", gate.apply({"params": held}, features, method="scores")
    )
    return scores, jnp.concatenate([hidden, jnp.ones_like(hidden[:, :1])], axis=1)


def gate_curvature(
    config: ModelConfig, main: Params, x: Float[Array, "b k t"]
) -> Float[Array, "h k h k"]:
    r"""Gauss-Newton matrix of the cross entropy in the gate's last layer, summed over a batch.

    .. math::
        G = \sum_n \left(J_n^T \Lambda_n J_n\right) \otimes \tilde h_n \tilde h_n^T, \qquad
        \Lambda = \operatorname{diag} p - p p^T, \quad J = \frac{\partial \ell}{\partial s}

    Symbols: :math:`\tilde h` are the inputs of the layer with a one for the bias, s the scores,
    :math:`\ell` the logits and p their softmax.

    Source: Schraudolph (2002); Daxberger et al. (2021) for the last layer alone.
    """
    scores, inputs = _scores(main, predict(config, main, x).features)

    def head(scores: Float[Array, "b k"]) -> Float[Array, "b c"]:
        given = normalize(scores, config.normalizer)
        return predict(config, main, x, weights=given).logits

    logits, push = jax.linearize(head, scores)
    slopes = push_scores(push, scores)
    p = jax.nn.softmax(logits, axis=-1)
    mean = jnp.einsum("kbc,bc->kb", slopes, p)
    inner = jnp.einsum("kbc,bc,lbc->bkl", slopes, p, slopes) - jnp.einsum("kb,lb->bkl", mean, mean)
    return jnp.einsum("bkl,bi,bj->ikjl", inner, inputs, inputs)


def fit_laplace(
    config: ModelConfig,
    main: Params,
    x: Float[Array, "n k t"],
    *,
    prior: float = 1.0,
    batch_size: int = 256,
) -> LaplaceGate:
    r"""Laplace's approximation of the posterior of the gate's last layer.

    .. math:: \Sigma = \left(G + \sigma_0^{-2} I\right)^{-1}

    Args:
        config, main: a trained network with a learned, deterministic gate.
        x: its training windows, with the failures that it was trained under.
        prior: standard deviation :math:`\sigma_0` of the prior.
        batch_size: rows per chunk of the sum.

    Raises:
        ValueError: no learned gate, a variational one, or a prior that is not positive.

    Source: MacKay (1992); Daxberger et al. (2021).
    """
    check_number("prior", prior, 0.0, above=True, fix="1 is usual")
    check_count("batch_size", batch_size)
    if MODELS[config.model].gate != "learned" or config.variational:
        raise ValueError(
            f"model={config.model!r} with gate_kind={config.gate_kind!r}: expected a learned, "
            "deterministic gate; a variational one has its posterior already"
        )
    curvature = jax.jit(gate_curvature, static_argnums=0)
    total: np.ndarray = np.zeros((1, 1, 1, 1))
    for start in range(0, len(x), batch_size):
        total = total + np.asarray(curvature(config, main, x[start : start + batch_size]), float)
    size = total.shape[0] * total.shape[1]
    precision = total.reshape(size, size) + np.eye(size) / prior**2
    covariance = np.linalg.inv(precision).reshape(total.shape)
    return LaplaceGate(jnp.asarray(covariance, jnp.float32))


def laplace_moments(
    main: Params, laplace: LaplaceGate, features: Float[Array, "k b f"]
) -> tuple[Float[Array, "b k"], Float[Array, "b k k"]]:
    r"""Mean and covariance of the scores: :math:`C_{kl} = \tilde h^T \Sigma_{kl} \tilde h`."""
    scores, inputs = _scores(main, features)
    return scores, jnp.einsum("bi,ikjl,bj->bkl", inputs, laplace.covariance, inputs)


def laplace_predictive(
    config: ModelConfig,
    main: Params,
    laplace: LaplaceGate,
    x: Float[Array, "b k t"],
    available: Bool[Array, "b k"] | None = None,
    *,
    key: Key[Array, ""],
    n_draws: int = DRAWS,
    level: float = 0.9,
) -> Predictive:
    """The mixture over draws of Laplace's Gaussian; arguments as in `sample_predictive`.

    Raises:
        ValueError: a legacy key, a level outside (0, 1).
    """
    keys = draw_keys(n_draws, key=key)
    features = predict(config, main, x, available=available).features
    mean, covariance = laplace_moments(main, laplace, features)
    values, vectors = jnp.linalg.eigh(covariance)
    root = vectors * jnp.sqrt(jnp.maximum(values, 0.0))[:, None, :]

    def weights_of(one: Key[Array, ""]) -> Array:
        noise = jax.random.normal(one, mean.shape, mean.dtype)
        scores = mean + jnp.einsum("bkj,bj->bk", root, noise)
        return normalize(scores, config.normalizer)

    return mix_gates(config, main, x, available, weights_of, keys, level)
