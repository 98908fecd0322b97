"""Sparse elimination of a batch: minimum-degree order, no pivoting, unrolled when it is traced."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from failure.circuits.solver.system import System

Entries = dict[tuple[int, int], Array]


def add_entry(entries: Entries, i: int, j: int, value: Array) -> None:
    """Add to an entry of a sparse matrix in place."""
    entries[i, j] = entries[i, j] + value if (i, j) in entries else value


def full_matrix(
    system: System, entries: Entries | Float[Array, "n n b"], batch: int
) -> Float[Array, "n n b"]:
    """The matrix with its zeros."""
    if not isinstance(entries, dict):
        return entries
    zero = jnp.zeros((batch,), next(iter(entries.values())).dtype)
    rows = [entries.get((i, j), zero) for i in range(system.n) for j in range(system.n)]
    return jnp.stack(rows).reshape(system.n, system.n, batch)


def eliminate_full(
    system: System, matrix: Float[Array, "n n b"], rhs: Float[Array, "n b"]
) -> Float[Array, "n b"]:
    """The same as `eliminate` on the full matrix, row by row: a short program."""
    order = np.asarray(system.order)
    a, b = matrix[order][:, order], rhs[order]
    rows: list[tuple[Array, Array, Array]] = []
    for _ in range(system.n):
        inverse = 1.0 / a[0, 0]
        rows.append((inverse, a[0, 1:], b[0]))
        factor = a[1:, 0] * inverse[None]
        a, b = a[1:, 1:] - factor[:, None] * a[0, 1:][None], b[1:] - factor * b[:1]
    x = rhs[:0]
    for inverse, row, value in reversed(rows):
        x = jnp.concatenate([((value - jnp.sum(row * x, axis=0)) * inverse)[None], x])
    return x[np.argsort(order)]


def eliminate(
    system: System, entries: Entries | Float[Array, "n n b"], rhs: Float[Array, "n b"]
) -> Float[Array, "n b"]:
    """Solve the sparse system for one right-hand side, batch last, without pivoting.

    Args:
        system: gives the order.
        entries: `(i, j) -> [b]`, or the matrix.
        rhs: right-hand sides.
    Returns:
        Solution `[n, b]`.
    Deviation: LU with partial pivoting is safer; nodal matrices with gmin on the diagonal do not
        need it here, and a small pivot shows up as a sample that does not converge.
    """
    if not isinstance(entries, dict):
        return eliminate_full(system, entries, rhs)
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
