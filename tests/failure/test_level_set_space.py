"""The search space of level sets: about the incumbent, from gradients only."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from failure.search import bayesopt
from failure.search.level_set_space import LEAST, REACH, level_sets_of_gradient, trust_region
from failure.search.methods import BY_VALUES, METHODS, SearchConfig
from failure.search.runs import run
from failure.search.spaces import SPACES, SearchSpace
from failure.search.task import Task, task_domain

DIM = 12
AXES = np.linalg.qr(np.random.default_rng(0).normal(size=(DIM, 2)))[0].T
TASK = Task("ball", 6.0, DIM)


def valley(x: np.ndarray) -> np.ndarray:
    """A boundary that bends in one direction of twelve."""
    return x @ AXES[0] + 0.15 * (x @ AXES[1]) ** 2


def gradient(x: np.ndarray) -> np.ndarray:
    return AXES[0] + 0.3 * (x @ AXES[1])[:, None] * AXES[1]


def search(**change) -> SearchConfig:
    return SearchConfig(TASK, "level_sets", **{"n_init": 10, "n_total": 40, **change})


def test_the_space_lies_about_the_best_evaluation_and_keeps_its_other_features() -> None:
    x = np.random.default_rng(1).normal(size=(1, 20, DIM))
    y = valley(x[0])[None]
    y[0, 3] = np.nan
    train = level_sets_of_gradient(gradient)
    space = train(search(), jax.random.split(jax.random.key(0), 1), x, y)
    one = jax.tree.map(lambda leaf: leaf[0], space)
    assert isinstance(one, SearchSpace) and type(one).__name__ in SPACES
    best = x[0, int(np.nanargmax(y[0]))]
    with jax.enable_x64(True):
        domain = task_domain(TASK)
        middle, clipped = one.decode(domain, jnp.zeros(2))
        moved, _ = one.decode(domain, jnp.array([0.1, -0.05]))
        back = one.encode(moved)
    np.testing.assert_allclose(middle, best, atol=1e-8)
    assert float(np.asarray(clipped)) == 0.0
    np.testing.assert_allclose(back, [0.1, -0.05], atol=1e-8)
    # Both active features together hold what changes the output.
    away = np.asarray(moved) - best
    assert np.linalg.norm(AXES @ away) > 0.7 * np.linalg.norm(away)


def test_the_trust_region_shrinks_while_nothing_better_comes() -> None:
    assert trust_region(np.array([0.0, 1.0]), 3) == REACH
    assert trust_region(np.array([2.0, 1.0, 0.0, 0.0]), 3) == 0.5 * REACH
    assert trust_region(np.array([np.nan, 2.0, *np.zeros(60)]), 3) == LEAST


def test_without_gradients_it_is_refused_at_once() -> None:
    config = search()
    with pytest.raises(ValueError, match="train=None: expected level_set_space"):
        bayesopt.ask(config, bayesopt.init(config))
    assert METHODS["level_sets"].needs_gradient and "level_sets" not in BY_VALUES
    assert "active_subspace" in BY_VALUES
    flat = level_sets_of_gradient(np.zeros_like)
    x = np.ones((1, 4, DIM))
    with pytest.raises(ValueError, match="at least one finite row"):
        flat(config, jax.random.split(jax.random.key(0), 1), x, np.ones((1, 4)))


@pytest.mark.slow
def test_it_climbs_a_valley_that_turns() -> None:
    def simulate(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return valley(x)[:, None], np.zeros(len(x), int)

    state = run(search(), simulate, 0, train=level_sets_of_gradient(gradient))
    # The nearest point of y = 7 lies at 5.7 sigma; the best of the initial design reaches 4.
    assert np.nanmax(state.y) > 7.0
