"""Projection onto rows of inequalities between the vertices of a lattice."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fusion.lattice.relations import Relation


def _front(v: Array, axes: tuple[int, ...]) -> Array:
    """`[*sizes]` as `[vertices of axes, all others]`."""
    moved = jnp.moveaxis(v, axes, range(len(axes)))
    return moved.reshape(int(np.prod(moved.shape[: len(axes)])), -1)


def _back(flat: Array, axes: tuple[int, ...], shape: tuple[int, ...]) -> Array:
    """Undo `_front`."""
    rest = [size for axis, size in enumerate(shape) if axis not in axes]
    moved = flat.reshape(*(shape[axis] for axis in axes), *rest)
    return jnp.moveaxis(moved, range(len(axes)), axes)


def _sums(flat: Array, places: np.ndarray, weights: np.ndarray) -> Array:
    """The weighted sum of each row, `[n_rows, others]`."""
    return jnp.sum(flat[places] * jnp.asarray(weights[..., None], flat.dtype), axis=1)


def shortfall(relation: Relation, v: Float[Array, "*sizes"]) -> Float[Array, "n_rows n_others"]:
    """What each row lacks, negative where it holds with room to spare.

    Args:
        relation: the rows.
        v: vertices.

    Returns:
        Minus the weighted sums, for each row and each position of the other inputs.
    """
    return -_sums(_front(v, relation.axes), relation.places, relation.weights)


def _groups(relation: Relation) -> list[list[int]]:
    """Rows in as few groups as a greedy choice finds, no vertex twice in a group."""
    groups: list[tuple[list[int], set[int]]] = []
    for row, (places, weights) in enumerate(zip(relation.places, relation.weights, strict=True)):
        own = set(places[weights != 0].tolist())
        for rows, taken in groups:
            if not own & taken:
                rows.append(row)
                taken |= own
                break
        else:
            groups.append(([row], own))
    return [rows for rows, _ in groups]


def half_spaces(
    relation: Relation,
) -> list[Callable[[Float[Array, "*sizes"]], Float[Array, "*sizes"]]]:
    """Euclidean projections onto the rows; those that share no vertex are projected at once.

    Args:
        relation: the rows.

    Returns:
        Functions from vertices to vertices, for Dykstra's algorithm.
    """
    return [_group(relation, rows) for rows in _groups(relation)]


def _group(relation: Relation, rows: list[int]) -> Callable[[Array], Array]:
    places, weights = relation.places[rows], relation.weights[rows]
    gain = weights / np.sum(weights**2, axis=1, keepdims=True)

    def project(v: Array) -> Array:
        flat = _front(v, relation.axes)
        # Each vertex is moved by one row of the group at most.
        owner = np.zeros(flat.shape[0], np.int32)
        share = np.zeros(flat.shape[0])
        for i, (at, part) in enumerate(zip(places, gain, strict=True)):
            owner[at[part != 0]], share[at[part != 0]] = i, part[part != 0]
        lack = jnp.maximum(-_sums(flat, places, weights), 0.0)
        flat = flat + jnp.asarray(share[:, None], v.dtype) * lack[owner]
        return _back(flat, relation.axes, v.shape)

    return project
