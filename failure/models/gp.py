"""Exact Gaussian process on padded data: conditioning, growth by a point, prediction.

Data sit in arrays of a few fixed sizes with a count `n` of the rows that are in use, so that a
search that adds one point per iteration compiles a handful of programs, not hundreds. Everything
is a pure function; call it in float64 (`with jax.enable_x64(True)`), where a Cholesky
factorisation of a 300-point kernel matrix is safe.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from failure.models.kernels import (
    GPConfig,
    GPParams,
    kernel_diagonal,
    kernel_matrix,
    noise_variance,
    noisy_covariance,
    row_mask,
)
from failure.models.triangular import inverse_factor

# A search pads its data to the next of these sizes.
SIZES = (64, 96, 128, 160, 192, 224, 256, 288, 320)


class Posterior(NamedTuple):
    """A conditioned GP: parameters, padded data, `linv` (inverse Cholesky factor), `alpha`."""

    params: GPParams
    x: Array
    y: Array
    n: Array
    linv: Array
    alpha: Array


def padded_size(n: int) -> int:
    """The smallest of the padded sizes that holds `n` points (multiples of 128 above 320).

    Example:
        >>> padded_size(50), padded_size(65), padded_size(330)
        (64, 96, 384)
    """
    for size in SIZES:
        if n <= size:
            return size
    return 128 * math.ceil(n / 128)


def standardize(
    y: Float[Array, " n"], mask: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, ""], Float[Array, ""]]:
    """Masked outputs with mean 0 and standard deviation 1 (n - 1 in the denominator).

    Returns:
        `(standardised y with zeros where masked, mean, standard deviation)`.
    """
    n = jnp.sum(mask)
    mean = jnp.sum(jnp.where(mask > 0, y, jnp.zeros_like(y))) / n
    centred = jnp.where(mask > 0, y - mean, jnp.zeros_like(y))
    sd = jnp.sqrt(jnp.sum(centred**2) / jnp.maximum(n - 1.0, 1.0))
    # Constant data: any positive scale gives the same all-zero targets. The test is relative, so
    # that femtoamperes are as good as volts.
    sd = jnp.where(sd > 1e-12 * jnp.abs(mean), sd, jnp.ones_like(sd))
    return centred / sd, mean, sd


def condition(
    config: GPConfig,
    params: GPParams,
    x: Float[Array, "n d"],
    y: Float[Array, " n"],
    n: Int[Array, ""],
) -> Posterior:
    """Condition on the first `n` rows by a full factorisation."""
    mask = row_mask(x, n)
    k = kernel_matrix(config, params, x, x)
    linv, _ = inverse_factor(noisy_covariance(k, noise_variance(config, params), mask))
    alpha = (linv @ ((y - params.mean) * mask)) @ linv
    return Posterior(params, x, y, n, linv, alpha)


def append(
    config: GPConfig,
    posterior: Posterior,
    x_new: Float[Array, " d"],
    y: Float[Array, " n"],
) -> Posterior:
    r"""Add one point with the hyper-parameters held: rank-one growth of the inverse factor.

    .. math::
        l = L^{-1} k, \quad \lambda^2 = k(x, x) + \sigma^2 - l^\top l, \quad
        L^{-1}_{n+1} = \begin{pmatrix} L^{-1} & 0 \\ -l^\top L^{-1} / \lambda & 1 / \lambda
        \end{pmatrix}

    Quadratic in `n`, where a new factorisation is cubic.

    Args:
        config: kernel and priors.
        posterior: the GP on `n` points.
        x_new: the new input.
        y: all outputs, re-standardised, the new one in row `n`.

    Returns:
        The GP on `n + 1` points.
    """
    params, n, linv = posterior.params, posterior.n, posterior.linv
    mask = row_mask(posterior.x, n)
    k = kernel_matrix(config, params, posterior.x, x_new[None])[:, 0] * mask
    row = linv @ k
    noise = noise_variance(config, params)
    pivot2 = kernel_diagonal(config, params, x_new[None])[0] + noise - row @ row
    pivot = jnp.sqrt(jnp.maximum(pivot2, 0.5 * noise))
    new_row = (-(row @ linv) / pivot).at[n].set(1.0 / pivot)
    linv = linv.at[n].set(new_row)
    x = posterior.x.at[n].set(x_new)
    white = linv @ ((y - params.mean) * row_mask(x, n + 1))
    return Posterior(params, x, y, n + 1, linv, white @ linv)


def predict(
    config: GPConfig, posterior: Posterior, x: Float[Array, "m d"]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and variance of the noise-free function (Rasmussen and Williams, Algorithm 2.1)."""
    k = kernel_matrix(config, posterior.params, posterior.x, x)
    k = k * row_mask(posterior.x, posterior.n)[:, None]
    mean = posterior.params.mean + posterior.alpha @ k
    white = posterior.linv @ k
    variance = kernel_diagonal(config, posterior.params, x) - jnp.sum(white * white, 0)
    return mean, jnp.maximum(variance, 1e-12)
