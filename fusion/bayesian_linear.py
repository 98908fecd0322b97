"""Bayesian linear regression with several outputs: a conditional density in closed form."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key


class LinearPosterior(NamedTuple):
    """Conjugate linear regression: `mean [i+1, o]`, `covariance [i+1, i+1]`, noise `[o]`."""

    mean: Array
    covariance: Array
    noise_variance: Array


def _design(x: Array) -> Array:
    return jnp.concatenate([x, jnp.ones((x.shape[0], 1), x.dtype)], 1)


def fit_linear(
    x: Float[Array, "n i"],
    y: Float[Array, "m o"],
    *,
    prior_variance: float = 1.0,
    iterations: Int[Array, ""] | int = 20,
) -> LinearPosterior:
    r"""Conjugate Bayesian linear regression with the noise set by evidence iterations.

    .. math::
        S = (\Phi^\top \Phi / \sigma^2 + I / \tau^2)^{-1}, \qquad M = S \Phi^\top Y / \sigma^2

    one noise level per output for reporting; the covariance uses their mean.

    Args:
        x: inputs.
        y: targets.
        prior_variance: :math:`\tau^2`.
        iterations: updates of :math:`\sigma^2` by MacKay's effective number of parameters.

    Raises:
        ValueError: rows of `x` and `y` differ, or fewer than 2.

    Source: Bishop (2006), Equations 3.53, 3.54 and 3.95.
    """
    if x.shape[0] != y.shape[0] or x.shape[0] < 2:
        raise ValueError(
            f"y.shape[0]={y.shape[0]}: expected the {x.shape[0]} rows of x, at least 2; give one "
            "target for each input"
        )
    phi = _design(x)
    n = phi.shape[0]
    gram, cross = phi.T @ phi, phi.T @ y
    values, vectors = jnp.linalg.eigh(gram)
    values = jnp.maximum(values, 0.0)
    rotated = vectors.T @ cross

    def solve(noise: Array) -> tuple[Array, Array]:
        shrink = 1.0 / (values + noise / prior_variance)
        return vectors @ (shrink[:, None] * rotated), shrink

    def update(_: Array, noise: Array) -> Array:
        mean, shrink = solve(noise)
        effective = jnp.sum(values * shrink)
        residual = jnp.mean(jnp.sum((y - phi @ mean) ** 2, 0))
        return jnp.maximum(residual / jnp.maximum(n - effective, 1.0), 1e-12)

    noise = jax.lax.fori_loop(0, iterations, update, jnp.mean(jnp.var(y, 0)) + 1e-12)
    mean, shrink = solve(noise)
    covariance = noise * (vectors * shrink[None]) @ vectors.T
    per_output = jnp.mean((y - phi @ mean) ** 2, 0)
    return LinearPosterior(mean, covariance, per_output)


def predict_linear(
    posterior: LinearPosterior, x: Float[Array, "n i"]
) -> tuple[Float[Array, "n o"], Float[Array, " n"]]:
    """Mean and variance (noise-free) of the linear baseline (Bishop 2006, Equation 3.58)."""
    phi = _design(x)
    return phi @ posterior.mean, jnp.sum((phi @ posterior.covariance) * phi, 1)


def sample_linear(
    posterior: LinearPosterior, x: Float[Array, "n i"], n_samples: int, *, key: Key[Array, ""]
) -> Float[Array, "s n o"]:
    """Draw linear functions from the posterior."""
    phi = _design(x)
    p, n_out = posterior.mean.shape
    eye = jnp.eye(p, dtype=phi.dtype)
    factor = jnp.linalg.cholesky(posterior.covariance + 1e-9 * eye)
    noise = jax.random.normal(key, (n_samples, p, n_out), phi.dtype)
    weights = posterior.mean[None] + jnp.einsum("ij,sjo->sio", factor, noise)
    return jnp.einsum("np,spo->sno", phi, weights)
