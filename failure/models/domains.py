"""Feasible sets: a box, a ball, or the box of a ball; projection and uniform points."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key


class Domain(NamedTuple):
    """The set `lower <= x <= upper`, `|x| <= radius` (infinite bounds switch a part off)."""

    lower: Array
    upper: Array
    radius: Array


def box(lower: Float[Array, " d"], upper: Float[Array, " d"]) -> Domain:
    """A box."""
    return Domain(lower, upper, jnp.full((), jnp.inf, lower.dtype))


def ball(dim: int, radius: float) -> Domain:
    """A ball around the origin."""
    limit = jnp.full((dim,), jnp.inf)
    return Domain(-limit, limit, jnp.asarray(radius, limit.dtype))


def project(domain: Domain, x: Float[Array, " d"]) -> Float[Array, " d"]:
    """Clip to the box, then shrink radially into the ball."""
    x = jnp.clip(x, domain.lower, domain.upper)
    # The floor keeps the derivative of the root finite at the origin.
    norm = jnp.sqrt(jnp.maximum(x @ x, 1e-30))
    # An infinite radius must not be divided: the slope of the branch not taken would be 0 inf.
    bounded = jnp.isfinite(domain.radius)
    radius = jnp.where(bounded, domain.radius, jnp.ones_like(domain.radius))
    shrink = jnp.minimum(jnp.ones_like(norm), radius / norm)
    return x * jnp.where(bounded, shrink, jnp.ones_like(norm))


def sample(domain: Domain, n: int, *, key: Key[Array, ""]) -> Float[Array, "n d"]:
    """Uniform points of the box, or of the ball where its radius is finite."""
    dim = domain.lower.shape[0]
    key_box, key_ball, key_radius = jax.random.split(key, 3)
    dtype = domain.lower.dtype
    width = domain.upper - domain.lower

    def in_box() -> Array:
        return domain.lower[None] + width[None] * jax.random.uniform(key_box, (n, dim), dtype)

    def in_ball() -> Array:
        normal = jax.random.normal(key_ball, (n, dim), dtype)
        share = jax.random.uniform(key_radius, (n, 1), dtype) ** (1.0 / dim)
        return domain.radius * share * normal / jnp.linalg.norm(normal, axis=-1, keepdims=True)

    points = jax.lax.cond(jnp.isfinite(domain.radius), in_ball, in_box)
    return jax.vmap(project, (None, 0))(domain, points)
