"""Tabular Q-learning: the baseline of the source, many independent learners at a time.

The state is the seven sensors cut into the same intervals as the spiking networks get
(5 sonars x 3, distance x 4, angle x 4: 3,888 states), the actions are forward, 30 degrees left and
30 degrees right. All learners of a batch take one control step after another in a single compiled
loop; one that ends a trial starts its next one at once, so none waits for the slowest.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from jaxsnn import sensor_intervals, world
from jaxsnn._checks import (
    concrete,
    require,
    require_count,
    require_finite,
    require_keys,
    require_whole,
)

ACTIONS = (0.0, 30.0, -30.0)  # steering of forward, left, right [deg]
N_STATES = (
    sensor_intervals.N_SONAR**world.N_SONARS
    * sensor_intervals.N_DISTANCE
    * sensor_intervals.N_ANGLE
)


class QParams(NamedTuple):
    """Constants of the learner; leaves may be traced, or differ between learners (`[n]`).

    Epsilon and the two rewards are the source's; learning rate and discount are ours.

    Attributes:
        learning_rate: `alpha`.
        discount: `gamma`.
        epsilon: chance of a random action.
        reward_arrival, reward_collision: rewards of the last step of a trial.
        reward_step: reward of each step that ends neither way.
    """

    learning_rate: float | Float[Array, "*n"] = 0.1
    discount: float | Float[Array, "*n"] = 0.9
    epsilon: float | Float[Array, "*n"] = 0.3
    reward_arrival: float | Float[Array, "*n"] = 2.0
    reward_collision: float | Float[Array, "*n"] = -2.0
    reward_step: float | Float[Array, "*n"] = 0.0


class Trials(NamedTuple):
    """What became of each trial, leaves `[learners, trials]`."""

    arrived: Array  # bool
    collided: Array  # bool; neither flag: out of steps
    steps: Array  # int32, control steps = steering movements
    length: Array  # path [px]
    start: Array  # [..., 2] where it began [px]


def check_q(params: QParams) -> None:
    """Refuse rates outside [0, 1] and rewards that are not finite; traced values pass.

    Raises:
        ValueError: names the constant, its value and the fix.
    """
    for name in QParams._fields:
        require_finite(name, getattr(params, name), "give a number")
    for name in ("learning_rate", "discount", "epsilon"):
        value = concrete(getattr(params, name))
        if value is None:
            continue
        bad = value[(value < 0.0) | (value > 1.0)]
        require(
            not bad.size, f"{name}={bad.max(initial=-1.0)}: expected a number in [0, 1]; clip it"
        )


def discretize(reading: world.Reading) -> Int[Array, ""]:
    r"""Row of the look-up table for a reading.

    .. math:: s = 16 \sum_{i=0}^{4} 3^i \lfloor s_i / 100 \rfloor
        + 4 \lfloor d / 200 \rfloor + \text{region}(\beta)

    with the intervals and regions of `jaxsnn.sensor_intervals`.

    Returns:
        Integer in [0, 3888).

    Source: Shim & Li (2017), section 2.4.2 and Fig. 2.4.
    """
    n = reading.sonar.shape[0]
    require(
        n == world.N_SONARS,
        f"sonar=<{n} readings>: expected {world.N_SONARS}, for whose intervals the table has its "
        "entries; take a map with so many sonars",
    )
    sonar = sensor_intervals.sonar_interval(reading.sonar)
    distance = sensor_intervals.distance_interval(reading.distance)
    region = sensor_intervals.angle_region(reading.angle)
    powers = jnp.asarray([3**i for i in range(world.N_SONARS)], jnp.int32)
    return 16 * jnp.sum(sonar * powers) + 4 * distance + region


def init(n: int) -> Float[Array, "n s a"]:
    """Tables of zeros for `n` learners.

    Raises:
        ValueError: there is no learner.
    """
    require_whole("n", n, 1, "ask for at least one learner")
    return jnp.zeros((n, N_STATES, len(ACTIONS)), jnp.float32)


def td_target(
    params: QParams, reward: Float[Array, ""], over: Array, next_values: Float[Array, "a"]
) -> Float[Array, ""]:
    r"""What the entry of the table is drawn towards.

    .. math:: r + \gamma\,(1 - \text{over}) \max_a Q(s', a)

    Symbols: :math:`\gamma` is `params.discount`; `over` is true when the step ended in arrival
    or collision; running out of steps does not end the task and keeps the second term.

    Source: Watkins & Dayan (1992).
    """
    ahead = jnp.max(next_values)
    return reward + params.discount * jnp.where(over, jnp.zeros_like(ahead), ahead)


class _Learner(NamedTuple):
    """What one learner carries from step to step, beside its table."""

    robot: world.WorldState
    row: Array  # row of the table for where it is
    trial: Array  # number of the trial
    length: Array  # path since the start of the trial
    start: Array  # [2]
    key: Array


def _begin(key: Array, trial: Array, map: world.WorldParams) -> _Learner:
    """Trial number `trial` of a learner; depends on its key and that number alone."""
    k_reset, k_act = jax.random.split(jax.random.fold_in(key, trial))
    robot = world.reset(map, key=k_reset)
    row = discretize(world.observe(map, robot))
    start = jnp.stack([robot.x, robot.y])
    return _Learner(robot, row, trial, jnp.zeros_like(robot.x), start, k_act)


def run_trials(
    params: QParams,
    map: world.WorldParams,
    tables: Float[Array, "n s a"],
    *,
    keys: Key[Array, "n"],
    n_trials: int,
    max_steps: int,
    learn: bool,
    first_trial: int | Int[Array, ""] = 0,
) -> tuple[Float[Array, "n s a"], Trials]:
    r"""Run trials of `n` independent learners on one map.

    .. math:: Q(s, a) \leftarrow Q(s, a) + \alpha\,(r + \gamma \max_{a'} Q(s', a') - Q(s, a))

    Symbols: :math:`\alpha` is `params.learning_rate`, :math:`\gamma` is `params.discount`; the
    action is random with chance `params.epsilon`, otherwise the best of the row, forward in a tie.

    Args:
        params: constants, leaves scalar or `[n]`.
        map: the map.
        tables: from `init` or an earlier call.
        keys: one typed PRNG key for each learner; trial i uses `fold_in(key, i)`.
        n_trials: trials of each learner.
        max_steps: a trial that has not ended after so many control steps has failed.
        first_trial: number of the first trial, to go on where an earlier call ended.
        learn: update the tables; set `params.epsilon` to 0 for a greedy test.

    Returns:
        (tables, Trials).

    Raises:
        ValueError, TypeError: `n_trials`, `max_steps` or `first_trial` is no such number, a
            constant is out of range, or the keys are not one typed key per table.

    Source: Shim & Li (2017), section 2.4.3 (actions, epsilon). Its rewards for Q-learning, learning
    rate and discount are not given: arrival and collision are rewarded as in section 2.2.2.1.
    """
    require_whole("n_trials", n_trials, 1, "ask for at least one trial")
    require_whole("max_steps", max_steps, 1, "allow at least one control step")
    require_count("first_trial", first_trial, 0, "count trials from 0")
    check_q(params)
    require_keys(keys)
    n = tables.shape[0]
    require(keys.shape[0] == n, f"keys=<{keys.shape[0]}>: expected {n}, one per table; split more")
    params = QParams(*(jnp.broadcast_to(jnp.asarray(leaf, tables.dtype), (n,)) for leaf in params))
    steering = jnp.asarray(ACTIONS, map.speed.dtype)
    here = jnp.arange(n)
    first = jnp.asarray(first_trial, jnp.int32)

    def one(learner: _Learner, root: Array, values: Array, q: QParams) -> tuple[Any, ...]:
        k_explore, k_action = jax.random.split(jax.random.fold_in(learner.key, learner.robot.t))
        explore = jax.random.uniform(k_explore) < q.epsilon
        random = jax.random.randint(k_action, (), 0, len(ACTIONS))
        action = jnp.where(explore, random, jnp.argmax(values).astype(random.dtype))
        robot, outcome = world.step(map, learner.robot, steering[action])
        over = outcome.collided | outcome.arrived
        reward = jnp.where(
            outcome.arrived,
            q.reward_arrival,
            jnp.where(outcome.collided, q.reward_collision, q.reward_step),
        )
        moved = jnp.hypot(robot.x - learner.robot.x, robot.y - learner.robot.y)
        after = learner._replace(
            robot=robot,
            row=discretize(world.observe(map, robot)),
            length=learner.length + moved,
        )
        ended = over | (robot.t >= max_steps)
        fresh = _begin(root, learner.trial + 1, map)
        carry = jax.tree.map(lambda a, b: jnp.where(ended, a, b), fresh, after)
        return action, reward, over, ended, outcome, after, carry

    def body(loop: tuple[_Learner, Array, Trials]) -> tuple[_Learner, Array, Trials]:
        learners, tables, trials = loop
        busy = learners.trial - first < n_trials
        values = tables[here, learners.row]
        action, reward, over, ended, outcome, after, carry = jax.vmap(one)(
            learners, keys, values, params
        )
        if learn:
            target = jax.vmap(td_target)(params, reward, over, tables[here, after.row])
            change = params.learning_rate * (target - values[here, action])
            change = jnp.where(busy, change, jnp.zeros_like(change))
            tables = tables.at[here, learners.row, action].add(change)
        # A learner that is through writes past the end, which is dropped.
        slot = jnp.where(busy & ended, learners.trial - first, n_trials)

        def write(old: Array, value: Array) -> Array:
            return old.at[here, slot].set(value, mode="drop")

        done = Trials(
            outcome.arrived, outcome.collided, after.robot.t, after.length, learners.start
        )
        return carry, tables, jax.tree.map(write, trials, done)

    def going(loop: tuple[_Learner, Array, Trials]) -> Array:
        return jnp.any(loop[0].trial - first < n_trials)

    learners = jax.vmap(lambda k: _begin(k, first, map))(keys)
    empty = Trials(
        arrived=jnp.zeros((n, n_trials), bool),
        collided=jnp.zeros((n, n_trials), bool),
        steps=jnp.zeros((n, n_trials), jnp.int32),
        length=jnp.zeros((n, n_trials), map.speed.dtype),
        start=jnp.zeros((n, n_trials, 2), map.speed.dtype),
    )
    _, tables, trials = jax.lax.while_loop(going, body, (learners, tables, empty))
    return tables, trials
