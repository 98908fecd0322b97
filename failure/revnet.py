"""Reversible network of Equation 4.4: dense drives in the coupling of `fusion.reversible`."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from fusion.reversible.coupling import Coupling, couple, couple_stored, uncouple


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


def _drive_u(size: int, block: RevNetParams, v: Array) -> Array:
    return block.step * _drive(block.k1, block.b1, v, size)


def _drive_v(size: int, block: RevNetParams, u: Array) -> Array:
    return -(block.step * _drive(block.k2, block.b2, u, size))


def _coupling(params: RevNetParams, x: Array) -> Coupling:
    """What the blocks add to halves of the sizes that the input is split into."""
    m = params.k1.shape[-1]
    return Coupling(functools.partial(_drive_u, m), functools.partial(_drive_v, x.shape[-1] - m))


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
    halves = couple_stored(_coupling(params, x), params, *_split(params, x))
    return jnp.concatenate(halves, -1)


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
    halves = couple(_coupling(params, x), params, *_split(params, x))
    return jnp.concatenate(halves, -1)


def inverse(params: RevNetParams, z: Float[Array, "*b d"]) -> Float[Array, "*b d"]:
    r"""Map features back to inputs, :math:`x = g^{-1}(z)`: the blocks undone in reverse order.

    Source: Shim (2020), Eq. 4.5.
    """
    halves = uncouple(_coupling(params, z), params, *_split(params, z))
    return jnp.concatenate(halves, -1)


def inverse_error_bound(params: RevNetParams, x: Float[Array, "n d"]) -> Float[np.ndarray, " n"]:
    r"""How far `inverse(forward(x))` may lie from x in the arithmetic of the weights, at most.

    Undoing a block carries an error on and adds its own rounding:

    .. math:: e_v \leftarrow e_v + L_2 e_u + r_v, \qquad e_u \leftarrow e_u + L_1 e_v + r_u,
        \qquad L_i = h \|K_i\|_2^2

        r_u = \epsilon (|u_n| + |u_{n+1}|) + 2 h \|K_1\|_F \left(\gamma (\|K_1\|_F |v_n| + |b_1|)
        + (\gamma + 2 \epsilon) \sqrt w\right), \quad \gamma = (m + w + 2)\, \epsilon

    and alike for v; :math:`w` is the width, :math:`\epsilon` the spacing of numbers at 1. L is what
    training makes large: the error grows with the product of :math:`(1 + L_1)(1 + L_2)` over the
    blocks, at most; where tanh saturates it is far smaller.

    Args:
        params: weights.
        x: inputs.

    Returns:
        Bound of the Euclidean error of every row.

    Source: Higham (2002), Section 3.1, for :math:`\gamma`.

    Example:
        >>> params, x = init(jax.random.key(0), 6), jnp.ones((1, 6))
        >>> error = jnp.linalg.norm(inverse(params, forward(params, x)) - x)
        >>> bool(error <= inverse_error_bound(params, x)[0] < 1e-4)
        True
    """
    eps = float(jnp.finfo(params.k1.dtype).eps)
    k1, b1, k2, b2, step = (np.asarray(leaf, np.float64) for leaf in params)
    depth, width, m = k1.shape
    gamma = (m + width + 2) * eps

    def drive_error(k: np.ndarray, b: np.ndarray, h: float, size: np.ndarray) -> np.ndarray:
        frobenius = np.linalg.norm(k)
        inside = gamma * (frobenius * size + np.linalg.norm(b))
        return 2.0 * h * frobenius * (inside + (gamma + 2.0 * eps) * width**0.5)

    u, v = _split(params, jnp.asarray(x, params.k1.dtype))
    coupling = _coupling(params, jnp.asarray(x))
    norms = []
    for n in range(depth):
        block = RevNetParams(*(leaf[n] for leaf in params))
        new_u = u + coupling.u(block, v)
        new_v = v + coupling.v(block, new_u)
        norms.append([np.linalg.norm(np.asarray(a, np.float64), axis=1) for a in (u, v)])
        u, v = new_u, new_v
    norms.append([np.linalg.norm(np.asarray(a, np.float64), axis=1) for a in (u, v)])
    error_u = error_v = np.zeros(len(x))
    for n in reversed(range(depth)):
        h = abs(float(step[n]))
        lipschitz1, lipschitz2 = (h * np.linalg.norm(k[n], 2) ** 2 for k in (k1, k2))
        (u0, v0), (u1, v1) = norms[n], norms[n + 1]
        error_v = (
            error_v + lipschitz2 * error_u + eps * (v0 + v1) + drive_error(k2[n], b2[n], h, u1)
        )
        error_u = (
            error_u + lipschitz1 * error_v + eps * (u0 + u1) + drive_error(k1[n], b1[n], h, v0)
        )
    return np.hypot(error_u, error_v)
