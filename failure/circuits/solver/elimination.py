"""Sparse elimination of a batch: minimum-degree order, no pivoting, unrolled when it is traced."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from failure.circuits.solver.system import System

Entries = dict[tuple[int, int], Array]


def add_entry(entries: Entries, i: int, j: int, value: Array) -> None:
    """Add to an entry of a sparse matrix in place."""
    entries[i, j] = entries[i, j] + value if (i, j) in entries else value


def eliminate(system: System, entries: Entries, rhs: Float[Array, "n b"]) -> Float[Array, "n b"]:
    """Solve the sparse system for one right-hand side, batch last, without pivoting.

    Args:
        system: gives the order.
        entries: `(i, j) -> [b]`.
        rhs: right-hand sides.
    Returns:
        Solution `[n, b]`.
    Deviation: LU with partial pivoting is safer; nodal matrices with gmin on the diagonal do not
        need it here, and a small pivot shows up as a sample that does not converge.
    """
    a = dict(entries)
    b = [rhs[i] for i in range(system.n)]
    done: set[int] = set()
    inverse: dict[int, Array] = {}
    for p in system.order:
        done.add(p)
        below = sorted(i for (i, j) in a if j == p and i not in done)
        right = sorted(j for (i, j) in a if i == p and j not in done)
        inverse[p] = 1.0 / a[p, p]
        for i in below:
            factor = a[i, p] * inverse[p]
            for j in right:
                add_entry(a, i, j, -factor * a[p, j])
            b[i] = b[i] - factor * b[p]
    x: dict[int, Array] = {}
    position = {p: k for k, p in enumerate(system.order)}
    for p in reversed(system.order):
        value = b[p]
        for j in sorted(j for (i, j) in a if i == p and position[j] > position[p]):
            value = value - a[p, j] * x[j]
        x[p] = value * inverse[p]
    return jnp.stack([x[i] for i in range(system.n)])
