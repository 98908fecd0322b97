"""Trials: statuses, blocks, frozen weights, a robot whose state breaks, a small thing learnt."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import network, scenarios, world
from jaxsnn.agents import Agent, snn_agent, snn_params, steering_angle
from jaxsnn.config import NetworkConfig, network_params
from jaxsnn.experiment import run_experiment
from jaxsnn.plasticity import STDPParams
from jaxsnn.status import Status
from jaxsnn.trials import run_phase, run_trial, start_states, success_rate

SMALL = NetworkConfig(
    hidden_exc=12, hidden_inh=12, group_exc=4, group_inh=4, control_steps=40, hold_steps=20
)
PARAMS = network_params(
    SMALL, gain_input=3.0, gain_output=6.0, gamma=0.01, stdp=STDPParams(anti_causal=0.0)
)
PLACE = scenarios.scenario(1)


def keys(n, seed=0):
    return jax.vmap(lambda i: jax.random.fold_in(jax.random.key(seed), i))(jnp.arange(n))


def scripted(turn):
    """An agent that steers by a rule; its state counts how often it has acted and learnt."""

    def act(params, state, reading, fresh, active, *, key):
        steering = jnp.asarray(turn(params, reading), jnp.float32)
        return (
            state + jnp.array([1, 0]) * active.astype(jnp.int32),
            steering,
            None,
            jnp.stack([steering]),
        )

    def learn(params, state, memory, outcome, following, active):
        return state + jnp.array([0, 1]) * active.astype(jnp.int32)

    return Agent(
        init=lambda key, params: jnp.zeros(2, jnp.int32),
        act=act,
        learn=learn,
        finite=lambda state: jnp.asarray(True),
        info=("steering",),
    )


@pytest.fixture(scope="module")
def phase():
    def run(params, map, states, keys, name, n_trials, max_steps, record, first=0):
        turns = {
            "seek": lambda p, r: jnp.clip(r.angle, -30, 30),
            "straight": lambda p, r: 0.0,
            "circle": lambda p, r: 120.0,
            "broken": lambda p, r: jnp.where(r.distance < 200, jnp.nan, jnp.clip(r.angle, -30, 30)),
        }
        return run_phase(
            scripted(turns[name]), params, map, states, keys=keys,
            n_trials=n_trials, max_steps=max_steps, record=record, first=first,
        )  # fmt: skip

    return jax.jit(run, static_argnames=("name", "n_trials", "max_steps", "record", "first"))


def test_statuses_steps_and_paths(phase):
    states = jnp.zeros((3, 2), jnp.int32)
    args = {"n_trials": 4, "max_steps": 60, "record": True}
    state, seek = phase(None, PLACE, states, keys(3), "seek", **args)
    assert (seek.status == Status.ARRIVED).all() and (success_rate(seek) == 1).all()
    # Straight to the target: no more than the way there, no less than the way less the radius.
    assert (seek.steps >= 15).all() and (seek.steps <= 28).all()
    np.testing.assert_array_less(seek.path, 15.0 * np.asarray(seek.steps) + 1e-2)
    np.testing.assert_array_equal(state[:, 0], seek.steps.sum(1))  # acted while under way, only
    np.testing.assert_array_equal(state[:, 1], seek.steps.sum(1))

    begin = jax.vmap(lambda k: start_states(PLACE, key=k, n_trials=4))(keys(3))
    np.testing.assert_allclose(begin.x, seek.poses[:, :, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(begin.heading, seek.poses[:, :, 0, 2], rtol=1e-5, atol=1e-6)
    poses, steps = np.asarray(seek.poses), np.asarray(seek.steps)
    for robot in range(3):
        for trial in range(4):
            track, n = poses[robot, trial], steps[robot, trial]
            assert np.isfinite(track[: n + 1]).all() and np.isnan(track[n + 1 :]).all()
            way = np.hypot(*np.diff(track[: n + 1, :2], axis=0).T)
            np.testing.assert_allclose(way.sum(), seek.path[robot, trial], rtol=1e-4)
            gap = np.hypot(*(track[n, :2] - np.asarray(PLACE.target)))
            assert gap <= float(PLACE.arrival_radius) + 1e-2

    _, circle = phase(None, PLACE, states, keys(3), "circle", **args)
    assert (circle.status == Status.TIMEOUT).all() and (circle.steps == 60).all()
    np.testing.assert_allclose(circle.info[..., 0], 120.0)
    _, straight = phase(None, PLACE, states, keys(3), "straight", **args)
    assert set(np.unique(straight.status)) <= {Status.ARRIVED, Status.COLLIDED}
    assert (straight.status == Status.COLLIDED).any()


@pytest.mark.slow
def test_results_do_not_depend_on_the_block(phase):
    args = {"name": "seek", "n_trials": 2, "max_steps": 40, "record": False}
    _, three = phase(None, PLACE, jnp.zeros((3, 2), jnp.int32), keys(3), **args)
    _, one = phase(None, PLACE, jnp.zeros((1, 2), jnp.int32), keys(3)[1:2], **args)
    np.testing.assert_array_equal(three.steps[1], one.steps[0])
    np.testing.assert_allclose(three.path[1], one.path[0], rtol=1e-6)


@pytest.mark.slow
def test_a_phase_in_two_parts_is_the_phase_in_one(phase):
    args = {"name": "seek", "max_steps": 40, "record": False}
    states = jnp.zeros((3, 2), jnp.int32)
    state, whole = phase(None, PLACE, states, keys(3), n_trials=2, **args)
    between, early = phase(None, PLACE, states, keys(3), n_trials=1, **args)
    end, late = phase(None, PLACE, between, keys(3), n_trials=1, first=1, **args)
    np.testing.assert_array_equal(end, state)
    for name in ("status", "steps", "path"):
        parts = [np.asarray(getattr(part, name)) for part in (early, late)]
        np.testing.assert_array_equal(np.concatenate(parts, axis=1), getattr(whole, name))
    assert (early.path != late.path).all()  # other starts


def test_a_network_that_waits_for_its_block_learns_nothing():
    agent, params = snn_agent(SMALL), snn_params(SMALL, PARAMS)
    reading = world.Reading(jnp.full(5, 300.0), jnp.asarray(100.0), jnp.asarray(30.0))

    @jax.jit
    def act(state, active):
        fresh = jnp.asarray(False)
        return agent.act(params, state, reading, fresh, active, key=jax.random.key(1))[0]

    state = jax.jit(agent.init)(jax.random.key(0), params)
    waiting, driving = (act(state, jnp.asarray(active)) for active in (False, True))
    kept = ("weights", "baseline_input", "baseline_hidden")
    for name in kept:
        jax.tree.map(np.testing.assert_array_equal, getattr(waiting, name), getattr(state, name))
    assert (driving.baseline_input.mean != state.baseline_input.mean).any()


def test_a_broken_robot_stops_alone(phase):
    _, result = phase(
        None, PLACE, jnp.zeros((2, 2), jnp.int32), keys(2), "broken", 3, 60, record=False
    )
    assert result.status[:, 0].tolist() == [Status.NON_FINITE, Status.NON_FINITE]
    assert result.status[:, 1:].tolist() == [[Status.NOT_RUN] * 2] * 2
    assert (result.steps[:, 1:] == 0).all()


def test_experiment_learns_then_freezes():
    @jax.jit
    def experiment(params, keys):
        return run_experiment(
            SMALL, snn_params(SMALL, params), PLACE, keys=keys, n_learn=2, n_test=2, n_online=1,
            max_steps=15, block=2, circles=jnp.array([1, 0]), record=True, keep_states=True,
        )  # fmt: skip

    out = experiment(PARAMS, keys(3))  # a block and a half
    assert out.learning.status.shape == (3, 2) and out.testing.status.shape == (3, 2)
    assert out.online.status.shape == (3, 1)
    first = jax.vmap(lambda k: jax.random.split(k, 4)[0])(keys(3))
    init = jax.vmap(lambda k: network.init(k, SMALL, PARAMS).weights.hidden)
    start = jax.jit(init)(first)
    assert (jnp.abs(out.states.weights.hidden - start).max((1, 2)) > 0.01).all()
    assert (out.learning.info[..., 2] > 0).all()  # hidden neurons fire
    x = out.learning.poses[:, :, 0, 0]
    assert (x[:, 0] > 600).all() and (x[:, 1] < 200).all()  # the start circles asked for
    still = experiment(PARAMS._replace(gamma=0.0), keys(3))
    np.testing.assert_allclose(still.states.weights.hidden, start, rtol=1e-6)


def test_a_phase_of_no_trials_is_left_out() -> None:
    """Given states are tested as they are, with agents of one's own and with the network."""
    agent = scripted(lambda p, r: 0.0)
    run = jax.jit(
        lambda states, keys: run_experiment(
            None, None, PLACE, keys=keys, n_learn=0, n_test=2, max_steps=3, states=states,
            agents=(agent, agent), keep_states=True,
        )
    )  # fmt: skip
    out = run(jnp.full((2, 2), 7), keys(2))
    assert (out.states == 7).all() and out.learning.status.shape == (2, 0)
    assert out.testing.steps.tolist() == [[3, 3]] * 2
    for learn, test in ((0, 2), (2, 0)):
        out = jax.eval_shape(
            lambda k, learn=learn, test=test: run_experiment(
                SMALL, snn_params(SMALL, PARAMS), PLACE, keys=k, n_learn=learn, n_test=test,
                max_steps=3, circles=[0] * learn,
            ),
            keys(2),
        )  # fmt: skip
        assert (out.learning.steps.shape, out.testing.steps.shape) == ((2, learn), (2, test))


