"""The graded reward, the options of the learning that go with it, and networks in files."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import Status, encoding, run_experiment, scenarios, snn_params
from jaxsnn.config import check_network
from jaxsnn.drivers import DRIVERS, driver_agent
from jaxsnn.network_input import input_rates
from jaxsnn.presets import preset
from jaxsnn.saved import load_networks, save_networks
from jaxsnn.turn_goal import TurnGoalParams, turn_goal, turn_reward
from jaxsnn.world import Reading

PARAMS = TurnGoalParams(side=100.0, diagonal=100.0, front=200.0, blocked=90.0)


def reading(sonar, angle=0.0):
    return Reading(jnp.asarray(sonar, jnp.float32), jnp.asarray(300.0), jnp.asarray(angle))


@pytest.mark.parametrize(
    ("sonar", "angle", "recent", "goal"),
    [
        ([300.0] * 5, 20.0, 0.0, 20.0),  # free: to the target
        ([300.0] * 5, -170.0, 0.0, -60.0),  # at most `towards`
        ([50.0, 300, 300, 300, 300], 20.0, 0.0, -60.0),  # an obstacle at the left: to the right
        ([50.0, 300, 300, 300, 20], 20.0, 0.0, 60.0),  # both: away from the nearer one
        ([300.0, 300, 100, 300, 300], 0.0, 0.0, 60.0),  # straight ahead: one side
        ([300.0, 300, 100, 300, 300], 0.0, -30.0, -60.0),  # straight ahead: the side chosen before
    ],
)
def test_goals_of_simple_readings(sonar, angle, recent, goal):
    found, _ = turn_goal(PARAMS, reading(sonar, angle), jnp.asarray(recent))
    assert float(found) == goal


def test_a_wall_beside_the_robot_shuts_the_way_to_the_target_behind_it():
    beside = reading([80.0, 300, 300, 300, 300], 90.0)
    along = PARAMS._replace(side=70.0)
    assert float(turn_goal(along, beside, jnp.asarray(0.0))[0]) == 0.0
    free = along._replace(blocked=60.0)
    assert float(turn_goal(free, beside, jnp.asarray(0.0))[0]) == 60.0


def test_the_reward_is_opposite_for_the_motors_and_vanishes_at_the_goal():
    where, none = reading([300.0] * 5, 40.0), jnp.asarray(0.0)
    at_goal = turn_reward(PARAMS, where, none, jnp.asarray(40.0))
    np.testing.assert_allclose(at_goal, [0.0, 0.0], atol=1e-6)
    left = turn_reward(PARAMS, where, none, jnp.asarray(10.0))
    np.testing.assert_allclose(left, [-1.0, 1.0], rtol=1e-6)  # 2 (40 - 10) / 60


def test_one_group_of_each_sensor_fires_in_the_interval_code():
    rates = encoding.interval_rates(
        150.0, jnp.array([10.0, 60.0, 150.0, 250.0, 300.0]), jnp.asarray(450.0), jnp.asarray(-90.0)
    )
    on = np.flatnonzero(np.asarray(rates)).tolist()
    assert on == [0, 5, 10, 15, 19, 20 + 2, 24 + 6]
    assert set(np.asarray(rates)[on].tolist()) == {150.0}


def small(**config):
    return preset(
        "S4",
        config={
            "hidden_exc": 8, "hidden_inh": 8, "group_exc": 2, "group_inh": 2,
            "control_steps": 20, "hold_steps": 10, **config,
        },
    )  # fmt: skip


def test_turn_groups_fire_with_the_recent_turns():
    config, params = small(turn_groups=True)
    rates = input_rates(config, params, reading([300.0] * 5), jnp.asarray(-30.0))
    assert rates.shape == (config.n_in,) == (9 * 4,)
    assert rates[-8:].tolist() == [0.0] * 4 + [50.0] * 4


def run(config, params, **options):
    params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)
    reward = options.get("reward")

    @jax.jit
    def go(words, params, states):
        return run_experiment(
            config, snn_params(config, params), scenarios.scenario(1),
            keys=jax.random.wrap_key_data(words), n_learn=2, n_test=2, max_steps=12, block=2,
            keep_states=True, record=True, states=states,
            reward=reward,
        )  # fmt: skip

    return go(jax.random.key_data(jax.random.split(jax.random.key(1), 2)), params,
              options.get("states"))  # fmt: skip


@pytest.mark.slow
def test_turns_are_cut_off_the_rate_anneals_and_networks_go_on(tmp_path):
    config, params = small(input_code="interval", turn_groups=True, guidance="graded")
    params = params._replace(max_turn=20.0, gamma=1e-3)
    first = run(config, params)
    headings = np.unwrap(np.asarray(first.learning.poses)[:, 0, :8, 2])
    assert np.nanmax(np.abs(np.diff(headings))) <= math.radians(20.0) + 1e-4
    steps = np.asarray(first.learning.steps).sum(axis=1)
    np.testing.assert_array_equal(first.states.updates, steps)
    frozen = run(config, params._replace(anneal=1e-6))
    moved, held = (
        float(jnp.abs(jnp.diff(e.states.weights.hidden, axis=0)).mean()) for e in (first, frozen)
    )
    assert moved != held

    file = save_networks(tmp_path / "nets.npz", config, first.states)
    states = load_networks(file, config, params)
    np.testing.assert_array_equal(states.weights.hidden, first.states.weights.hidden)
    again = run(config, params, states=states)
    np.testing.assert_array_equal(again.states.updates - first.states.updates,
                                  np.asarray(again.learning.steps).sum(axis=1))  # fmt: skip
    other = dataclasses.replace(config, hidden_exc=10)
    with pytest.raises(ValueError, match="networks with hidden_exc=10, they have 8"):
        load_networks(file, other, params)
    (tmp_path / "no.npz").write_text("no")
    with pytest.raises(ValueError, match="expected a file written by --save"):
        load_networks(tmp_path / "no.npz", config, params)
    with pytest.raises(ValueError, match=r"ends in \.npz"):
        save_networks(tmp_path / "nets.pkl", config, first.states)


@pytest.mark.slow
def test_a_reward_of_one_s_own_takes_the_place_of_the_built_in_one():
    graded, params = small(guidance="graded")
    nearest, _ = small()
    mine = run(nearest, params, reward=lambda p, *seen: turn_reward(p.goal, *seen))
    built_in = run(graded, params)
    np.testing.assert_array_equal(mine.states.weights.hidden, built_in.states.weights.hidden)


def test_agents_of_one_s_own_take_the_network_s_place():
    driver, keys = driver_agent(), jax.random.split(jax.random.key(0), 3)
    config, params = small()
    made = run_experiment(
        config, DRIVERS["blind"], scenarios.scenario(1), keys=keys, n_learn=1, n_test=2,
        agents=(driver, driver),
    )  # fmt: skip
    assert made.testing.status.tolist() == [[Status.ARRIVED] * 2] * 3
    with pytest.raises(ValueError, match="config=None: expected a NetworkConfig"):
        run_experiment(None, params, scenarios.scenario(1), keys=keys)
    with pytest.raises(ValueError, match="expected no reward and no weights beside agents"):
        run_experiment(
            config, params, scenarios.scenario(1), keys=keys, agents=(driver, driver),
            reward=turn_reward,
        )  # fmt: skip


def test_constants_that_ask_for_nothing_are_refused():
    config, params = small()
    for change, words in (
        ({"max_turn": 0.0}, "max_turn=0.0: expected a number > 0"),
        ({"anneal": -1.0}, "anneal=-1.0"),
        ({"interval_rate": 2e3}, "interval_rate=2000.0: expected at most one spike per step"),
        ({"goal": TurnGoalParams(front=0.0)}, "front=0.0"),
        ({"goal": TurnGoalParams(memory=math.nan)}, "memory=nan"),
    ):
        with pytest.raises(ValueError, match=words):
            check_network(config, params._replace(**change))
