"""Q-learning and PPO trained and tested on one map, many independent learners at a time.

Both return one number per learner and metric, in percent, steps and trials.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from jaxsnn import navigation, planner, ppo, qlearning, world
from jaxsnn._checks import require, require_key, require_keys, require_whole
from jaxsnn.way import WayLength

# Greedy tests of the Q-learner after so many training trials, each a multiple of the chunk before
# it.
CHECKPOINTS = (20, 40, 60, 80, 100, 200, 300, 500, 1000, 2000)
# Path ratios are planned on the host for so many testing trials of each seed.
PLANNED = 10
# PPO where the straight way fails (D1 to D3, families), with a reward along the shortest way: more
# robots and a wider first policy than on Scenarios 1-3, where exploring costs nothing.
DETOUR_PPO = ppo.PPOConfig(n_envs=32, n_steps=128, n_updates=100, n_minibatches=8, initial_std=0.8)
DETOUR_PPO_PARAMS = ppo.PPOParams(learning_rate=1e-3)


def learner_keys(seed: int, map_number: int, n: int) -> tuple[Key[Array, ""], Key[Array, " n"]]:
    """Root key of a map, and a key for each learner on it."""
    root = jax.random.fold_in(jax.random.key(seed), map_number)
    return root, jax.vmap(lambda i: jax.random.fold_in(root, i))(jnp.arange(n))


def _path_ratio(map: world.WorldParams, start: Any, length: Any, arrived: Any) -> list[float]:
    """Mean over successful testing trials of path / shortest path, one number for each learner."""
    field = planner.path_field(map)
    ratios = []
    for s, n, ok in zip(start[:, :PLANNED], length[:, :PLANNED], arrived[:, :PLANNED], strict=True):
        if ok.any():
            ratios.append(float(np.mean(n[ok] / field.lengths(s[ok]))))
    return ratios


_run_trials = jax.jit(qlearning.run_trials, static_argnames=("n_trials", "max_steps", "learn"))


def train_qlearning(
    params: qlearning.QParams,
    map: world.WorldParams,
    *,
    key: Key[Array, ""],
    learners: int,
    n_train: int = 2000,
    n_test: int = 100,
    max_steps: int = 200,
    test_epsilon: float = 0.0,
) -> dict[str, list[float]]:
    """Train tables for `n_train` trials, with greedy tests on the way (`CHECKPOINTS`).

    Args:
        params: QParams.
        map: the map.
        key: root of the learners' keys.
        learners: how many, each with its own table.
        n_train: training trials, a checkpoint.
        n_test: testing trials of each test.
        max_steps: control steps after which a trial has failed.
        test_epsilon: chance of a random action in testing.

    Returns:
        metric -> one value for each learner; `trials_to_90` only of those that get there,
        `share_reaching_90` says how many do.

    Raises:
        ValueError, TypeError: `key` is not one typed key, or there is no learner or trial.
    """
    require_key(key)
    for name, count in (("learners", learners), ("n_train", n_train), ("n_test", n_test)):
        require_whole(name, count, 1, "ask for at least one")
    params = qlearning.QParams(*(jnp.asarray(v, jnp.float32) for v in params))
    greedy = params._replace(epsilon=jnp.float32(test_epsilon))
    seeds = jnp.arange(learners)
    train_keys, test_keys = (
        jax.vmap(lambda i, k=k: jax.random.fold_in(jax.random.fold_in(key, k), i))(seeds)
        for k in (0, 1)
    )
    tables, done = qlearning.init(learners), 0
    phases, tested = [], {}
    while done < n_train:
        chunk = 20 if done < 100 else 100
        tables, trials = _run_trials(
            params, map, tables, keys=train_keys,
            n_trials=chunk, max_steps=max_steps, learn=True, first_trial=done,
        )  # fmt: skip
        phases.append(jax.tree.map(np.asarray, trials))
        done += chunk
        if done in CHECKPOINTS:
            _, test = _run_trials(
                greedy, map, tables, keys=test_keys,
                n_trials=n_test, max_steps=max_steps, learn=False,
            )  # fmt: skip
            tested[done] = jax.tree.map(np.asarray, test)
    training = jax.tree.map(lambda *a: np.concatenate(a, axis=1), *phases)
    curve = np.stack([t.arrived.mean(axis=1) for t in tested.values()], axis=1)
    enough = curve >= 0.9
    first = np.where(enough.any(1), np.asarray(list(tested))[enough.argmax(1)], np.inf)
    final = tested[done]
    values = {
        "sr_learning": (100.0 * training.arrived.mean(axis=1)).tolist(),
        "sr_testing": (100.0 * final.arrived.mean(axis=1)).tolist(),
        # The source reports Q-learning's N_mv on its training trials.
        "n_mv": training.steps.mean(axis=1).tolist(),
        "n_mv_testing": final.steps.mean(axis=1).tolist(),
        "path_ratio": _path_ratio(map, final.start, final.length, final.arrived),
        **_reaching_90(first),
        "training_trials": [float(n_train)] * learners,
        "sr_learning_first_20": (100.0 * training.arrived[:, :20].mean(axis=1)).tolist(),
    }
    for n, column in zip(tested, curve.T, strict=True):
        values[f"sr_testing_after_{n}"] = (100.0 * column).tolist()
    return values


def _reaching_90(first: np.ndarray) -> dict[str, list[float]]:
    """Trials of the learners that got to 90 % (`inf`: never), and the share of those that did."""
    reached = np.isfinite(first)
    return {
        "trials_to_90": first[reached].tolist(),
        "share_reaching_90": (100.0 * reached).tolist(),
    }


@functools.cache
def _ppo_program(config: ppo.PPOConfig, n_test: int, max_steps: int) -> Any:
    """Training and testing of all learners; maps and constants are arguments, keys raw words."""

    def one(
        words: Array, params: ppo.PPOParams, map: world.WorldParams, way: WayLength | None
    ) -> tuple[Any, ...]:
        env = navigation.navigation_env(map, max_steps=max_steps, way=way)
        k_train, k_test = jax.random.split(jax.random.wrap_key_data(words))
        result = ppo.make_train(config, env)(params, key=k_train)
        keys = jax.random.split(k_test, n_test)
        final, success, _ = ppo.evaluate(
            config, env, result.weights, keys=keys, max_steps=max_steps
        )
        robot = final.robot._replace(key=jax.random.key_data(final.robot.key))
        return result.metrics, final._replace(robot=robot), success

    return jax.jit(jax.vmap(one, (0, None, None, None)))


@functools.partial(jax.jit, static_argnames=("config", "max_steps"))
def ppo_policies(
    config: ppo.PPOConfig,
    params: ppo.PPOParams,
    map: world.WorldParams,
    way: WayLength | None,
    *,
    keys: Key[Array, " n"],
    max_steps: int = 200,
) -> ppo.Result:
    """Train one policy per key on a map; with `way` the reward counts progress along the way."""
    require_keys(keys)
    env = navigation.navigation_env(map, max_steps=max_steps, way=way)
    train = ppo.make_train(config, env)
    return jax.vmap(lambda k: train(params, key=k))(keys)


@functools.partial(jax.jit, static_argnames=("config", "max_steps"))
def drive_policies(
    config: ppo.PPOConfig,
    map: world.WorldParams,
    weights: Any,
    *,
    keys: Key[Array, " n trials"],
    max_steps: int = 200,
) -> qlearning.Trials:
    """Trials without exploration of trained policies `[n, ...]`, leaves `[n, trials]`."""
    shape = jnp.shape(keys)
    require(
        len(shape) == 2, f"keys=<shape {shape}>: expected [policies, trials]; split each one's key"
    )
    env = navigation.navigation_env(map, max_steps=max_steps)

    def one(weights: Any, keys: Array) -> qlearning.Trials:
        end, success, over = ppo.evaluate(config, env, weights, keys=keys, max_steps=max_steps)
        return qlearning.Trials(success, over & ~success, end.robot.t, end.length, end.start)

    return jax.vmap(one)(weights, keys)


def train_ppo(
    config: ppo.PPOConfig,
    params: ppo.PPOParams,
    map: world.WorldParams,
    *,
    keys: Key[Array, " n"],
    n_test: int = 100,
    max_steps: int = 200,
    way: WayLength | None = None,
) -> dict[str, list[float]]:
    """Train one policy per key, then drive `n_test` trials without exploration.

    Args:
        config: PPOConfig.
        params: PPOParams.
        map: the map.
        keys: one for each learner.
        n_test: testing trials of each.
        max_steps: control steps after which a trial has failed.
        way: from `ways.way_length`; the reward counts progress along it. Nothing else sees it.

    Returns:
        metric -> one value for each learner; `trials_to_90` only of those that get there,
        `share_reaching_90` says how many do.

    Raises:
        ValueError, TypeError: keys are not typed keys along one axis, or there is no trial.
    """
    require_keys(keys)
    require_whole("n_test", n_test, 1, "ask for at least one trial")
    program = _ppo_program(config, n_test, max_steps)
    params = jax.tree.map(jnp.float32, params)
    metrics, states, success = jax.tree.map(
        np.asarray, program(jax.random.key_data(keys), params, map, way)
    )
    episodes, successes = metrics.episodes.cumsum(1), metrics.successes.cumsum(1)
    return {
        "sr_learning": (100.0 * successes[:, -1] / episodes[:, -1]).tolist(),
        "sr_testing": (100.0 * success.mean(axis=1)).tolist(),
        "n_mv": states.robot.t.mean(axis=1).tolist(),
        "path_ratio": _path_ratio(map, states.start, states.length, success),
        **_reaching_90(_trials_to_90(episodes, successes)),
        "training_trials": episodes[:, -1].astype(float).tolist(),
    }


def _trials_to_90(episodes: np.ndarray, successes: np.ndarray) -> np.ndarray:
    """Training trials until 90 % of the latest updates that hold at least 20 trials arrived.

    Args:
        episodes, successes: of each learner up to each update, `[n, updates]`.

    Returns:
        One number for each learner, `inf` where that never happened.
    """
    first = np.full(len(episodes), np.inf)
    for learner, (e, s) in enumerate(zip(episodes, successes, strict=True)):
        for i in range(len(e)):
            j = int(np.searchsorted(e, e[i] - 20, side="right")) - 1
            before = (e[j], s[j]) if j >= 0 else (0, 0)
            if e[i] - before[0] >= 20 and (s[i] - before[1]) >= 0.9 * (e[i] - before[0]):
                first[learner] = e[i]
                break
    return first
