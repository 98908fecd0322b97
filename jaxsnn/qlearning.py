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

from jaxsnn import world

__all__ = [
    "ACTIONS",
    "N_STATES",
    "Params",
    "Trials",
    "default_params",
    "discretize",
    "init",
    "run_trials",
    "td_target",
]

ACTIONS = (0.0, 30.0, -30.0)  # steering of forward, left, right [deg]
N_STATES = 3**world.N_SONARS * 4 * 4

_SONAR_STEP = 100.0  # intervals 0-99, 100-199, 200-300 px
_DISTANCE_STEP = 200.0  # four equal intervals of 0-800 px


class Params(NamedTuple):
    """Constants of the learner; vmappable."""

    learning_rate: Array  # [] alpha
    discount: Array  # [] gamma
    epsilon: Array  # [] chance of a random action
    reward_arrival: Array  # []
    reward_collision: Array  # []
    reward_step: Array  # [] for each step that ends neither way


class Trials(NamedTuple):
    """What became of each trial, leaves `[learners, trials]`."""

    arrived: Array  # bool
    collided: Array  # bool; neither flag: out of steps
    steps: Array  # int32, control steps = steering movements
    length: Array  # path [px]
    start: Array  # [..., 2] where it began [px]


def default_params(
    *,
    learning_rate: float = 0.1,
    discount: float = 0.9,
    epsilon: float = 0.3,
    reward_arrival: float = 2.0,
    reward_collision: float = -2.0,
    reward_step: float = 0.0,
) -> Params:
    """Epsilon and the two rewards of the source; learning rate and discount are ours.

    Raises:
        ValueError: a rate outside its range.
    """
    for name, value, low, high in (
        ("learning_rate", learning_rate, 0.0, 1.0),
        ("discount", discount, 0.0, 1.0),
        ("epsilon", epsilon, 0.0, 1.0),
    ):
        if not low <= value <= high:
            raise ValueError(f"{name} = {value} must lie in [{low:g}, {high:g}]")
    values = (learning_rate, discount, epsilon, reward_arrival, reward_collision, reward_step)
    return Params(*(jnp.asarray(v, jnp.float32) for v in values))


def discretize(reading: world.Reading) -> Int[Array, ""]:
    r"""Row of the look-up table for a reading.

    .. math:: s = 16 \sum_{i=0}^{4} 3^i \lfloor s_i / 100 \rfloor
        + 4 \lfloor d / 200 \rfloor + \text{region}(\beta)

    with every interval number held at its last one. Regions: 0 ahead (within 45 degrees), 1 left,
    2 behind, 3 right.

    Returns:
        Integer in [0, 3888).

    Source: Shim & Li (2017), section 2.4.2 and Fig. 2.4.
    """
    sonar = jnp.clip(jnp.floor(reading.sonar / _SONAR_STEP), 0, 2).astype(jnp.int32)
    distance = jnp.clip(jnp.floor(reading.distance / _DISTANCE_STEP), 0, 3).astype(jnp.int32)
    region = jnp.floor((reading.angle + 45.0) / 90.0).astype(jnp.int32) % 4
    powers = jnp.asarray([3**i for i in range(world.N_SONARS)], jnp.int32)
    return 16 * jnp.sum(sonar * powers) + 4 * distance + region


def init(n: int) -> Float[Array, "n s a"]:
    """Tables of zeros for `n` learners.

    Raises:
        ValueError: there is no learner.
    """
    if n < 1:
        raise ValueError(f"n = {n} learners; ask for at least 1")
    return jnp.zeros((n, N_STATES, len(ACTIONS)), jnp.float32)


