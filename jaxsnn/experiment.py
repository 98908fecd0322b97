"""The experiment of chapter 2: robots learn, then are tested; seeds, starts and phases.

Seed `i` is the same robot in every table and study: its key, its first weights and its starts
depend on `i` alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key

from jaxsnn import network, planner, world
from jaxsnn._checks import require, require_keys, require_mapped, require_whole
from jaxsnn.agents import Agent, RewardFunction, snn_agent, snn_params
from jaxsnn.config import NetworkConfig, NetworkParams, Weights
from jaxsnn.network import NetworkState
from jaxsnn.phases import run_phases
from jaxsnn.trials import TrialResult, given_circles, run_phase, start_states

TEST_TRIALS = {1: 30, 2: 20, 3: 20}
"""Testing trials of each scenario in the source (section 2.5)."""


def seed_keys(seeds: Int[Array, " n"] | Sequence[int]) -> Key[Array, " n"]:
    """Key of each seed: the same robot in every table and study."""
    root = jax.random.key(0)
    return jax.vmap(lambda i: jax.random.fold_in(root, i))(jnp.asarray(seeds, jnp.int32))


def learning_circles(scenario: int, n_learn: int) -> Int[Array, " trials"] | None:
    """Start circles of the learning trials: Scenario 2's in turn, as the source; None is random."""
    require_whole("n_learn", n_learn, 0, "give 0 for none")
    return jnp.arange(n_learn, dtype=jnp.int32) % 2 if scenario == 2 else None


def phase_keys(robot_key: Key[Array, ""]) -> Key[Array, " 4"]:
    """Keys of a robot's first weights, learning, testing, and testing with plasticity left on."""
    return jax.random.split(robot_key, 4)


class Experiment(NamedTuple):
    """A learning phase, a testing phase with frozen weights and, if asked for, one without."""

    learning: TrialResult
    testing: TrialResult
    online: TrialResult | None
    states: Any


