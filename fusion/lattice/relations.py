"""Constraints between inputs of a lattice, as inequalities between its vertices.

Every constraint here is a set of rows: a weighted sum of a few vertices that may not be negative.
What such a row says of the vertices it says of the interpolated function at every point.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from fusion.lattice.checks import refusal

Sizes = tuple[int, ...]
_Row = dict[tuple[int, ...], int]


class Relation(NamedTuple):
    """One constraint between some inputs, the same for every position of the others.

    `name`, `value`: the option and its entry; `axes`: the inputs; `places` and `weights`
    `[n_rows, n_terms]`: the weighted sums of the flattened vertices of these inputs that may not be
    negative; `slack` `[n_rows]`: what half a step of rounding in each vertex can take from a row.
    """

    name: str
    value: tuple[Any, ...]
    axes: tuple[int, ...]
    places: np.ndarray
    weights: np.ndarray
    slack: np.ndarray


def _relation(
    name: str, value: tuple, axes: tuple[int, ...], shape: Sizes, rows: Iterable[_Row]
) -> Relation:
    """Rows without repetitions, padded to one length with terms of weight 0."""
    terms: dict[frozenset, _Row] = {}
    for row in rows:
        kept = {at: weight for at, weight in row.items() if weight}
        if kept:
            terms.setdefault(frozenset(kept.items()), kept)
    places = np.zeros((len(terms), max(map(len, terms))), np.int32)
    weights = np.zeros(places.shape)
    for i, kept in enumerate(terms.values()):
        places[i, : len(kept)] = [int(np.ravel_multi_index(at, shape)) for at in kept]
        weights[i, : len(kept)] = list(kept.values())
    return Relation(name, value, axes, places, weights, 0.25 * np.abs(weights).sum(axis=1))


def _row(*terms: tuple[tuple[int, ...], int]) -> _Row:
    """A row from terms, some of which may be of the same vertex."""
    row: _Row = {}
    for at, weight in terms:
        row[at] = row.get(at, 0) + weight
    return row


def _cells(shape: Sizes) -> Iterable[tuple[int, int]]:
    return itertools.product(range(shape[0] - 1), range(shape[1] - 1))


def _inputs(name: str, value: Any, rank: int, form: str, *, directed: bool) -> tuple[int, int, int]:
    """Two different inputs and, if `directed`, -1 or 1."""
    good = isinstance(value, tuple) and len(value) == 2 + directed
    good = good and all(isinstance(v, int) and not isinstance(v, bool) for v in value)
    if (
        not good
        or not all(0 <= axis < rank for axis in value[:2])
        or value[0] == value[1]
        or (directed and value[2] not in (-1, 1))
    ):
        last = " and direction -1 or 1" if directed else ""
        raise refusal(
            name, value, f"{form} with two different inputs of 0..{rank - 1}{last}",
            "name inputs by their position",
        )  # fmt: skip
    return value if directed else (*value, 1)


def edgeworth_trust(name: str, value: Any, sizes: Sizes, signs: np.ndarray) -> Relation:
    r"""The slope in the main input `m` grows (+1) or shrinks (-1) with the conditional input `c`.

    .. math:: \theta_{v+e_m+e_c} - \theta_{v+e_c} \ge \theta_{v+e_m} - \theta_v

    Source: Cotter et al. (2019), Shape constraints for set functions.
    """
    form = "(main, conditional, direction)"
    main, conditional, d = _inputs(name, value, len(sizes), form, directed=True)
    shape = (sizes[main], sizes[conditional])
    rows = (
        _row(((i + 1, j + 1), d), ((i, j), d), ((i + 1, j), -d), ((i, j + 1), -d))
        for i, j in _cells(shape)
    )
    return _relation(name, value, (main, conditional), shape, rows)


def trapezoid_trust(name: str, value: Any, sizes: Sizes, signs: np.ndarray) -> Relation:
    r"""The range of outputs over the main input `m` widens with the conditional input `c`.

    .. math:: \theta_{v + e_c} \le \theta_v \;\text{where } v_m \text{ is at its low end}, \qquad
        \theta_{v + e_c} \ge \theta_v \;\text{where it is at its high end}

    for direction +1: the range at `v` lies within the range at :math:`v + e_c`. The low end is
    that with the lower outputs: vertex 0 of a rising input, the last one of a falling input. Where
    the conditional input is monotone, too, outputs no longer depend on it at one of the two ends.

    Source: Cotter et al. (2019), Shape constraints for set functions; the definition of
    TensorFlow Lattice's `trapezoid_trusts`.
    """
    form = "(main, conditional, direction)"
    main, conditional, d = _inputs(name, value, len(sizes), form, directed=True)
    if signs[main] == 0:
        raise refusal(
            name, value, f"a monotone main input, not the free input {main}",
            f"set monotonicity of input {main} to -1 or 1",
        )  # fmt: skip
    shape = (sizes[main], sizes[conditional])
    low, high = (0, shape[0] - 1)[:: int(signs[main])]
    rows = [
        row
        for j in range(shape[1] - 1)
        for row in (
            _row(((low, j), d), ((low, j + 1), -d)),
            _row(((high, j + 1), d), ((high, j), -d)),
        )
    ]
    return _relation(name, value, (main, conditional), shape, rows)


def _dominant(
    name: str, value: Any, sizes: Sizes, signs: np.ndarray
) -> tuple[int, int, Sizes, Callable[[int, int], tuple[int, int]]]:
    """The pair, its sizes, and vertices counted in the direction in which outputs rise."""
    strong, weak, _ = _inputs(name, value, len(sizes), "(dominant, weak)", directed=False)
    for axis in (strong, weak):
        if signs[axis] == 0:
            raise refusal(
                name, value, f"two monotone inputs, not the free input {axis}",
                f"set monotonicity of input {axis} to -1 or 1",
            )  # fmt: skip
    shape = (sizes[strong], sizes[weak])

    def at(i: int, j: int) -> tuple[int, int]:
        return (
            i if signs[strong] > 0 else shape[0] - 1 - i,
            j if signs[weak] > 0 else shape[1] - 1 - j,
        )

    return strong, weak, shape, at


def dominance(name: str, value: Any, sizes: Sizes, signs: np.ndarray) -> Relation:
    r"""The slope in the dominant input `a` is at least as steep as that in the weak input `b`.

    .. math:: 2\,\theta_{v+e_a} \ge \theta_v + \theta_{v+e_a+e_b}, \qquad
        2\,\theta_{v+e_b} \le \theta_v + \theta_{v+e_a+e_b}

    with vertices counted in the directions in which outputs rise. Slopes are per vertex.

    Source: Gupta et al. (2020), Multidimensional shape constraints; TensorFlow Lattice's
    `monotonic_dominances`.
    """
    strong, weak, shape, at = _dominant(name, value, sizes, signs)
    rows = [
        row
        for i, j in _cells(shape)
        for row in (
            _row((at(i + 1, j), 2), (at(i, j), -1), (at(i + 1, j + 1), -1)),
            _row((at(i, j), 1), (at(i + 1, j + 1), 1), (at(i, j + 1), -2)),
        )
    ]
    return _relation(name, value, (strong, weak), shape, rows)


def range_dominance(name: str, value: Any, sizes: Sizes, signs: np.ndarray) -> Relation:
    r"""The range of outputs over the dominant input `a` is at least that over the weak input `b`.

    .. math:: \theta_{v:\,v_a = \text{high}} - \theta_{v:\,v_a = \text{low}} \ge
        \theta_{v:\,v_b = \text{high}} - \theta_{v:\,v_b = \text{low}}

    at every vertex `v`.

    Source: Gupta et al. (2020), Multidimensional shape constraints; TensorFlow Lattice's
    `range_dominances`.
    """
    strong, weak, shape, at = _dominant(name, value, sizes, signs)
    top = (shape[0] - 1, shape[1] - 1)
    rows = (
        _row((at(top[0], j), 1), (at(0, j), -1), (at(i, top[1]), -1), (at(i, 0), 1))
        for i, j in itertools.product(range(shape[0]), range(shape[1]))
    )
    return _relation(name, value, (strong, weak), shape, rows)


def joint_monotonicity(name: str, value: Any, sizes: Sizes, signs: np.ndarray) -> Relation:
    r"""Outputs rise (+1) or fall (-1) where inputs `a` and `b` grow by the same amount.

    .. math:: \theta_{v+e_a} + \theta_{v+e_b} \ge 2\,\theta_v, \qquad
        2\,\theta_{v+e_a+e_b} \ge \theta_{v+e_a} + \theta_{v+e_b}

    for direction +1: the sum of the two slopes, at both ends of the diagonal of each cell.

    Source: Gupta et al. (2020), Multidimensional shape constraints; TensorFlow Lattice's
    `joint_monotonicities`, which rise.
    """
    form = "(first, second, direction)"
    first, second, d = _inputs(name, value, len(sizes), form, directed=True)
    shape = (sizes[first], sizes[second])
    rows = [
        row
        for i, j in _cells(shape)
        for row in (
            _row(((i + 1, j), d), ((i, j + 1), d), ((i, j), -2 * d)),
            _row(((i + 1, j + 1), 2 * d), ((i + 1, j), -d), ((i, j + 1), -d)),
        )
    ]
    return _relation(name, value, (first, second), shape, rows)


def joint_unimodality(name: str, value: Any, sizes: Sizes, signs: np.ndarray) -> Relation:
    r"""Outputs rise (+1, a valley) or fall (-1, a peak) along every ray from the middle vertex.

    .. math:: \sum_d (v_d - m_d)\, o_d\, (\theta_{v + o_d e_d} - \theta_v) \ge 0, \qquad
        m_d = \lfloor n_d / 2 \rfloor

    for direction +1, at every vertex `v` and towards each cell around it, whose directions are
    :math:`o_d = \pm 1`; :math:`n_d` is the number of vertices of input `d` of the group.

    Source: Gupta et al. (2020), Multidimensional shape constraints; TensorFlow Lattice's
    `joint_unimodalities`.
    """
    rank = len(sizes)
    good = isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], tuple)
    axes = value[0] if good else ()
    if (
        not good
        or value[1] not in (-1, 1)
        or len(set(axes)) != len(axes)
        or len(axes) < 2
        or not all(isinstance(a, int) and 0 <= a < rank for a in axes)
    ):
        raise refusal(
            name, value, f"((inputs), direction) with two or more different inputs of 0..{rank - 1}"
            " and direction -1 or 1", "name inputs by their position",
        )  # fmt: skip
    for axis in axes:
        if signs[axis] or sizes[axis] < 3:
            raise refusal(
                name, value, f"free inputs of 3 or more vertices; input {axis} has "
                f"{sizes[axis]} and monotonicity {signs[axis]}", "change one of the two",
            )  # fmt: skip
    shape = tuple(sizes[axis] for axis in axes)
    rows = []
    for v in itertools.product(*map(range, shape)):
        for offsets in itertools.product((-1, 1), repeat=len(axes)):
            away = [at - size // 2 for at, size in zip(v, shape, strict=True)]
            terms = []
            for d, (far, offset) in enumerate(zip(away, offsets, strict=True)):
                there = tuple(at + offset * (k == d) for k, at in enumerate(v))
                weight = value[1] * far * offset
                terms += [(there, weight), (v, -weight)] if far else []
            if all(0 <= at < shape[k] for there, _ in terms for k, at in enumerate(there)):
                rows.append(_row(*terms))
    made = _relation(name, value, axes, shape, rows)
    # Weights that are no powers of two round once more for each of the inputs.
    return made._replace(slack=made.slack * len(axes))


BUILDERS: dict[str, Callable[[str, Any, Sizes, np.ndarray], Relation]] = {
    "edgeworth_trust": edgeworth_trust,
    "trapezoid_trust": trapezoid_trust,
    "dominance": dominance,
    "range_dominance": range_dominance,
    "joint_monotonicity": joint_monotonicity,
    "joint_unimodality": joint_unimodality,
}
"""Option of a `LatticeConfig` -> what makes rows of one of its entries."""
