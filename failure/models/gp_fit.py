"""Evidence and MAP fit of the GP: priors, closed-form gradient, warm-started BFGS."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from failure.models.domains import box
from failure.models.kernels import (
    GPConfig,
    GPParams,
    kernel_matrix,
    noise_variance,
    noisy_covariance,
    profile,
    row_mask,
    squared_distance,
)
from failure.models.optimize import bfgs
from failure.models.triangular import gram_of_lower, inverse_factor

_LOG_2PI = math.log(2.0 * math.pi)


class FitResult(NamedTuple):
    """Fitted parameters, the objective reached (per data point) and what a warm start needs."""

    params: GPParams
    value: Float[Array, ""]
    hessian_inverse: Float[Array, "d1 d1"]
    n_evals: Int[Array, ""]
    converged: Array


def initial_params(config: GPConfig, dim: int) -> GPParams:
    """The mode of the priors, from which a cold fit starts."""
    loc, scale = config.lengthscale_prior
    loc = loc + 0.5 * math.log(dim)
    noise_loc, noise_scale = config.noise_prior
    noise = max(math.exp(noise_loc - noise_scale**2), 2.0 * config.min_noise)
    # A dtype of their own: a weak one is another type than a fit returns, and would have the fit
    # compiled a second time when it goes on from its own result.
    dtype = jnp.result_type(float)
    return GPParams(
        log_lengthscale=jnp.full((dim,), loc - scale**2, dtype),
        log_noise=jnp.asarray(math.log(noise - config.min_noise), dtype),
        mean=jnp.zeros((), dtype),
    )


def log_marginal_likelihood(
    config: GPConfig,
    params: GPParams,
    x: Float[Array, "n d"],
    y: Float[Array, " n"],
    n: Int[Array, ""],
) -> Float[Array, ""]:
    r"""Log evidence of the first `n` rows.

    .. math::
        \log p(y) = -\tfrac12 (y - m)^\top K_y^{-1} (y - m) - \tfrac12 \log |K_y|
        - \tfrac n2 \log 2\pi

    with :math:`K_y = K + \sigma^2 I`. Source: Rasmussen and Williams (2006), Equation 2.30.
    """
    mask = row_mask(x, n)
    k = kernel_matrix(config, params, x, x)
    linv, log_det = inverse_factor(noisy_covariance(k, noise_variance(config, params), mask))
    white = linv @ ((y - params.mean) * mask)
    return -0.5 * (white @ white + log_det + jnp.sum(mask) * _LOG_2PI)


def _log_normal(value: Array, loc: float, scale: float) -> Array:
    z = (jnp.log(value) - loc) / scale
    return -jnp.log(value) - 0.5 * z**2 - math.log(scale) - 0.5 * _LOG_2PI


def log_prior(config: GPConfig, params: GPParams) -> Float[Array, ""]:
    """Log density of the log-normal priors of the lengthscales and of the noise variance."""
    dim = params.log_lengthscale.shape[0]
    loc, scale = config.lengthscale_prior
    lengthscale = jnp.exp(params.log_lengthscale)
    log_p = jnp.sum(_log_normal(lengthscale, loc + 0.5 * math.log(dim), scale))
    return log_p + _log_normal(noise_variance(config, params), *config.noise_prior)


def map_objective(
    config: GPConfig,
    params: GPParams,
    x: Float[Array, "n d"],
    y: Float[Array, " n"],
    n: Int[Array, ""],
) -> Float[Array, ""]:
    """Log posterior density of the hyper-parameters, up to a constant, per data point."""
    log_p = log_marginal_likelihood(config, params, x, y, n) + log_prior(config, params)
    return log_p / n.astype(x.dtype)


def map_value_and_grad(
    config: GPConfig,
    theta: Float[Array, " d1"],
    x: Float[Array, "n d"],
    y: Float[Array, " n"],
    n: Int[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, " d1"], Float[Array, ""]]:
    r"""Negative MAP objective, its gradient and the best constant mean, in closed form.

    .. math::
        \partial_\theta \log p = \tfrac12 \mathrm{tr}\,
        \big((\alpha \alpha^\top - K_y^{-1}) \, \partial_\theta K_y\big)

    The derivative along all lengthscales costs two matrix products, since
    :math:`\sum_{ij} G_{ij} (s_{ik} - s_{jk})^2` expands into row sums of `G` and `G s`. The
    mean is profiled out, so it adds no term to the gradient (envelope theorem).

    Args:
        config: kernel and priors.
        theta: `[log_lengthscale, log_noise]`.
        x: inputs, padded.
        y: standardised outputs, padded.
        n: rows in use.

    Returns:
        `(-map_objective, gradient, mean)`.

    Source: Rasmussen and Williams (2006), Equation 5.9.
    """
    dim = x.shape[1]
    count = n.astype(x.dtype)
    params = GPParams(theta[:dim], theta[dim], jnp.zeros((), x.dtype))
    mask = row_mask(x, n)
    noise = noise_variance(config, params)
    s = x * jnp.exp(-params.log_lengthscale)[None, :]
    if config.kernel == "linear":
        k = s @ s.T
        slope = jnp.ones_like(k)
    else:
        k, slope = profile(config.kernel, squared_distance(s, s))
    linv, log_det = inverse_factor(noisy_covariance(k, noise, mask))
    white_one, white_y = linv @ mask, linv @ (y * mask)
    mean = (white_one @ white_y) / (white_one @ white_one)
    white = white_y - mean * white_one
    alpha = white @ linv
    log_p = -0.5 * (white @ white + log_det + count * _LOG_2PI)
    inner = alpha[:, None] * alpha[None, :] - gram_of_lower(linv)
    weight = inner * slope * (mask[:, None] * mask[None, :])
    weighted = jnp.sum(s * (weight @ s), 0)
    if config.kernel == "linear":
        grad_lengthscale = -weighted
    else:
        grad_lengthscale = 2.0 * (weighted - jnp.sum(weight, 1) @ (s * s))
    grad_noise = 0.5 * jnp.sum(jnp.diagonal(inner) * mask) * jnp.exp(params.log_noise)
    prior, prior_grad = jax.value_and_grad(lambda p: log_prior(config, p))(params)
    grad = jnp.concatenate(
        [grad_lengthscale + prior_grad.log_lengthscale, (grad_noise + prior_grad.log_noise)[None]]
    )
    return -(log_p + prior) / count, -grad / count, mean


def fit(
    config: GPConfig,
    start: GPParams,
    x: Float[Array, "n d"],
    y: Float[Array, " n"],
    n: Int[Array, ""],
    hessian_inverse: Float[Array, "d1 d1"] | None = None,
    fresh: Bool[Array, ""] | None = None,
    *,
    max_evals: int = 200,
    gtol: float = 1e-4,
    ftol: float = 1e-7,
) -> FitResult:
    """Maximise the MAP objective from `start` (and from the curvature of an earlier fit).

    Args:
        config: kernel and priors.
        start: parameters of the last fit, or `initial_params`.
        x: inputs, padded.
        y: standardised outputs, padded.
        n: rows in use.
        hessian_inverse: of the last fit; two or three evaluations then often do.
        fresh: see `failure.models.optimize.bfgs`.
        max_evals: evaluations at most.
        gtol: gradient tolerance of the per-point objective.
        ftol: relative gain below which two steps in a row end the fit.

    Returns:
        FitResult; `value` is the MAP objective per data point.
    """
    dim = x.shape[1]
    theta = jnp.concatenate([start.log_lengthscale, start.log_noise[None]])
    wide = jnp.full((dim + 1,), 16.0, x.dtype)
    domain = box(-wide, wide)

    end = bfgs(
        lambda t: map_value_and_grad(config, t, x, y, n),
        theta,
        domain,
        max_evals=max_evals,
        hessian_inverse=hessian_inverse,
        fresh=fresh,
        max_move=2.0,
        gtol=gtol,
        ftol=ftol,
    )
    params = GPParams(end.x[:dim], end.x[dim], end.aux)
    return FitResult(params, -end.value, end.hessian_inverse, end.n_evals, end.converged)