def run_experiment(
    config: NetworkConfig | None,
    params: Any,
    map: world.WorldParams,
    *,
    keys: Key[Array, " robots"],
    n_learn: int = 20,
    n_test: int = 30,
    n_online: int = 0,
    max_steps: int = 200,
    block: int = 8,
    circles: Int[Array, " trials"] | Sequence[int] | None = None,
    weights: Weights | None = None,
    states: Any = None,
    params_axis: Any = None,
    map_axis: Any = None,
    test_map: world.WorldParams | None = None,
    record: bool = False,
    keep_states: bool = False,
    reward: RewardFunction | None = None,
    agents: tuple[Agent, Agent] | None = None,
) -> Experiment:
    """Robots learn, then are tested: both phases of all robots in one program.

    Args:
        config: NetworkConfig; None with `agents`.
        params: SNNParams, or what `agents` take.
        map: the map to learn on.
        keys: one per robot (an independent run each).
        n_learn, n_test: trials of the two phases; weights are frozen in testing. With 0 a phase
            is left out: its results have no trials, and a rate of them is NaN.
        n_online: testing trials with plasticity left on, a second reading of the source.
        max_steps: control steps after which a trial is given up.
        block: robots that run together; see the module's docstring.
        circles: start circle of each learning trial; drawn at random when not given or negative.
        weights: first weights, leaves `[robots, ...]`; drawn at random when not given.
        states: networks to go on with, leaves `[robots, ...]`, from `saved.load_networks` or an
            earlier experiment; instead of `weights`.
        params_axis, map_axis: 0 when each robot has its own, a tree for some leaves only, as in
            `jax.vmap`; no other axis.
        test_map: the map to test on; `map` when not given. Shares `map_axis`.
        record: keep the poses.
        keep_states: return the networks after learning (0.4 MB per robot).
        reward: a function of one's own in place of the rewards on the way, see `agents.snn_agent`.
        agents: learner and tester of one's own, instead of the network of `config`; they share
            the state that the learner's `init` makes, and `params` are theirs.

    Returns:
        Experiment; leaves lead with robots.

    Raises:
        ValueError, TypeError: there is no robot, no trial in any phase or no step, or `block` is
            not positive; keys, circles, weights, states or what each robot has for itself do not
            fit.
    """
    require_keys(keys)
    for name, count in (("n_learn", n_learn), ("n_test", n_test)):
        require_whole(name, count, 0, "give 0 to leave the phase out")
    require_whole("block", block, 1, "run at least one robot per block")
    require_whole("n_online", n_online, 0, "give 0 for none")
    require(
        n_learn + n_test + n_online > 0,
        "n_learn=0, n_test=0, n_online=0: expected a trial in one of them; raise one",
    )
    circles = given_circles(map, circles, n_learn)
    robots = keys.shape[0]
    require(
        agents is None or (reward is None and weights is None),
        "agents, reward, weights: expected no reward and no weights beside agents; they have both",
    )
    require(
        weights is None or states is None,
        "weights, states: expected one of them; the states hold weights",
    )
    # Agents of one's own, or a second map, need not be of the form of the first.
    one_loop = agents is None and test_map is None
    if agents is None:
        if config is None:
            raise ValueError("config=None: expected a NetworkConfig; or give agents of your own")
        given = weights if states is None else states.weights
        if given is not None:
            network.check_weights(config, params.network, given, robots)
        agents = snn_agent(config, reward=reward), snn_agent(config, plastic=False)
    learner, frozen = agents
    tested_on = map if test_map is None else test_map
    require_mapped("weights", 0, weights, robots)
    require_mapped("states", 0, states, robots)
    require_mapped("params", params_axis, params, robots)
    require_mapped("map", map_axis, map, robots)
    require_mapped("test_map", map_axis, tested_on, robots)

    def run(
        robot_keys: Array, weights: Any, states: Any, params: Any, map: Any, test_map: Any
    ) -> Experiment:
        split = jax.vmap(phase_keys)(robot_keys)
        if states is None:
            states = jax.vmap(learner.init, in_axes=(0, params_axis))(split[:, 0], params)
        if weights is not None:
            states = states._replace(weights=weights)
        axes = {"params_axis": params_axis, "map_axis": map_axis, "max_steps": max_steps}
        if one_loop and config is not None:
            agent = functools.partial(snn_agent, config, reward=reward)
            counts = (n_learn, n_test, n_online) if n_online else (n_learn, n_test)
            states, phases = run_phases(
                lambda learns: agent(plastic=learns),
                params, map, states, keys=split[:, 1 : 1 + len(counts)], n_trials=counts,
                plastic=(True, False, True)[: len(counts)], circles=circles, record=record, **axes,
            )  # fmt: skip
            online = phases[2] if n_online else None
            return Experiment(phases[0], phases[1], online, states if keep_states else None)

        def phase(
            number: int, agent: Agent, map: Any, states: Any, n: int, circles: Any = None
        ) -> tuple[Any, TrialResult]:
            after, result = run_phase(
                agent, params, map, states, keys=split[:, number], n_trials=max(n, 1),
                run=None if n else 0, circles=circles if n else None, record=record, **axes,
            )  # fmt: skip
            return after, result if n else jax.tree.map(lambda x: x[:, :0], result)

        states, learning = phase(1, learner, map, states, n_learn, circles)
        _, testing = phase(2, frozen, test_map, states, n_test)
        online = None
        if n_online:
            _, online = phase(3, learner, test_map, states, n_online)
        return Experiment(learning, testing, online, states if keep_states else None)

    block = min(block, robots)
    n_blocks = -(-robots // block)
    # The last block is filled up with robots from the front, which are dropped again.
    order = jnp.arange(n_blocks * block) % robots
    trees = (keys, weights, states, params, map, tested_on)
    leaves, form = jax.tree.flatten(trees)
    own = _mapped((0, 0, 0, params_axis, map_axis, map_axis), trees)
    cut = [
        x[order].reshape(n_blocks, block, *x.shape[1:])
        for x, o in zip(leaves, own, strict=True)
        if o
    ]

    def one_block(cut: list[Array]) -> Experiment:
        rest = iter(cut)
        filled = [next(rest) if o else x for x, o in zip(leaves, own, strict=True)]
        return run(*jax.tree.unflatten(form, filled))

    out = jax.lax.map(one_block, cut)
    return jax.tree.map(lambda x: x.reshape(n_blocks * block, *x.shape[2:])[:robots], out)


def _mapped(axes: Any, tree: Any) -> list[bool]:
    """For each leaf of `tree`: has each robot its own, by the prefix tree `axes` of 0 and None."""
    full = jax.tree.map(
        lambda axis, part: jax.tree.map(lambda _: axis is not None, part),
        axes, tree, is_leaf=lambda axis: axis is None,
    )  # fmt: skip
    return jax.tree.leaves(full)


def make_runner(
    config: NetworkConfig,
    map: world.WorldParams,
    *,
    n_learn: int = 20,
    n_test: int = 20,
    n_online: int = 0,
    max_steps: int = 200,
    block: int = 8,
    circles: Int[Array, " trials"] | Sequence[int] | None = None,
    test_map: world.WorldParams | None = None,
    record: bool = False,
    keep_states: bool = False,
) -> Callable[..., Experiment]:
    """A compiled `(seeds, params, weights=None, states=None) -> Experiment` of numpy arrays.

    `params` are NetworkParams; changing them compiles nothing anew. The other arguments are those
    of `run_experiment`.
    """

    @jax.jit
    def run(
        numbers: Array, params: NetworkParams, weights: Weights | None, states: NetworkState | None
    ) -> Experiment:
        return run_experiment(
            config, snn_params(config, params), map, keys=seed_keys(numbers),
            n_learn=n_learn, n_test=n_test, n_online=n_online, max_steps=max_steps, block=block,
            circles=circles, weights=weights, states=states, test_map=test_map, record=record,
            keep_states=keep_states,
        )  # fmt: skip

    def call(
        seeds: Sequence[int],
        params: NetworkParams,
        weights: Weights | None = None,
        states: NetworkState | None = None,
    ) -> Experiment:
        params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)
        out = run(jnp.asarray(seeds, jnp.int32), params, weights, states)
        return jax.tree.map(np.asarray, out)

    return call


def shortest_paths(map: world.WorldParams, seeds: Sequence[int], n_test: int) -> np.ndarray:
    """Shortest collision-free path [px] from each testing start of each seed, `[seeds, n_test]`.

    To the arrival circle, as `planner.path_field` measures it.
    """

    @jax.jit
    def starts(seeds: Array) -> Array:
        found = jax.vmap(lambda k: start_states(map, key=phase_keys(k)[2], n_trials=n_test))(
            seed_keys(seeds)
        )
        return jnp.stack([found.x, found.y], axis=-1)

    require_whole("n_test", n_test, 1, "ask for at least one testing start")
    field = planner.path_field(map)
    positions = np.asarray(starts(jnp.asarray(seeds, jnp.int32)), np.float64)
    return np.stack([field.lengths(p) for p in positions])
