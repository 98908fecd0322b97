"""Trials: a robot drives until it arrives, collides or runs out of time; many robots at once.

Robots run in blocks. Inside a block each robot starts its next trial as soon as its last one has
ended, and the loop ends when the slowest robot has done all its trials: no step is spent on a trial
that is over. Blocks of 4 to 8 robots keep the weights in a CPU's cache; on an accelerator one block
takes all robots.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from jaxsnn import world
from jaxsnn._checks import require
from jaxsnn.agents import Agent, SNNParams, snn_agent
from jaxsnn.config import NetworkConfig

__all__ = [
    "ARRIVED",
    "COLLIDED",
    "NON_FINITE",
    "NOT_RUN",
    "STATUS",
    "TIMEOUT",
    "Experiment",
    "TrialResult",
    "phase_keys",
    "run_experiment",
    "run_phase",
    "run_trial",
    "start_states",
    "success_rate",
]

ARRIVED, COLLIDED, TIMEOUT, NON_FINITE, NOT_RUN = range(5)
STATUS = ("arrived", "collided", "timeout", "non-finite", "not run")


class TrialResult(NamedTuple):
    """How trials ended; leaves lead with robots, then trials.

    Attributes:
        status: index into `STATUS`. A robot whose state is not finite stops; its later trials are
            not run.
        steps: control steps, the source's steering movements.
        path: length of the way driven [px].
        info: mean over the trial of the agent's `info`, `[..., n_info]`.
        poses: `x`, `y` [px] and heading [rad] before the first and after each step, NaN after the
            end, `[..., max_steps + 1, 3]`; None unless recorded.
    """

    status: Int[Array, "*robots trials"]
    steps: Int[Array, "*robots trials"]
    path: Float[Array, "*robots trials"]
    info: Float[Array, "*robots trials n"]
    poses: Float[Array, "*robots trials t1 3"] | None


class _Carry(NamedTuple):
    """One robot of a block between two control steps."""

    agent: Any
    robot: world.State
    trial: Array
    result: TrialResult


def success_rate(result: TrialResult) -> Float[Array, "*robots"]:
    """Arrivals per trial (the source's `SR`), over the last axis."""
    return jnp.mean((result.status == ARRIVED).astype(jnp.float32), axis=-1)


def _advance(
    agent: Agent,
    n_trials: int,
    max_steps: int,
    circles: Array | None,
    params: Any,
    place: world.Params,
    key: Key[Array, ""],
    carry: _Carry,
) -> _Carry:
    """One control step of one robot, and the start of its next trial when this one is over."""
    trial = jnp.minimum(carry.trial, n_trials - 1)
    active = carry.trial < n_trials
    robot, result = carry.robot, carry.result
    step = result.steps[trial]
    step_key = jax.random.fold_in(jax.random.fold_in(key, 2 * trial + 1), step)
    reading = world.observe(robot, place)
    state, steering, memory, info = agent.act(
        params, carry.agent, reading, step_key, step == 0, active
    )
    moved, outcome = world.step(robot, steering, place)
    following = world.observe(moved, place) if agent.needs_next else None
    state = agent.learn(params, state, memory, outcome, following, active)

    broken = outcome.failed | ~agent.finite(state)
    late = step + 1 >= max_steps
    over = outcome.collided | outcome.arrived | late | broken
    status = jnp.where(late, TIMEOUT, NOT_RUN)
    status = jnp.where(outcome.collided, COLLIDED, status)
    status = jnp.where(outcome.arrived, ARRIVED, status)
    status = jnp.where(broken, NON_FINITE, status)

    # A robot that has done all its trials writes out of bounds, that is, nowhere.
    at = jnp.where(active, trial, n_trials)
    driven = jnp.hypot(moved.x - robot.x, moved.y - robot.y)
    poses = result.poses
    if poses is not None:
        poses = poses.at[at, step + 1].set(_pose(moved), mode="drop")
    following_trial = jnp.where(broken, n_trials, trial + over.astype(jnp.int32))
    following_trial = jnp.where(active, following_trial, carry.trial)
    begins = over & active & (following_trial < n_trials)
    begin = _start(key, following_trial, place, circles, n_trials)
    robot = jax.tree.map(lambda a, b: jnp.where(begins, a, b), begin, moved)
    if poses is not None:
        first = jnp.where(begins, following_trial, n_trials)
        poses = poses.at[first, 0].set(_pose(begin), mode="drop")
    result = TrialResult(
        status=result.status.at[at].set(status, mode="drop"),
        steps=result.steps.at[at].add(1, mode="drop"),
        path=result.path.at[at].add(driven, mode="drop"),
        info=result.info.at[at].add(info, mode="drop"),
        poses=poses,
    )
    return _Carry(agent=state, robot=robot, trial=following_trial, result=result)


def _pose(robot: world.State) -> Array:
    return jnp.stack([robot.x, robot.y, robot.heading])


def _start(
    key: Array, trial: Array, place: world.Params, circles: Array | None, n_trials: int
) -> world.State:
    circle = None if circles is None else circles[jnp.minimum(trial, n_trials - 1)]
    return world.reset(jax.random.fold_in(key, 2 * trial), place, circle=circle)


def start_states(
    key: Key[Array, ""],
    place: world.Params,
    n_trials: int,
    circles: Int[Array, " trials"] | None = None,
) -> world.State:
    """Where `run_phase` puts the robot of this key at the beginning of each of its trials.

    Returns:
        world.State with leaves `[trials]`.
    """
    return jax.vmap(lambda i: _start(key, i, place, circles, n_trials))(jnp.arange(n_trials))


def run_phase(
    agent: Agent,
    params: Any,
    place: world.Params,
    states: Any,
    keys: Key[Array, " robots"],
    *,
    n_trials: int,
    max_steps: int,
    circles: Int[Array, " trials"] | None = None,
    params_axis: Any = None,
    place_axis: Any = None,
    record: bool = False,
) -> tuple[Any, TrialResult]:
    """Drive a block of robots through `n_trials` trials each.

    Trial `i` of a robot depends on the robot's key and `i` alone (and on what it has learnt), not
    on how robots are arranged in blocks.

    Args:
        agent: Agent.
        params: the agent's parameters.
        place: world.Params.
        states: the agents' states, leaves `[robots, ...]`.
        keys: one per robot.
        n_trials: trials per robot.
        max_steps: control steps after which a trial is given up.
        circles: start circle of each trial; drawn at random when not given.
        params_axis, place_axis: 0 when each robot has its own, as in `jax.vmap`.
        record: keep the poses.

    Returns:
        The agents' states and a TrialResult.

    Raises:
        ValueError: there is no robot, no trial or no step.
    """
    robots = keys.shape[0]
    require(robots > 0, "robots = 0: give at least one key, one per robot")
    require(n_trials > 0, f"n_trials = {n_trials}: expected at least one trial")
    require(max_steps > 0, f"max_steps = {max_steps}: expected at least one control step")
    n_info = len(agent.info)

    def begin(key: Array, place: world.Params) -> tuple[world.State, TrialResult]:
        robot = _start(key, jnp.zeros((), jnp.int32), place, circles, n_trials)
        poses = None
        if record:
            poses = jnp.full((n_trials, max_steps + 1, 3), jnp.nan, jnp.float32)
            poses = poses.at[0, 0].set(_pose(robot))
        return robot, TrialResult(
            status=jnp.full((n_trials,), NOT_RUN, jnp.int32),
            steps=jnp.zeros((n_trials,), jnp.int32),
            path=jnp.zeros((n_trials,), jnp.float32),
            info=jnp.zeros((n_trials, n_info), jnp.float32),
            poses=poses,
        )

    def advance(params: Any, place: world.Params, key: Array, carry: _Carry) -> _Carry:
        return _advance(agent, n_trials, max_steps, circles, params, place, key, carry)

    many = jax.vmap(advance, in_axes=(params_axis, place_axis, 0, 0))
    robot, result = jax.vmap(begin, in_axes=(0, place_axis))(keys, place)
    carry = _Carry(states, robot, jnp.zeros((robots,), jnp.int32), result)
    carry = jax.lax.while_loop(
        lambda c: jnp.any(c.trial < n_trials), lambda c: many(params, place, keys, c), carry
    )
    result = carry.result
    steps = jnp.maximum(result.steps, 1).astype(jnp.float32)
    return carry.agent, result._replace(info=result.info / steps[..., None])


def run_trial(
    agent: Agent,
    params: Any,
    place: world.Params,
    state: Any,
    key: Key[Array, ""],
    *,
    max_steps: int,
    record: bool = False,
) -> tuple[Any, TrialResult]:
    """One trial of one robot; the same as a phase of one trial with one robot.

    Returns:
        The agent's state and a TrialResult without leading axes.
    """
    one = jax.tree.map(lambda x: x[None], state)
    state, result = run_phase(
        agent, params, place, one, key[None], n_trials=1, max_steps=max_steps, record=record
    )
    return jax.tree.map(lambda x: x[0], state), jax.tree.map(lambda x: x[0, 0], result)


def phase_keys(key: Key[Array, ""]) -> Key[Array, " 4"]:
    """Keys of a robot's first weights, learning, testing, and testing with plasticity left on."""
    return jax.random.split(key, 4)


class Experiment(NamedTuple):
    """A learning phase, a testing phase with frozen weights and, if asked for, one without."""

    learning: TrialResult
    testing: TrialResult
    online: TrialResult | None
    states: Any


def run_experiment(
    config: NetworkConfig,
    params: SNNParams,
    place: world.Params,
    keys: Key[Array, " robots"],
    *,
    n_learn: int = 20,
    n_test: int = 30,
    n_online: int = 0,
    max_steps: int = 200,
    block: int = 8,
    circles: Int[Array, " trials"] | None = None,
    params_axis: Any = None,
    place_axis: Any = None,
    test_place: world.Params | None = None,
    record: bool = False,
    keep_states: bool = False,
) -> Experiment:
    """Naive robots learn, then are tested: both phases of all robots in one program.

    Args:
        config: NetworkConfig.
        params: SNNParams.
        place: the map to learn on.
        keys: one per robot (an independent run each).
        n_learn, n_test: trials of the two phases; weights are frozen in testing.
        n_online: testing trials with plasticity left on, a second reading of the source.
        max_steps: control steps after which a trial is given up.
        block: robots that run together; see the module's docstring.
        circles: start circle of each learning trial; drawn at random when not given.
        params_axis, place_axis: 0 when each robot has its own, as in `jax.vmap`.
        test_place: the map to test on; `place` when not given. Shares `place_axis`.
        record: keep the poses.
        keep_states: return the networks after learning (0.4 MB per robot).

    Returns:
        Experiment; leaves lead with robots.

    Raises:
        ValueError: there is no robot, no trial or no step, or `block` is not positive.
    """
    robots = keys.shape[0]
    require(robots > 0, "robots = 0: give at least one key, one per robot")
    require(block > 0, f"block = {block}: expected at least one robot per block")
    learner, frozen = snn_agent(config), snn_agent(config, plastic=False)
    test_place = place if test_place is None else test_place

    def run(robot_keys: Array, params: SNNParams, place: Any, test_place: Any) -> Experiment:
        split = jax.vmap(phase_keys)(robot_keys)
        states = jax.vmap(learner.init, in_axes=(0, params_axis))(split[:, 0], params)
        axes = {"params_axis": params_axis, "place_axis": place_axis, "max_steps": max_steps}
        states, learning = run_phase(
            learner, params, place, states, split[:, 1],
            n_trials=n_learn, circles=circles, record=record, **axes,
        )  # fmt: skip
        _, testing = run_phase(
            frozen, params, test_place, states, split[:, 2], n_trials=n_test, record=record, **axes
        )
        online = None
        if n_online:
            _, online = run_phase(
                learner, params, test_place, states, split[:, 3],
                n_trials=n_online, record=record, **axes,
            )  # fmt: skip
        return Experiment(learning, testing, online, states if keep_states else None)

    block = min(block, robots)
    n_blocks = -(-robots // block)
    # The last block is filled up with robots from the front, which are dropped again.
    order = jnp.arange(n_blocks * block) % robots

    def blocks(tree: Any, axis: Any) -> Any:
        if axis is None:
            return None
        return jax.tree.map(lambda x: x[order].reshape(n_blocks, block, *x.shape[1:]), tree)

    def one_block(xs: tuple) -> Experiment:
        robot_keys, own_params, own_place, own_test = xs
        return run(
            robot_keys,
            params if params_axis is None else own_params,
            place if place_axis is None else own_place,
            test_place if place_axis is None else own_test,
        )

    out = jax.lax.map(
        one_block,
        (
            blocks(keys, 0),
            blocks(params, params_axis),
            blocks(place, place_axis),
            blocks(test_place, place_axis),
        ),
    )
    return jax.tree.map(lambda x: x.reshape(n_blocks * block, *x.shape[2:])[:robots], out)