def td_target(
    params: Params, reward: Float[Array, ""], over: Array, next_values: Float[Array, "a"]
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

    robot: world.State
    row: Array  # row of the table for where it is
    trial: Array  # number of the trial
    length: Array  # path since the start of the trial
    start: Array  # [2]
    key: Array


def _begin(key: Array, trial: Array, params: world.Params) -> _Learner:
    """Trial number `trial` of a learner; depends on its key and that number alone."""
    k_reset, k_act = jax.random.split(jax.random.fold_in(key, trial))
    robot = world.reset(k_reset, params)
    row = discretize(world.observe(robot, params))
    start = jnp.stack([robot.x, robot.y])
    return _Learner(robot, row, trial, jnp.zeros_like(robot.x), start, k_act)


def run_trials(
    keys: Key[Array, "n"],
    tables: Float[Array, "n s a"],
    q: Params,
    params: world.Params,
    *,
    n_trials: int,
    max_steps: int,
    learn: bool,
    first_trial: int | Int[Array, ""] = 0,
) -> tuple[Float[Array, "n s a"], Trials]:
    r"""Run trials of `n` independent learners on one map.

    .. math:: Q(s, a) \leftarrow Q(s, a) + \alpha\,(r + \gamma \max_{a'} Q(s', a') - Q(s, a))

    Symbols: :math:`\alpha` is `q.learning_rate`, :math:`\gamma` is `q.discount`; the action is
    random with chance `q.epsilon`, otherwise the best of the row, forward in a tie.

    Args:
        keys: one typed PRNG key for each learner; trial i uses `fold_in(key, i)`.
        tables: from `init` or an earlier call.
        q: constants, leaves scalar or `[n]`.
        params: the map.
        n_trials: trials of each learner.
        max_steps: a trial that has not ended after so many control steps has failed.
        first_trial: number of the first trial, to go on where an earlier call ended.
        learn: update the tables; set `q.epsilon` to 0 for a greedy test.

    Returns:
        (tables, Trials).

    Raises:
        ValueError: `n_trials` or `max_steps` is below 1.

    Source: Shim & Li (2017), section 2.4.3 (actions, epsilon). Its rewards for Q-learning, learning
    rate and discount are not given: arrival and collision are rewarded as in section 2.2.2.1.
    """
    if n_trials < 1 or max_steps < 1:
        raise ValueError(f"n_trials = {n_trials} and max_steps = {max_steps} must be at least 1")
    n = tables.shape[0]
    q = Params(*(jnp.broadcast_to(leaf, (n,)) for leaf in q))
    steering = jnp.asarray(ACTIONS, params.speed.dtype)
    here = jnp.arange(n)
    first = jnp.asarray(first_trial, jnp.int32)

    def one(learner: _Learner, root: Array, values: Array, q: Params) -> tuple[Any, ...]:
        k_explore, k_action = jax.random.split(jax.random.fold_in(learner.key, learner.robot.t))
        explore = jax.random.uniform(k_explore) < q.epsilon
        random = jax.random.randint(k_action, (), 0, len(ACTIONS))
        action = jnp.where(explore, random, jnp.argmax(values).astype(random.dtype))
        robot, outcome = world.step(learner.robot, steering[action], params)
        over = outcome.collided | outcome.arrived
        reward = jnp.where(
            outcome.arrived,
            q.reward_arrival,
            jnp.where(outcome.collided, q.reward_collision, q.reward_step),
        )
        moved = jnp.hypot(robot.x - learner.robot.x, robot.y - learner.robot.y)
        after = learner._replace(
            robot=robot,
            row=discretize(world.observe(robot, params)),
            length=learner.length + moved,
        )
        ended = over | (robot.t >= max_steps)
        fresh = _begin(root, learner.trial + 1, params)
        carry = jax.tree.map(lambda a, b: jnp.where(ended, a, b), fresh, after)
        return action, reward, over, ended, outcome, after, carry

    def body(loop: tuple[_Learner, Array, Trials]) -> tuple[_Learner, Array, Trials]:
        learners, tables, trials = loop
        busy = learners.trial - first < n_trials
        values = tables[here, learners.row]
        action, reward, over, ended, outcome, after, carry = jax.vmap(one)(
            learners, keys, values, q
        )
        if learn:
            target = jax.vmap(td_target)(q, reward, over, tables[here, after.row])
            change = q.learning_rate * (target - values[here, action])
            change = jnp.where(busy, change, jnp.zeros_like(change))
            tables = tables.at[here, learners.row, action].add(change)
        # A learner that is through writes past the end, which is dropped.
        slot = jnp.where(busy & ended, learners.trial - first, n_trials)

        def write(held: Array, value: Array) -> Array:
            return held.at[here, slot].set(value, mode="drop")

        done = Trials(
            outcome.arrived, outcome.collided, after.robot.t, after.length, learners.start
        )
        return carry, tables, jax.tree.map(write, trials, done)

    def going(loop: tuple[_Learner, Array, Trials]) -> Array:
        return jnp.any(loop[0].trial - first < n_trials)

    learners = jax.vmap(lambda k: _begin(k, first, params))(keys)
    empty = Trials(
        arrived=jnp.zeros((n, n_trials), bool),
        collided=jnp.zeros((n, n_trials), bool),
        steps=jnp.zeros((n, n_trials), jnp.int32),
        length=jnp.zeros((n, n_trials), params.speed.dtype),
        start=jnp.zeros((n, n_trials, 2), params.speed.dtype),
    )
    _, tables, trials = jax.lax.while_loop(going, body, (learners, tables, empty))
    return tables, trials
