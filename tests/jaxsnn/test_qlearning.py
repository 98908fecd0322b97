"""Tabular Q-learning: the table's rows, the update, bookkeeping of trials, and that it learns."""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import maps, qlearning, world

run = jax.jit(qlearning.run_trials, static_argnames=("n_trials", "max_steps", "learn"))
N, TRIALS, STEPS = 8, 60, 60


def reading(sonar: list[float], distance: float, angle: float) -> world.Reading:
    return world.Reading(jnp.float32(sonar), jnp.float32(distance), jnp.float32(angle))


def test_every_combination_of_intervals_has_its_own_row() -> None:
    sonars = np.array(list(itertools.product([50.0, 150.0, 300.0], repeat=5)))
    others = np.array(list(itertools.product([100.0, 300.0, 500.0, 800.0], [0.0, 90, 180, -90])))
    grid = [np.repeat(sonars, len(others), axis=0), np.tile(others, (len(sonars), 1))]
    batch = world.Reading(
        jnp.float32(grid[0]), jnp.float32(grid[1][:, 0]), jnp.float32(grid[1][:, 1])
    )
    rows = jax.vmap(qlearning.discretize)(batch)
    assert sorted(rows.tolist()) == list(range(qlearning.N_STATES))


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (([99.0] * 5, 100.0, 0.0), ([100.0] * 5, 100.0, 0.0)),
        (([199.0] * 5, 100.0, 0.0), ([200.0] * 5, 100.0, 0.0)),
        (([0.0] * 5, 199.0, 0.0), ([0.0] * 5, 200.0, 0.0)),
        (([0.0] * 5, 100.0, 44.0), ([0.0] * 5, 100.0, 46.0)),
        (([0.0] * 5, 100.0, -44.0), ([0.0] * 5, 100.0, -46.0)),
        (([0.0] * 5, 100.0, 134.0), ([0.0] * 5, 100.0, 136.0)),
    ],
)
def test_intervals_are_cut_where_the_source_cuts_them(low: Any, high: Any) -> None:
    assert qlearning.discretize(reading(*low)) != qlearning.discretize(reading(*high))


def test_behind_is_one_region_on_both_sides() -> None:
    rows = [qlearning.discretize(reading([0.0] * 5, 0.0, a)) for a in (180.0, 179.0, -179.0)]
    assert rows[0] == rows[1] == rows[2]


def test_target_of_the_update_in_closed_form() -> None:
    q = qlearning.QParams(discount=0.5)
    ahead = jnp.asarray([1.0, 4.0, -2.0])
    assert qlearning.td_target(q, jnp.float32(2.0), jnp.asarray(False), ahead) == 4.0
    assert qlearning.td_target(q, jnp.float32(2.0), jnp.asarray(True), ahead) == 2.0


@pytest.fixture(scope="module")
def lane() -> world.WorldParams:
    """An open room: facing the target within 45 degrees, driving straight mostly misses."""
    return maps.make_map(target=(300, 300), starts=[(100, 300, 20)])


@pytest.fixture(scope="module")
def learned(lane: world.WorldParams) -> Any:
    keys = jax.random.split(jax.random.key(0), N)
    q = jax.tree.map(jnp.float32, qlearning.QParams())
    return q, keys, run(
        q, lane, qlearning.init(N), keys=keys, n_trials=TRIALS, max_steps=STEPS, learn=True
    )  # fmt: skip


def test_it_learns_to_arrive(lane: world.WorldParams, learned: Any) -> None:
    q, _, (tables, trials) = learned
    greedy = q._replace(epsilon=jnp.float32(0.0))
    keys = jax.random.split(jax.random.key(1), N)
    # Same sizes as in training: one compiled program serves tests with and without learning.
    _, before = run(
        greedy._replace(learning_rate=jnp.float32(0.0)), lane, qlearning.init(N), keys=keys,
        n_trials=TRIALS, max_steps=STEPS, learn=True,
    )  # fmt: skip
    _, after = run(
        greedy._replace(learning_rate=jnp.float32(0.0)), lane, tables, keys=keys,
        n_trials=TRIALS, max_steps=STEPS, learn=True,
    )  # fmt: skip
    # Untrained and greedy drives straight: it arrives when it happens to face the target.
    assert before.arrived.mean() < 0.35
    assert after.arrived.mean() > before.arrived.mean() + 0.3
    assert trials.arrived[:, -20:].mean() > trials.arrived[:, :20].mean() + 0.1


def test_trials_are_booked_once_each(lane: world.WorldParams, learned: Any) -> None:
    tables, trials = jax.tree.map(np.asarray, learned[2])
    assert not (trials.arrived & trials.collided).any()
    assert (trials.steps >= 1).all()
    assert (trials.steps <= STEPS).all()
    open_end = ~(trials.arrived | trials.collided)
    assert (trials.steps[open_end] == STEPS).all()
    # 15 px a step; the last one may end early.
    assert (trials.length <= 15.0 * trials.steps + 1e-2).all()
    assert (trials.length >= 15.0 * (trials.steps - 1) - 1e-2).all()
    assert (np.hypot(*np.moveaxis(trials.start - np.float32([100, 300]), -1, 0)) <= 20.001).all()
    # Rewards are +2 and -2, discounted: no value can lie outside.
    assert np.abs(tables).max() <= 2.0
    assert (tables != 0).any()


@pytest.mark.slow
def test_learners_are_independent_of_their_batch_and_can_go_on(
    lane: world.WorldParams, learned: Any
) -> None:
    q, keys, (tables, trials) = learned
    swapped, again = run(
        q, lane, qlearning.init(N), keys=keys[::-1], n_trials=TRIALS, max_steps=STEPS, learn=True
    )
    np.testing.assert_array_equal(again.steps[::-1], trials.steps)
    np.testing.assert_array_equal(swapped[::-1], tables)
    half = TRIALS // 2
    first, a = run(
        q, lane, qlearning.init(N), keys=keys, n_trials=half, max_steps=STEPS, learn=True
    )
    second, b = run(
        q, lane, first, keys=keys, n_trials=half, max_steps=STEPS, learn=True, first_trial=half
    )
    np.testing.assert_array_equal(np.concatenate([a.steps, b.steps], axis=1), trials.steps)
    np.testing.assert_allclose(second, tables, atol=1e-6)


def test_bad_constants_are_refused(lane: world.WorldParams) -> None:
    with pytest.raises(ValueError, match=r"epsilon=1\.5"):
        qlearning.check_q(qlearning.QParams(epsilon=1.5))
    with pytest.raises(ValueError, match="n=0: expected"):
        qlearning.init(0)
    with pytest.raises(ValueError, match="n_trials=0"):
        qlearning.run_trials(
            qlearning.QParams(), lane, qlearning.init(1),
            keys=jax.random.split(jax.random.key(0), 1), n_trials=0, max_steps=5, learn=True,
        )  # fmt: skip
