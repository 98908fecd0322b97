"""The search space of the directions in which the output changes most."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from failure.search.methods import SearchConfig
from failure.search.runs import run
from failure.search.spaces import ActiveSubspace
from failure.search.subspace import active_basis, subspace_of_gradient, train_subspace
from failure.search.task import Task, task_domain

DIM = 20
AXES = np.linalg.qr(np.random.default_rng(0).normal(size=(DIM, 2)))[0].T
TASK = Task("ball", 5.0, DIM)


def ridge(x: np.ndarray) -> np.ndarray:
    """Two directions alone matter, one of them bent."""
    return x @ AXES[0] + 0.3 * (x @ AXES[1]) ** 2


def gradient(x: np.ndarray) -> np.ndarray:
    return AXES[0] + 0.6 * (x @ AXES[1])[:, None] * AXES[1]


def search(**change) -> SearchConfig:
    options = {"n_init": 10, "n_total": 40, "embedding_dim": 2, "retrain_every": 10}
    return SearchConfig(TASK, "active_subspace", **{**options, **change})


def overlap(basis: np.ndarray) -> float:
    """Smallest cosine between the two subspaces; 1 where they are the same."""
    return float(np.linalg.svd(AXES @ basis)[1].min())


def test_gradients_give_the_directions_exactly_whatever_their_unit() -> None:
    x = np.random.default_rng(1).normal(size=(8, DIM))
    for unit in (1e-14, 1.0, 1e10):
        assert overlap(active_basis(unit * gradient(x), 2)) == pytest.approx(1.0)


def test_rows_that_are_not_finite_are_left_out() -> None:
    rows = np.array([[np.nan, 1.0, 0.0], [0.0, 0.0, 2.0]])
    assert active_basis(rows, 1)[:, 0].tolist() == [0.0, 0.0, 1.0]
    assert active_basis(np.full((2, 3), np.nan), 2).tolist() == np.eye(3)[:, :2].tolist()


def test_values_alone_give_nearly_the_directions() -> None:
    x = 1.5 * np.random.default_rng(2).normal(size=(2, 150, DIM))
    y = np.stack([ridge(rows) for rows in x])
    y[0, 3] = np.nan
    with jax.enable_x64(True):
        space = train_subspace(search(seeds=(0, 1)), None, x, y)
    assert space.basis.shape == (2, DIM, 2)
    assert min(overlap(np.asarray(b)) for b in space.basis) > 0.9


def test_points_go_to_parameters_and_back() -> None:
    with jax.enable_x64(True):
        space = ActiveSubspace(jnp.asarray(AXES.T), jnp.asarray(2.0))
        x, clipped = space.decode(task_domain(TASK), jnp.asarray([0.5, -1.0]))
        np.testing.assert_allclose(space.encode(x), [0.5, -1.0], atol=1e-12)
        np.testing.assert_allclose(x, 2.0 * (0.5 * AXES[0] - AXES[1]))
        assert float(clipped) == 0.0


def test_a_search_with_gradients_reaches_the_edge_of_the_ball_and_pays_each_once() -> None:
    seen: list[np.ndarray] = []

    def counted(x: np.ndarray) -> np.ndarray:
        seen.append(x)
        return gradient(x)

    state = run(
        search(), lambda x: (ridge(x)[:, None], np.zeros(len(x))),
        train=subspace_of_gradient(counted),
    )  # fmt: skip
    # On the sphere x0 + 0.3 x1^2 is largest where x0 = 1 / 0.6.
    best = 1.0 / 0.6 + 0.3 * (25.0 - (1.0 / 0.6) ** 2)
    assert state.y.max() > 0.97 * best
    rows = np.concatenate(seen)
    assert len(rows) == len(np.unique(rows, axis=0)) <= 40


def test_a_gradient_of_the_wrong_shape_is_refused() -> None:
    train = subspace_of_gradient(lambda x: np.zeros((len(x), 3)))
    with pytest.raises(ValueError, match=r"gradient.shape=\(10, 3\): expected \(10, 20\)"):
        train(search(), None, np.random.default_rng(0).normal(size=(1, 10, DIM)), np.zeros((1, 10)))
