"""Trials: a robot drives until it arrives, collides or runs out of time; many robots at once.

Robots run in blocks. Inside a block each robot starts its next trial as soon as its last one has
ended, and the loop ends when the slowest robot has done all its trials: no step is spent on a trial
that is over. Blocks of 4 to 8 robots keep the weights in a CPU's cache; on an accelerator one block
takes all robots.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from jaxsnn import world
from jaxsnn._checks import (
    concrete,
    default_float,
    require,
    require_circles,
    require_count,
    require_key,
    require_keys,
    require_mapped,
    require_whole,
)
from jaxsnn.agents import Agent
from jaxsnn.status import Status


class TrialResult(NamedTuple):
    """How trials ended; leaves lead with robots, then trials.

    Attributes:
        status: `Status` as int32. A robot whose state is not finite stops; its later trials are
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
    robot: world.WorldState
    trial: Array
    result: TrialResult


def success_rate(result: TrialResult) -> Float[Array, "*robots"]:
    """Arrivals per trial (the source's `SR`), over the last axis.

    Returns:
        Shares in [0, 1], `[robots]`.

    Example:
        >>> import jax.numpy as jnp
        >>> result = TrialResult(*[None] * len(TrialResult._fields))
        >>> ended = jnp.array([[Status.ARRIVED, Status.COLLIDED, Status.ARRIVED, Status.COLLIDED]])
        >>> success_rate(result._replace(status=ended)).tolist()
        [0.5]
    """
    return jnp.mean((result.status == Status.ARRIVED).astype(default_float()), axis=-1)


def _advance(
    agent: Agent,
    n_trials: int | Array,
    max_steps: int,
    params: Any,
    map: world.WorldParams,
    starts: _Start,
    carry: _Carry,
) -> _Carry:
    """One control step of one robot, and the start of its next trial when this one is over."""
    trial = jnp.minimum(carry.trial, n_trials - 1)
    active = carry.trial < n_trials
    robot, result = carry.robot, carry.result
    step = result.steps[trial]
    step_key = jax.random.fold_in(starts.key[trial], step)
    reading = world.observe(map, robot)
    state, steering, memory, info = agent.act(
        params, carry.agent, reading, step == 0, active, key=step_key
    )
    moved, outcome = world.step(map, robot, steering)
    following = world.observe(map, moved) if agent.needs_next else None
    state = agent.learn(params, state, memory, outcome, following, active)

    broken = outcome.failed | ~agent.finite(state)
    late = step + 1 >= max_steps
    over = outcome.collided | outcome.arrived | late | broken
    status = jnp.where(late, jnp.int32(Status.TIMEOUT), jnp.int32(Status.NOT_RUN))
    status = jnp.where(outcome.collided, jnp.int32(Status.COLLIDED), status)
    status = jnp.where(outcome.arrived, jnp.int32(Status.ARRIVED), status)
    status = jnp.where(broken, jnp.int32(Status.NON_FINITE), status)

    following_trial = jnp.where(broken, n_trials, trial + over.astype(jnp.int32))
    following_trial = jnp.where(active, following_trial, carry.trial)
    begins = over & active & (following_trial < n_trials)
    at = jnp.minimum(following_trial, n_trials - 1)
    begin = jax.tree.map(lambda x: x[at], starts.robot)
    robot = jax.tree.map(lambda a, b: jnp.where(begins, a, b), begin, moved)
    driven = jnp.hypot(moved.x - carry.robot.x, moved.y - carry.robot.y)
    # The row of this trial, by a mask: indices are slower, to compile and to run. A robot that has
    # done all its trials has none.
    row = (jnp.arange(result.status.shape[0]) == trial) & active
    seen = info[None].astype(result.info.dtype)
    poses = result.poses
    if poses is not None:
        outside = poses.shape[0]
        at = jnp.where(active, trial, outside)
        poses = poses.at[at, step + 1].set(_pose(moved), mode="drop")
        at = jnp.where(begins, following_trial, outside)
        poses = poses.at[at, 0].set(_pose(begin), mode="drop")
    result = TrialResult(
        status=jnp.where(row, status, result.status),
        steps=jnp.where(row, result.steps + 1, result.steps),
        path=jnp.where(row, result.path + driven, result.path),
        info=jnp.where(row[:, None], result.info + seen, result.info),
        poses=poses,
    )
    return _Carry(agent=state, robot=robot, trial=following_trial, result=result)


def _pose(robot: world.WorldState) -> Array:
    return jnp.stack([robot.x, robot.y, robot.heading])


class _Start(NamedTuple):
    """Where a trial begins, and the key of its steps."""

    robot: world.WorldState
    key: Array


def _starts(
    map: world.WorldParams, circles: Array | None, key: Array, n_trials: int, first: int
) -> _Start:
    """Of all trials of a robot, leaves `[trials]`."""

    def start(given: tuple[Array, Array | None]) -> _Start:
        trial, circle = given
        number = 2 * (trial + first if first else trial) + jnp.arange(2)
        keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(number)
        return _Start(world.reset(map, key=keys[0], circle=circle), keys[1])

    # One after the other: a draw of many shapes takes longer to compile than all take to run.
    return jax.lax.map(start, (jnp.arange(n_trials), circles))


def start_states(
    map: world.WorldParams,
    circles: Int[Array, " trials"] | Sequence[int] | None = None,
    *,
    key: Key[Array, ""],
    n_trials: int,
) -> world.WorldState:
    """Where `run_phase` puts the robot of this key at the beginning of each of its trials.

    Returns:
        world.WorldState with leaves `[trials]`.

    Raises:
        ValueError, TypeError: as `run_phase`, of the same arguments.
    """
    require_key(key)
    require_whole("n_trials", n_trials, 1, "ask for at least one trial")
    return _starts(map, given_circles(map, circles, n_trials), key, n_trials, 0).robot


