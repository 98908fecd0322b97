"""Searches side by side: the same results as alone, one batch a round, errors reach the caller."""

from __future__ import annotations

import numpy as np
import pytest

from failure.search import runs
from failure.search.bayesopt import SearchConfig
from failure.search.sharing import side_by_side
from failure.search.task import Task

METHODS = ("monte_carlo", "ridge_corner", "gradient_corner")


def sphere(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.sum((x - 0.3) ** 2, axis=1, keepdims=True), np.zeros(len(x))


def config(method: str, n_total: int = 12) -> SearchConfig:
    task = Task("ball", 2.0, 3)
    return SearchConfig(task, method, seeds=(0, 1), n_init=5, n_total=n_total)


def test_the_same_searches_as_alone(tmp_path) -> None:
    sizes: list[int] = []

    def counted(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sizes.append(len(x))
        return sphere(x)

    searches = [
        lambda s, m=m: runs.run(config(m), s, folder=tmp_path / m).y  # type: ignore[misc]
        for m in METHODS
    ]
    together = side_by_side(searches, counted, multiple=8)
    for method, y in zip(METHODS, together, strict=True):
        np.testing.assert_array_equal(y, runs.run(config(method), sphere).y)
    assert all(size % 8 == 0 for size in sizes)
    alone: list[int] = []
    for method in METHODS:
        runs.run(config(method), lambda x: (alone.append(len(x)), sphere(x))[1])
    assert len(sizes) < len(alone)


def test_searches_of_different_lengths_end() -> None:
    searches = [
        lambda s, n=n: runs.run(config("ridge_corner", n), s).n  # type: ignore[misc]
        for n in (6, 9, 12)
    ]
    assert side_by_side(searches, sphere) == [6, 9, 12]


def test_an_error_of_one_search_reaches_the_caller_after_the_others() -> None:
    ended = []

    def bad(simulate) -> None:
        simulate(np.zeros((1, 3)))
        raise RuntimeError("this search")

    def good(simulate) -> None:
        for _ in range(3):
            simulate(np.ones((2, 3)))
        ended.append(True)

    with pytest.raises(RuntimeError, match="this search"):
        side_by_side([bad, good], sphere)
    assert ended == [True]


def test_an_error_of_the_simulator_reaches_the_caller() -> None:
    def broken(x: np.ndarray) -> None:
        raise OSError("no licence")

    with pytest.raises(OSError, match="no licence"):
        side_by_side([lambda s: s(np.zeros((1, 3)))], broken)


def test_a_point_that_raises_leaves_the_points_of_other_searches_alone() -> None:
    def picky(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if np.any(x[:, 0] > 1.2):
            raise np.linalg.LinAlgError("singular matrix")
        return sphere(x)

    searches = [lambda s, m=m: runs.run(config(m), s) for m in METHODS]  # type: ignore[misc]
    some = 0
    for state in side_by_side(searches, picky, multiple=8):
        bad = state.x[..., 0] > 1.2
        np.testing.assert_array_equal(np.isnan(state.y), bad)
        some += int(bad.sum())
    assert some > 0


def test_answers_that_belong_to_no_point_are_an_error_of_the_program() -> None:
    search = lambda s: runs.run(config("ridge_corner"), s)  # noqa: E731
    with pytest.raises(ValueError, match=r"1 rows of specs and 1 of status: expected at least 20"):
        side_by_side([search, search], lambda x: (np.zeros((1, 1)), np.zeros(1)))
    with pytest.raises(ValueError, match=r"simulate: .*: expected \(specs \[n, m\], status"):
        side_by_side([search, search], lambda x: None)  # type: ignore[arg-type,return-value]


def test_bad_input() -> None:
    assert side_by_side([], sphere) == []
    with pytest.raises(ValueError, match="multiple=0"):
        side_by_side([lambda s: s(np.zeros((1, 3)))], sphere, multiple=0)
