"""Reversible network: coupling blocks in a scan, an exact inverse, a constant-memory gradient."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key


class RevNetParams(NamedTuple):
    """Weights of `depth` blocks, stacked on the leading axis; `m = ceil(D / 2)`.

    Attributes:
        k1: `[depth, width, m]`, drives `u`.
        b1: `[depth, width]`.
        k2: `[depth, width, m]`, drives `v`.
        b2: `[depth, width]`.
        step: `[depth]`, the time step h of every block.
    """

    k1: Array
    b1: Array
    k2: Array
    b2: Array
    step: Array


def init(
    key: Key[Array, ""],
    dim: int,
    *,
    depth: int = 8,
    width: int | None = None,
    step: float = 0.25,
    scale: float = 0.5,
    dtype: Any = None,
) -> RevNetParams:
    """Random weights, small enough that the map starts near the identity.

    Args:
        key: random key.
        dim: D, the number of inputs (odd or even).
        depth: N, the number of blocks.
        width: rows of K; `ceil(D / 2)` (square K) without.
        step: h.
        scale: standard deviation of the entries of K times `sqrt(m)`.
        dtype: of the weights; the default float without.

    Raises:
        ValueError: fewer than two inputs, or no block.
    """
    if dim < 2:
        raise ValueError(f"dim={dim}: a coupling network needs at least 2 inputs to split")
    if depth < 1:
        raise ValueError(f"depth={depth}: expected at least 1 block")
    m = (dim + 1) // 2
    width = m if width is None else width
    key1, key2 = jax.random.split(key)
    sd = scale / m**0.5
    k1 = sd * jax.random.normal(key1, (depth, width, m), dtype)
    k2 = sd * jax.random.normal(key2, (depth, width, m), dtype)
    zeros = jnp.zeros((depth, width), k1.dtype)
    return RevNetParams(k1, zeros, k2, zeros, jnp.full((depth,), step, k1.dtype))


def _drive(k: Array, b: Array, x: Array, size: int) -> Array:
    r""":math:`K^\top \sigma(K x + b)`; `x` is padded and the result cut for an odd split."""
    m = k.shape[-1]
    if x.shape[-1] < m:
        x = jnp.concatenate([x, jnp.zeros((*x.shape[:-1], m - x.shape[-1]), x.dtype)], -1)
    hidden = jnp.tanh(x @ k.T + jnp.broadcast_to(b, (*x.shape[:-1], b.shape[-1])))
    return (hidden @ k)[..., :size]


def _block(block: RevNetParams, u: Array, v: Array) -> tuple[Array, Array]:
    u = u + block.step * _drive(block.k1, block.b1, v, u.shape[-1])
    v = v - block.step * _drive(block.k2, block.b2, u, v.shape[-1])
    return u, v


def _unblock(block: RevNetParams, u: Array, v: Array) -> tuple[Array, Array]:
    v = v + block.step * _drive(block.k2, block.b2, u, v.shape[-1])
    u = u - block.step * _drive(block.k1, block.b1, v, u.shape[-1])
    return u, v


def _split(params: RevNetParams, x: Array) -> tuple[Array, Array]:
    m = params.k1.shape[-1]
    dim = x.shape[-1]
    if (dim + 1) // 2 != m:
        raise ValueError(
            f"input of {dim} dimensions for a network of {2 * m - 1} or {2 * m}; "
            "initialise it with dim equal to the input's last axis"
        )
    return x[..., :m], x[..., m:]


def forward_stored(params: RevNetParams, x: Float[Array, "*b d"]) -> Float[Array, "*b d"]:
    """`forward` with JAX's own reverse rule, which stores every block's activations."""
    (u, v), _ = jax.lax.scan(lambda c, block: (_block(block, *c), None), _split(params, x), params)
    return jnp.concatenate([u, v], -1)


@jax.custom_vjp
def forward(params: RevNetParams, x: Float[Array, "*b d"]) -> Float[Array, "*b d"]:
    r"""Map inputs to features, :math:`z = g(x)`.

    .. math::
        u_{n+1} = u_n + h K_{n,1}^\top \sigma(K_{n,1} v_n + b_{n,1}), \qquad
        v_{n+1} = v_n - h K_{n,2}^\top \sigma(K_{n,2} u_{n+1} + b_{n,2})

    with :math:`x = (u_0, v_0)`, :math:`z = (u_N, v_N)` and :math:`\sigma = \tanh`. The gradient
    recomputes the activations backwards through the inverse, so its memory does not grow with
    the depth.

    Args:
        params: weights; :math:`h` is `params.step`.
        x: inputs, any leading axes.

    Returns:
        z, with the shape of `x`.

    Source: Shim (2020), Eq. 4.4 and 4.5; Gomez et al. (2017) for the reverse rule.
    Deviation: for odd D, `u` has one entry more than `v`; `v` is padded with a zero inside
    K and the surplus entry of its update is dropped, which keeps the map invertible on R^D.

    Example:
        >>> params = init(jax.random.key(0), 5)
        >>> x = jnp.arange(5.0)
        >>> bool(jnp.allclose(inverse(params, forward(params, x)), x, atol=1e-5))
        True
    """
    return forward_stored(params, x)


def inverse(params: RevNetParams, z: Float[Array, "*b d"]) -> Float[Array, "*b d"]:
    r"""Map features back to inputs, :math:`x = g^{-1}(z)`: the blocks undone in reverse order.

    Source: Shim (2020), Eq. 4.5.
    """
    (u, v), _ = jax.lax.scan(
        lambda c, block: (_unblock(block, *c), None), _split(params, z), params, reverse=True
    )
    return jnp.concatenate([u, v], -1)


def _forward_rule(params: RevNetParams, x: Array) -> tuple[Array, tuple[RevNetParams, Array]]:
    z = forward_stored(params, x)
    return z, (params, z)


def _backward_rule(kept: tuple[RevNetParams, Array], grad_z: Array) -> tuple[RevNetParams, Array]:
    params, z = kept

    def undo(
        carry: tuple[Array, Array, Array, Array], block: RevNetParams
    ) -> tuple[tuple[Array, Array, Array, Array], RevNetParams]:
        u, v, grad_u, grad_v = carry
        u, v = _unblock(block, u, v)
        _, pull = jax.vjp(_block, block, u, v)
        grad_block, grad_u, grad_v = pull((grad_u, grad_v))
        return (u, v, grad_u, grad_v), grad_block

    start = (*_split(params, z), *_split(params, grad_z))
    (_, _, grad_u, grad_v), grads = jax.lax.scan(undo, start, params, reverse=True)
    return grads, jnp.concatenate([grad_u, grad_v], -1)


forward.defvjp(_forward_rule, _backward_rule)
