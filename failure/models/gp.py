"""Exact Gaussian process on padded data: kernels, conditioning, growth by a point, prediction.

Data sit in arrays of a few fixed sizes with a count `n` of the rows that are in use, so that a
search that adds one point per iteration compiles a handful of programs, not hundreds. Everything
is a pure function; call it in float64 (`with jax.enable_x64(True)`), where a Cholesky
factorisation of a 300-point kernel matrix is safe.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

__all__ = [
    "KERNELS",
    "GPConfig",
    "GPParams",
    "Posterior",
    "append",
    "condition",
    "kernel_matrix",
    "padded_size",
    "predict",
    "standardize",
]

KERNELS = ("matern52", "rbf", "linear")

# A search pads its data to the next of these sizes.
SIZES = (64, 96, 128, 160, 192, 224, 256, 288, 320)


@dataclass(frozen=True)
class GPConfig:
    """Choices of the surrogate: kernel, noise floor and priors.

    The lengthscale prior is LogNormal(sqrt(2) + log(d) / 2, sqrt(3)) and the noise prior
    LogNormal(-4, 1), both on the values themselves (no Jacobian): Hvarfner et al. (2024).
    """

    kernel: str = "matern52"
    min_noise: float = 1e-4
    noise_prior: tuple[float, float] = (-4.0, 1.0)
    lengthscale_prior: tuple[float, float] = (math.sqrt(2.0), math.sqrt(3.0))

    def __post_init__(self) -> None:
        """Refuse an unknown kernel and a noise floor that a Cholesky factor cannot stand."""
        if self.kernel not in KERNELS:
            raise ValueError(f"kernel={self.kernel!r}: expected one of {', '.join(KERNELS)}")
        if not self.min_noise > 0.0:
            raise ValueError(
                f"min_noise={self.min_noise}: expected a positive variance (1e-6 is the least "
                "that keeps the factorisation of a noise-free data set stable)"
            )


class GPParams(NamedTuple):
    """Hyper-parameters: `log_lengthscale [d]`, `log_noise` and `mean`.

    The noise variance is `exp(log_noise) + min_noise`, so it never leaves its range.
    """

    log_lengthscale: Array
    log_noise: Array
    mean: Array


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
    # Constant data: any positive scale gives the same all-zero targets.
    sd = jnp.where(sd > 1e-12 * (1.0 + jnp.abs(mean)), sd, jnp.ones_like(sd))
    return centred / sd, mean, sd


def _squared_distance(a: Array, b: Array) -> Array:
    """Pairwise squared distances by one matrix product; never negative."""
    norm_a, norm_b = jnp.sum(a * a, -1), jnp.sum(b * b, -1)
    return jnp.maximum(norm_a[:, None] + norm_b[None, :] - 2.0 * (a @ b.T), 0.0)


def _profile(kernel: str, r2: Array) -> tuple[Array, Array]:
    """Kernel value and derivative with respect to the squared scaled distance."""
    if kernel == "rbf":
        k = jnp.exp(-0.5 * r2)
        return k, -0.5 * k
    # The floor keeps the derivative of the square root finite at distance zero.
    root = jnp.sqrt(5.0 * jnp.maximum(r2, 1e-30))
    decay = jnp.exp(-root)
    return (1.0 + root + (5.0 / 3.0) * r2) * decay, -(5.0 / 6.0) * (1.0 + root) * decay


def kernel_matrix(
    config: GPConfig,
    params: GPParams,
    a: Float[Array, "n d"],
    b: Float[Array, "m d"],
) -> Float[Array, "n m"]:
    r"""Covariance of the noise-free function at two sets of points.

    .. math::
        k(r) = (1 + \sqrt5 r + \tfrac53 r^2) e^{-\sqrt5 r}, \quad
        r^2 = \sum_k (a_k - b_k)^2 / \ell_k^2

    for Matern-5/2; :math:`e^{-r^2/2}` for `rbf`; :math:`\sum_k a_k b_k / \ell_k^2` for
    `linear`. Signal variance is 1: the targets are standardised.

    Source: Rasmussen and Williams (2006), Equations 4.17, 4.9 and 4.29.
    """
    scale = jnp.exp(-params.log_lengthscale)[None, :]
    a, b = a * scale, b * scale
    if config.kernel == "linear":
        return a @ b.T
    return _profile(config.kernel, _squared_distance(a, b))[0]


def _diagonal(config: GPConfig, params: GPParams, x: Array) -> Array:
    if config.kernel == "linear":
        return jnp.sum((x * jnp.exp(-params.log_lengthscale)[None, :]) ** 2, -1)
    return jnp.ones_like(x[:, 0])


def _noise(config: GPConfig, params: GPParams) -> Array:
    return jnp.exp(params.log_noise) + config.min_noise


def _mask(x: Array, n: Array) -> Array:
    return (jnp.arange(x.shape[0], dtype=n.dtype) < n).astype(x.dtype)


def _covariance(k: Array, noise: Array, mask: Array) -> Array:
    """Noisy covariance of the rows in use; padded rows are those of the identity."""
    return k * (mask[:, None] * mask[None, :]) + jnp.diag(noise * mask + (1.0 - mask))


def _invert_lower(factor: Array) -> Array:
    """Inverse of a lower triangle, by halves: what is known to be zero is not multiplied."""
    n = factor.shape[0]
    if n <= 64 or n % 2:
        eye = jnp.eye(n, dtype=factor.dtype)
        return jax.scipy.linalg.solve_triangular(factor, eye, lower=True)
    half = n // 2
    first, last = _invert_lower(factor[:half, :half]), _invert_lower(factor[half:, half:])
    low = -(last @ (factor[half:, :half] @ first))
    return jnp.block([[first, jnp.zeros_like(low.T)], [low, last]])


def _gram_of_lower(linv: Array) -> Array:
    """`linv.T @ linv` of a lower triangle, by halves."""
    n = linv.shape[0]
    if n <= 64 or n % 2:
        return linv.T @ linv
    half = n // 2
    first, low, last = linv[:half, :half], linv[half:, :half], linv[half:, half:]
    cross = low.T @ last
    return jnp.block(
        [[_gram_of_lower(first) + low.T @ low, cross], [cross.T, _gram_of_lower(last)]]
    )


def _inverse_factor(covariance: Array) -> tuple[Array, Array]:
    """Inverse Cholesky factor and log determinant."""
    # The matrix is symmetric: to symmetrise it again, or to turn it into LAPACK's column order,
    # takes strided passes over it that cost as much as the factorisation. Its transpose is in
    # that order already.
    factor = jax.lax.linalg.cholesky(covariance.T, symmetrize_input=False)
    return _invert_lower(factor), 2.0 * jnp.sum(jnp.log(jnp.diagonal(factor)))


def condition(
    config: GPConfig,
    params: GPParams,
    x: Float[Array, "n d"],
    y: Float[Array, " n"],
    n: Int[Array, ""],
) -> Posterior:
    """Condition on the first `n` rows by a full factorisation."""
    mask = _mask(x, n)
    k = kernel_matrix(config, params, x, x)
    linv, _ = _inverse_factor(_covariance(k, _noise(config, params), mask))
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
    mask = _mask(posterior.x, n)
    k = kernel_matrix(config, params, posterior.x, x_new[None])[:, 0] * mask
    row = linv @ k
    noise = _noise(config, params)
    pivot2 = _diagonal(config, params, x_new[None])[0] + noise - row @ row
    pivot = jnp.sqrt(jnp.maximum(pivot2, 0.5 * noise))
    new_row = (-(row @ linv) / pivot).at[n].set(1.0 / pivot)
    linv = linv.at[n].set(new_row)
    x = posterior.x.at[n].set(x_new)
    white = linv @ ((y - params.mean) * _mask(x, n + 1))
    return Posterior(params, x, y, n + 1, linv, white @ linv)


def predict(
    config: GPConfig, posterior: Posterior, x: Float[Array, "m d"]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Mean and variance of the noise-free function (Rasmussen and Williams, Algorithm 2.1)."""
    k = kernel_matrix(config, posterior.params, posterior.x, x)
    k = k * _mask(posterior.x, posterior.n)[:, None]
    mean = posterior.params.mean + posterior.alpha @ k
    white = posterior.linv @ k
    variance = _diagonal(config, posterior.params, x) - jnp.sum(white * white, 0)
    return mean, jnp.maximum(variance, 1e-12)
