"""Crystals: pairs that act on each other are found, and land in one lattice."""

from __future__ import annotations

import doctest
import itertools
from typing import Any

import numpy as np
import pytest

from fusion.lattice import crystals as module
from fusion.lattice.crystals import crystals, twists

RNG = np.random.default_rng(0)
X = RNG.normal(size=(600, 6)) * np.array([1.0, 10.0, 0.1, 1.0, 5.0, 1.0])
Z = X / X.std(axis=0)
Y = Z[:, 0] * Z[:, 4] + 0.8 * Z[:, 1] * Z[:, 2] - 0.6 * Z[:, 3] * Z[:, 5] + 2 * Z[:, 0]


def test_the_twist_is_that_of_a_bilinear_function() -> None:
    # Even ranks in a full grid: y = 3 u0 u1 + u0 has the coefficient 3 but for the ridge.
    u = np.stack(np.meshgrid(np.arange(20), np.arange(20)), axis=-1).reshape(-1, 2) / 19 - 0.5
    rank = (np.round((u + 0.5) * 19) * 20 + 9.5) / 399 - 0.5
    found = twists(u, 3 * rank[:, 0] * rank[:, 1] + rank[:, 0])
    shrunk = 3 * (rank[:, 0] ** 2).mean() ** 2 / ((rank[:, 0] ** 2).mean() ** 2 + module.RIDGE)
    assert found[0, 1] == pytest.approx(shrunk**2, rel=1e-6)


def test_monotone_changes_of_units_change_nothing() -> None:
    np.testing.assert_allclose(twists(np.exp(Z), Y), twists(X, Y), rtol=1e-9)


def test_pairs_that_act_together_share_a_lattice() -> None:
    assert crystals(X, Y, n_lattices=3, rank=2) == ((0, 4), (1, 2), (3, 5))
    wide = crystals(X, Y, n_lattices=2, rank=4, seed=3)
    shared = {pair for subset in wide for pair in itertools.combinations(subset, 2)}
    assert {(0, 4), (1, 2), (3, 5)} <= shared
    assert set(itertools.chain(*wide)) == set(range(6))


def test_no_choice_of_subsets_is_better_for_few_inputs() -> None:
    gain = twists(X, Y)
    best = max(
        sum(gain[pair] for pair in (order[:2], order[2:4], order[4:]))
        for order in itertools.permutations(range(6))
    )
    found = crystals(X, Y, n_lattices=3, rank=2, seed=5)
    assert sum(gain[pair] for pair in found) == pytest.approx(best)


@pytest.mark.parametrize(
    ("x", "y", "message"),
    [
        (X[:, 0], Y, "expected .N, D. and .N."),
        (X, Y[:-1], "expected .N, D. and .N."),
        (np.where(X > 2, np.nan, X), Y, "expected finite numbers"),
    ],
)
def test_what_does_not_fit_is_refused(x: Any, y: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        twists(x, y)


def test_examples_run() -> None:
    assert doctest.testmod(module).failed == 0
