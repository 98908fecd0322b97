"""Networks that learn on one map and drive on others with their weights frozen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from snn_fusion_failure.records.detour_rows import values_of

Phase = Callable[[Any, Any, int], Any]
"""`(map, keys, trials) -> TrialResult`, leaves `[robots, trials]`."""


def drive_tests(
    maps: Sequence[Any], n_trials: int, seeds: Sequence[int], phase: Phase
) -> dict[str, list[float]]:
    """Success and path ratio of each robot over testing trials on some maps.

    Starts are those of `run_experiment` on one map; with several each map has its own.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn.experiment import phase_keys, seed_keys
    from jaxsnn.trials import start_states

    roots = jax.vmap(lambda k: phase_keys(k)[2])(seed_keys(jnp.asarray(seeds)))
    status, path, points = [], [], []
    starts = jax.jit(
        lambda map, keys: jax.vmap(lambda k: start_states(map, key=k, n_trials=n_trials))(keys)
    )
    for i, map in enumerate(maps):
        keys = jax.vmap(lambda k, i=i: jax.random.fold_in(k, i))(roots) if len(maps) > 1 else roots
        result, begin = phase(map, keys, n_trials), starts(map, keys)
        status.append(np.asarray(result.status))
        path.append(np.asarray(result.path))
        points.append(np.stack([np.asarray(begin.x), np.asarray(begin.y)], axis=-1))
    return values_of(list(maps), np.stack(status), np.stack(path), np.stack(points))


def learn_on(
    network: Any,
    params: Any,
    map: Any,
    seeds: Sequence[int],
    *,
    scenario: int = 1,
    n_learn: int = 20,
    max_steps: int = 200,
    block: int = 8,
) -> Any:
    """Networks of these seeds after learning on a map (`ways.training_map` of it).

    Args:
        network: NetworkConfig.
        params: NetworkParams.
        map: as it is tested.
        seeds: of the robots.
        scenario: whose order of start circles is taken.
        n_learn, max_steps, block: as of `experiment.make_runner`.
    """
    import jax
    import jax.numpy as jnp

    from jaxsnn.experiment import learning_circles, make_runner
    from jaxsnn.ways import training_map

    circles = learning_circles(scenario, n_learn) if network.starts == "circles" else None
    learn = make_runner(
        network, training_map(network, map), n_learn=n_learn, n_test=1, test_map=map,
        max_steps=max_steps, block=block, keep_states=True, circles=circles,
    )  # fmt: skip
    return jax.tree.map(jnp.asarray, learn(seeds, params).states)


def frozen_phase(network: Any, params: Any, states: Any, *, max_steps: int = 200) -> Phase:
    """Drives trained networks with their weights held."""
    import jax
    import jax.numpy as jnp

    from jaxsnn import agents, trials

    frozen = agents.snn_agent(network, plastic=False)
    constants = jax.tree.map(jnp.float32, agents.snn_params(network, params))

    def test(map: Any, words: Any, states: Any, constants: Any, n: int) -> Any:
        return trials.run_phase(
            frozen, constants, map, states, keys=jax.random.wrap_key_data(words), n_trials=n,
            max_steps=max_steps,
        )[1]  # fmt: skip

    compiled = jax.jit(test, static_argnums=4)

    def phase(map: Any, keys: Any, n: int) -> Any:
        return compiled(map, jax.random.key_data(keys), states, constants, n)

    return phase