def test_a_negative_start_circle_is_drawn() -> None:
    key = jax.random.key(0)
    given, drawn = (
        start_states(PLACE, circles, key=key, n_trials=3) for circles in ([-1, 1, -1], None)
    )
    x, y = np.asarray(given.x), np.asarray(drawn.x)
    np.testing.assert_array_equal(x[[0, 2]], y[[0, 2]])
    one = world.reset(PLACE, key=key, circle=-1)
    assert float(one.x) == float(world.reset(PLACE, key=key).x) > 0.0


@pytest.mark.slow
def test_nan_weights_stop_one_robot_only():
    learner, params = snn_agent(SMALL), snn_params(SMALL, PARAMS)
    states = jax.jit(jax.vmap(lambda k: learner.init(k, params)))(keys(2))
    spoilt = states.weights.hidden.at[0].set(jnp.nan)
    states = states._replace(weights=states.weights._replace(hidden=spoilt))
    run = jax.jit(
        lambda s, k: run_phase(learner, params, PLACE, s, keys=k, n_trials=2, max_steps=10)[1]
    )
    result = run(states, keys(2))
    assert result.status[0].tolist() == [Status.NON_FINITE, Status.NOT_RUN]
    assert (
        Status.NON_FINITE not in result.status[1].tolist()
        and Status.NOT_RUN not in result.status[1].tolist()
    )


