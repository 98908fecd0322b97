"""A lattice inside all of its constraints, and the vertices that they force to be equal.

A point inside is what an exact repair steps towards, and what rounding needs: there every
inequality has room to spare.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fusion.lattice.relations import Relation

# What an ordered pair of neighbours keeps, in the unit of `Relation.slack`.
ORDER_SLACK = 0.5


class Interior(NamedTuple):
    """`vertices` `[*sizes]`: a lattice inside, from 0 upwards; `ties` `[*sizes]`: a number for each
    class of vertices that constraints force to be equal, or None where there are none."""

    vertices: np.ndarray
    ties: np.ndarray | None


def interior(
    sizes: tuple[int, ...], steps: Sequence[np.ndarray], relations: Sequence[Relation]
) -> Interior | None:
    """A lattice inside all constraints, as low as can be.

    Every row exceeds 0 by its `slack`, every ordered pair of neighbours differs by 1/2, but for
    those between tied vertices. Inputs that no constraint connects add up, so that only connected
    ones take a linear programme.

    Args:
        sizes: of the lattice.
        steps: for each input and each step from a vertex to the next -1 (falls), 0 or 1 (rises).
        relations: the constraints between inputs.

    Returns:
        Interior, or None where the constraints leave no such lattice.
    """
    vertices, ties, tied = np.zeros(sizes), np.zeros(sizes, np.int64), False
    for axes in _connected(len(sizes), relations):
        own = tuple(sizes[axis] for axis in axes)
        if len(axes) == 1:
            part = np.concatenate([[0.0], np.cumsum(ORDER_SLACK * steps[axes[0]])])
            part, classes = part - part.min(), np.arange(own[0])
        else:
            found = _lowest(
                own,
                [steps[axis] for axis in axes],
                [
                    relation._replace(axes=tuple(axes.index(axis) for axis in relation.axes))
                    for relation in relations
                    if set(relation.axes) <= set(axes)
                ],
            )
            if found is None:
                return None
            part, classes = found
            tied = tied or classes.max() + 1 < classes.size
        others = tuple(axis for axis in range(len(sizes)) if axis not in axes)
        vertices = vertices + np.expand_dims(part, others)
        ties = ties * (classes.max() + 1) + np.expand_dims(classes, others)
    return Interior(vertices, ties if tied else None)


def _connected(rank: int, relations: Sequence[Relation]) -> list[list[int]]:
    """Sets of inputs that constraints connect, each in increasing order."""
    parts = [{axis} for axis in range(rank)]
    for relation in relations:
        touched = [part for part in parts if part & set(relation.axes)]
        parts = [part for part in parts if part not in touched] + [set().union(*touched)]
    return [sorted(part) for part in parts]


def _table(
    sizes: tuple[int, ...], steps: Sequence[np.ndarray], relations: Sequence[Relation]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """All inequalities: row, vertex and weight of each term, and the slack of each row."""
    index = np.arange(int(np.prod(sizes))).reshape(sizes)
    places, weights, slack = [], [], []
    for axis, signs in enumerate(steps):
        along = np.moveaxis(index, axis, 0)
        for i in np.flatnonzero(signs):
            pairs = np.stack([along[i].ravel(), along[i + 1].ravel()], axis=1)
            places.append(pairs)
            weights.append(np.broadcast_to([-1.0 * signs[i], signs[i]], pairs.shape))
            slack.append(np.full(len(pairs), ORDER_SLACK))
    for relation in relations:
        front = np.moveaxis(index, relation.axes, range(len(relation.axes)))
        table = front.reshape(-1, index.size // int(np.prod([sizes[a] for a in relation.axes])))
        terms = relation.places.shape[1]
        places.append(table[relation.places].swapaxes(1, 2).reshape(-1, terms))
        weights.append(np.repeat(relation.weights, table.shape[1], axis=0))
        slack.append(np.repeat(relation.slack, table.shape[1]))
    start, rows = 0, []
    for block in places:
        rows.append(np.repeat(np.arange(start, start + len(block)), block.shape[1]))
        start += len(block)
    flat = [np.concatenate([np.ravel(block) for block in part]) for part in (places, weights)]
    return np.concatenate(rows), flat[0], flat[1], np.concatenate(slack)


def _lowest(
    sizes: tuple[int, ...], steps: Sequence[np.ndarray], relations: Sequence[Relation]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Lattice >= 0 with its slack in every row and the least highest vertex; classes of ties."""
    from scipy.optimize import linprog
    from scipy.sparse import coo_array, eye_array, hstack, vstack
    from scipy.sparse.csgraph import connected_components

    rows, places, weights, slack = _table(sizes, steps, relations)
    n = int(np.prod(sizes))
    table = coo_array((weights, (rows, places)), shape=(len(slack), n)).tocsr()
    table.eliminate_zeros()
    # Vertices that orders lead from to each other and back are equal.
    pairs = np.flatnonzero((np.diff(table.indptr) == 2) & (np.abs(table.sum(axis=1)) < 1e-9))
    terms = table.indptr[pairs][:, None] + np.arange(2)
    low = np.argsort(table.data[terms], axis=1)
    ends = np.take_along_axis(table.indices[terms], low, axis=1)
    graph = coo_array((np.ones(len(pairs)), (ends[:, 0], ends[:, 1])), shape=(n, n))
    count, classes = connected_components(graph, directed=True, connection="strong")
    member = coo_array((np.ones(n), (np.arange(n), classes)), shape=(n, count)).tocsr()
    table = table @ member
    table.data[np.abs(table.data) < 1e-9] = 0.0
    table.eliminate_zeros()
    open_rows = np.flatnonzero(np.diff(table.indptr))
    # The last unknown is the highest vertex, which is to be low.
    above = hstack([-eye_array(count), coo_array(np.ones((count, 1)))])
    inside = hstack([table[open_rows], coo_array(np.zeros((len(open_rows), 1)))])
    found = linprog(
        np.eye(1, count + 1, count)[0],
        A_ub=-vstack([inside, above]).tocsr(),
        b_ub=-np.concatenate([slack[open_rows], np.zeros(count)]),
        method="highs",
    )
    if found.status == 2:
        return None
    if not found.success:
        raise RuntimeError(f"no lattice inside the constraints was found: {found.message}")
    return found.x[:-1][classes].reshape(sizes), classes.astype(np.int64).reshape(sizes)
