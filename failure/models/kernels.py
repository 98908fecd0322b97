"""Covariance of a Gaussian process: its configuration, the kernels, the rows in use."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

KERNELS = ("matern52", "rbf", "linear")


@dataclass(frozen=True)
class GPConfig:
    """Choices of the surrogate: kernel, noise floor and priors.

    The lengthscale prior is LogNormal(sqrt(2) + log(d) / 2, sqrt(3)) and the noise prior
    LogNormal(-4, 1), both on the values themselves (no Jacobian): Hvarfner et al. (2024).

    Raises:
        ValueError: an unknown kernel, a prior without a positive scale, a noise floor that is not
            positive.

    Example:
        >>> GPConfig(kernel="rbf").min_noise
        0.0001
    """

    kernel: str = "matern52"
    min_noise: float = 1e-4
    noise_prior: tuple[float, float] = (-4.0, 1.0)
    lengthscale_prior: tuple[float, float] = (math.sqrt(2.0), math.sqrt(3.0))

    def __post_init__(self) -> None:
        """Refuse an unknown kernel and a noise floor that a Cholesky factor cannot stand."""
        if self.kernel not in KERNELS:
            raise ValueError(f"kernel={self.kernel!r}: expected one of {', '.join(KERNELS)}")
        for name in ("noise_prior", "lengthscale_prior"):
            _, scale = getattr(self, name)
            if not scale > 0.0:
                raise ValueError(
                    f"{name}={getattr(self, name)}: expected (location, scale) of a log-normal "
                    "density with a positive scale"
                )
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


def squared_distance(a: Array, b: Array) -> Array:
    """Pairwise squared distances by one matrix product; never negative."""
    norm_a, norm_b = jnp.sum(a * a, -1), jnp.sum(b * b, -1)
    return jnp.maximum(norm_a[:, None] + norm_b[None, :] - 2.0 * (a @ b.T), 0.0)


def profile(kernel: str, r2: Array) -> tuple[Array, Array]:
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
    return profile(config.kernel, squared_distance(a, b))[0]


def kernel_diagonal(config: GPConfig, params: GPParams, x: Array) -> Array:
    """Prior variance of the noise-free function at the rows of `x`, `[n]`."""
    if config.kernel == "linear":
        return jnp.sum((x * jnp.exp(-params.log_lengthscale)[None, :]) ** 2, -1)
    return jnp.ones_like(x[:, 0])


def noise_variance(config: GPConfig, params: GPParams) -> Array:
    """The noise variance that belongs to the unbounded parameter."""
    return jnp.exp(params.log_noise) + config.min_noise


def row_mask(x: Array, n: Array) -> Array:
    """One for the first `n` rows, zero for the padding."""
    return (jnp.arange(x.shape[0], dtype=n.dtype) < n).astype(x.dtype)


def noisy_covariance(k: Array, noise: Array, mask: Array) -> Array:
    """Noisy covariance of the rows in use; padded rows are those of the identity."""
    return k * (mask[:, None] * mask[None, :]) + jnp.diag(noise * mask + (1.0 - mask))
