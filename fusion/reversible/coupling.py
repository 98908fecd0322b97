"""Additive coupling: blocks that can be undone, and gradients that recompute instead of store.

What the blocks add is the caller's: `fusion.reversible.blocks` adds convolutions of the other half,
`failure.revnet` the dense layers of Equation 4.4.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Float

Blocks = Any
"""Parameters of all blocks: a tree whose leaves have the depth as leading axis."""
Drive = Callable[[Any, Array], Array]
"""`drive(block, other)`: what one block adds to a half, from the other half."""
Halves = tuple[Array, Array]


class Coupling(NamedTuple):
    """What a block adds to each half: `u` from v, then `v` from the new u."""

    u: Drive
    v: Drive


def _block(coupling: Coupling, block: Any, u: Array, v: Array) -> Halves:
    u = u + coupling.u(block, v)
    return u, v + coupling.v(block, u)


def _unblock(coupling: Coupling, block: Any, u: Array, v: Array) -> Halves:
    v = v - coupling.v(block, u)
    return u - coupling.u(block, v), v


def couple_stored(
    coupling: Coupling, blocks: Blocks, u: Float[Array, "*a"], v: Float[Array, "*b"]
) -> tuple[Float[Array, "*a"], Float[Array, "*b"]]:
    """`couple` with JAX's own reverse rule, which stores the activations of every block."""
    (u, v), _ = jax.lax.scan(lambda c, block: (_block(coupling, block, *c), None), (u, v), blocks)
    return u, v


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def couple(
    coupling: Coupling, blocks: Blocks, u: Float[Array, "*a"], v: Float[Array, "*b"]
) -> tuple[Float[Array, "*a"], Float[Array, "*b"]]:
    r"""Run all blocks of an additive coupling.

    .. math:: u_{n+1} = u_n + F_n(v_n), \qquad v_{n+1} = v_n + G_n(u_{n+1})

    The gradient undoes the blocks one by one and recomputes their activations on the way, so that
    its memory does not grow with the depth; it computes each drive once more. It can be
    differentiated once, and in reverse only; `couple_stored` knows no such limit.

    Args:
        coupling: F and G.
        blocks: parameters of the blocks, stacked.
        u, v: the halves, of any shapes that F and G take.

    Returns:
        The halves after the last block.

    Source: Dinh et al. (2015), NICE, for the coupling; Gomez et al. (2017) for the gradient.

    Example:
        >>> import jax.numpy as jnp
        >>> turn = Coupling(lambda w, v: w * jnp.tanh(v), lambda w, u: -w * jnp.tanh(u))
        >>> w, x = jnp.array([0.5, 0.3]), jnp.array([1.0, 2.0])
        >>> u, v = couple(turn, w, x[:1], x[1:])
        >>> [round(float(half[0]), 5) for half in uncouple(turn, w, u, v)]
        [1.0, 2.0]
    """
    return couple_stored(coupling, blocks, u, v)


def uncouple(
    coupling: Coupling, blocks: Blocks, u: Float[Array, "*a"], v: Float[Array, "*b"]
) -> tuple[Float[Array, "*a"], Float[Array, "*b"]]:
    r"""The inverse of `couple`: the blocks undone from the last to the first.

    .. math:: v_n = v_{n+1} - G_n(u_{n+1}), \qquad u_n = u_{n+1} - F_n(v_n)
    """
    (u, v), _ = jax.lax.scan(
        lambda c, block: (_unblock(coupling, block, *c), None), (u, v), blocks, reverse=True
    )
    return u, v


def _forward_rule(
    coupling: Coupling, blocks: Blocks, u: Array, v: Array
) -> tuple[Halves, tuple[Blocks, Halves]]:
    end = couple_stored(coupling, blocks, u, v)
    return end, (blocks, end)


def _backward_rule(
    coupling: Coupling, kept: tuple[Blocks, Halves], slopes: Halves
) -> tuple[Blocks, Array, Array]:
    blocks, end = kept

    def undo(carry: tuple[Halves, Halves], block: Any) -> tuple[tuple[Halves, Halves], Any]:
        (u, v), (slope_u, slope_v) = carry
        # Each drive is computed once, for the inverse and for its own gradient.
        drive, pull = jax.vjp(coupling.v, block, u)
        v = v - drive
        own, more = pull(slope_v)
        slope_u = slope_u + more
        drive, pull = jax.vjp(coupling.u, block, v)
        u = u - drive
        other, more = pull(slope_u)
        slope = jax.tree.map(lambda a, b: a + b, own, other)
        return ((u, v), (slope_u, slope_v + more)), slope

    ((_, _), (slope_u, slope_v)), grads = jax.lax.scan(undo, (end, slopes), blocks, reverse=True)
    return grads, slope_u, slope_v


couple.defvjp(_forward_rule, _backward_rule)