def given_circles(
    map: world.WorldParams, circles: Int[Array, " n"] | Sequence[int] | None, n_trials: int
) -> Int[Array, " trials"] | None:
    """Start circles of trials as an array, one for each, an existing one or negative for a draw.

    Raises:
        ValueError, TypeError: too few or too many of them, one that the map does not draw from,
            or no whole numbers.
    """
    if circles is None:
        return None
    shape = np.shape(circles)
    require(
        shape == (n_trials,),
        f"circles=<shape {shape}>: expected ({n_trials},); give one start circle per trial",
    )
    require_circles("circles", circles, map.start_probs)
    return jnp.asarray(circles, jnp.int32)


def run_phase(
    agent: Agent,
    params: Any,
    map: world.WorldParams,
    states: Any,
    *,
    keys: Key[Array, " robots"],
    n_trials: int,
    max_steps: int,
    circles: Int[Array, " trials"] | Sequence[int] | None = None,
    first: int = 0,
    run: int | Int[Array, ""] | None = None,
    params_axis: Any = None,
    map_axis: Any = None,
    record: bool = False,
) -> tuple[Any, TrialResult]:
    """Drive a block of robots through `n_trials` trials each.

    Trial `i` of a robot depends on the robot's key and `i` alone (and on what it has learnt), not
    on how robots are arranged in blocks.

    Args:
        agent: Agent.
        params: the agent's parameters.
        map: the map.
        states: the agents' states, leaves `[robots, ...]`.
        keys: one per robot.
        n_trials: trials per robot.
        max_steps: control steps after which a trial is given up.
        circles: start circle of each trial; drawn at random when not given or negative.
        run: do only so many of the trials, at most `n_trials` (may be traced); the others are
            left NOT_RUN.
        first: number of the first trial: a phase in two parts, the second one from the states and
            the number at which the first one ended, is the phase in one.
        params_axis, map_axis: 0 when each robot has its own, a tree for some leaves only, as in
            `jax.vmap`; no other axis.
        record: keep the poses.

    Returns:
        The agents' states and a TrialResult.

    Raises:
        ValueError, TypeError: there is no robot, no trial or no step; keys are not typed keys;
            `circles` are not one existing start circle or negative number for each trial; what
            each robot has for itself is not there once for each key.
    """
    require_keys(keys)
    require_whole("n_trials", n_trials, 1, "ask for at least one trial")
    require_whole("max_steps", max_steps, 1, "allow at least one control step")
    require_whole("first", first, 0, "count trials from 0")
    if run is not None:
        require_count("run", run, 0, "0 runs none of them")
        asked = concrete(run)
        require(
            asked is None or bool(asked <= n_trials),
            f"run={run}: expected at most n_trials = {n_trials}; raise n_trials",
        )
    circles = given_circles(map, circles, n_trials)
    robots = keys.shape[0]
    require_mapped("states", 0, states, robots)
    require_mapped("params", params_axis, params, robots)
    require_mapped("map", map_axis, map, robots)
    n_info = len(agent.info)

    def begin(key: Array, map: world.WorldParams) -> tuple[_Start, TrialResult]:
        starts = _starts(map, circles, key, n_trials, first)
        robot = jax.tree.map(lambda x: x[0], starts.robot)
        poses = None
        if record:
            poses = jnp.full((n_trials, max_steps + 1, 3), jnp.nan, robot.x.dtype)
            poses = poses.at[0, 0].set(_pose(robot))
        return starts, TrialResult(
            status=jnp.full((n_trials,), Status.NOT_RUN, jnp.int32),
            steps=jnp.zeros((n_trials,), jnp.int32),
            path=jnp.zeros((n_trials,), robot.x.dtype),
            info=jnp.zeros((n_trials, n_info), default_float()),
            poses=poses,
        )

    # Trials are counted in int32; under `jax.enable_x64` a traced `run` may be wider.
    last = n_trials if run is None else jnp.asarray(run, jnp.int32)
    advance = functools.partial(_advance, agent, last, max_steps)
    many = jax.vmap(advance, in_axes=(params_axis, map_axis, 0, 0))
    starts, result = jax.vmap(begin, in_axes=(0, map_axis))(keys, map)
    robot = jax.tree.map(lambda x: x[:, 0], starts.robot)
    carry = _Carry(states, robot, jnp.zeros((robots,), jnp.int32), result)
    carry = jax.lax.while_loop(
        lambda c: jnp.any(c.trial < last), lambda c: many(params, map, starts, c), carry
    )
    result = carry.result
    steps = jnp.maximum(result.steps, 1).astype(result.info.dtype)
    return carry.agent, result._replace(info=result.info / steps[..., None])


def run_trial(
    agent: Agent,
    params: Any,
    map: world.WorldParams,
    state: Any,
    *,
    key: Key[Array, ""],
    max_steps: int,
    record: bool = False,
) -> tuple[Any, TrialResult]:
    """One trial of one robot; the same as a phase of one trial with one robot.

    Returns:
        The agent's state and a TrialResult without leading axes.
    """
    require_key(key)
    one = jax.tree.map(lambda x: x[None], state)
    state, result = run_phase(
        agent, params, map, one, keys=key[None], n_trials=1, max_steps=max_steps, record=record
    )
    return jax.tree.map(lambda x: x[0], state), jax.tree.map(lambda x: x[0, 0], result)