def test_one_trial_of_one_robot():
    agent, params = snn_agent(SMALL, plastic=False), snn_params(SMALL, PARAMS)
    state = jax.jit(agent.init)(jax.random.key(0), params)
    run = jax.jit(lambda s, k: run_trial(agent, params, PLACE, s, key=k, max_steps=10, record=True))
    after, result = run(state, jax.random.key(1))
    assert result.status.shape == () and result.poses.shape == (11, 3)
    jax.tree.map(np.testing.assert_array_equal, after.weights, state.weights)


def test_left_motor_turns_right():
    """Section 2.4.3: left when freq_l - freq_r is negative; our angles are positive to the left."""
    left_faster = steering_angle(PARAMS, jnp.array([30.0, 10.0]))
    assert float(left_faster) == -20.0
    state = world.reset(PLACE, key=jax.random.key(0))
    turned, _ = jax.jit(world.step)(PLACE, state, left_faster)
    assert float(world.observe(PLACE, turned).angle) > float(world.observe(PLACE, state).angle)


def test_a_rewarded_reading_turns_the_robot_that_way():
    """One situation, target near and to one side, over and over: steering moves to that side."""
    config = NetworkConfig(control_steps=100, hold_steps=50)
    params = snn_params(
        config, network_params(config, gamma=1e-3, stdp=STDPParams(anti_causal=0.0))
    )
    agent = snn_agent(config)

    @jax.jit
    def drive(key, angle):
        reading = world.Reading(jnp.full(5, 300.0), jnp.asarray(100.0), angle)
        nothing = world.Outcome(jnp.asarray(False), jnp.asarray(False))
        yes = jnp.asarray(True)

        def body(state, k):
            state, steering, memory, _ = agent.act(params, state, reading, ~yes, yes, key=k)
            return agent.learn(params, state, memory, nothing, None, yes), steering

        return jax.lax.scan(body, agent.init(key, params), jax.random.split(key, 24))[1]

    for angle, sign in ((90.0, 1.0), (-90.0, -1.0)):
        steering = drive(jax.random.key(2), jnp.asarray(angle))
        assert sign * float(steering[-8:].mean() - steering[:4].mean()) > 10.0


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"n_trials": 0}, "n_trials=0"),
        ({"max_steps": 0}, "max_steps=0"),
    ],
)
def test_bad_numbers_are_named(change, part):
    args = {"n_trials": 1, "max_steps": 5, **change}
    with pytest.raises(ValueError, match=part):
        run_phase(scripted(lambda p, r: 0.0), None, PLACE, jnp.zeros((1, 2)), keys=keys(1), **args)
    with pytest.raises(ValueError, match="expected one key per robot"):
        run_phase(
            scripted(lambda p, r: 0.0), None, PLACE, jnp.zeros((0, 2)), keys=keys(1)[:0],
            n_trials=1, max_steps=1,
        )  # fmt: skip
