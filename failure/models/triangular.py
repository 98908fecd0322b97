"""Triangular factors by halves: what is known to be zero is not multiplied."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array


def invert_lower(factor: Array) -> Array:
    """Inverse of a lower triangle, by halves: what is known to be zero is not multiplied."""
    n = factor.shape[0]
    if n <= 64 or n % 2:
        eye = jnp.eye(n, dtype=factor.dtype)
        return jax.scipy.linalg.solve_triangular(factor, eye, lower=True)
    half = n // 2
    first, last = invert_lower(factor[:half, :half]), invert_lower(factor[half:, half:])
    low = -(last @ (factor[half:, :half] @ first))
    return jnp.block([[first, jnp.zeros_like(low.T)], [low, last]])


def gram_of_lower(linv: Array) -> Array:
    """`linv.T @ linv` of a lower triangle, by halves."""
    n = linv.shape[0]
    if n <= 64 or n % 2:
        return linv.T @ linv
    half = n // 2
    first, low, last = linv[:half, :half], linv[half:, :half], linv[half:, half:]
    cross = low.T @ last
    return jnp.block([[gram_of_lower(first) + low.T @ low, cross], [cross.T, gram_of_lower(last)]])


def inverse_factor(covariance: Array) -> tuple[Array, Array]:
    """Inverse Cholesky factor and log determinant."""
    # The matrix is symmetric: to symmetrise it again, or to turn it into LAPACK's column order,
    # takes strided passes over it that cost as much as the factorisation. Its transpose is in
    # that order already.
    factor = jax.lax.linalg.cholesky(covariance.T, symmetrize_input=False)
    return invert_lower(factor), 2.0 * jnp.sum(jnp.log(jnp.diagonal(factor)))
