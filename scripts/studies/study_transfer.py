"""Trained on one map, tested on unseen ones; and how many trials it takes to learn.

    python scripts/studies/study_transfer.py --study maps --model S4 --seeds 32
    python scripts/studies/study_transfer.py --study trials --model S4 --seeds 32
    python scripts/studies/study_transfer.py --study trials --reading way --scenarios D1 D2 D3

`maps`: robots learn for 20 trials on a scenario or its detour reading and drive, weights frozen,
one trial on each of 100 random solvable maps that nothing was tuned on (`jaxsnn.random_map`, a key
of its own). Rows go to `results/study_snn_maps.json`: success rate per robot over the maps, per
map over the robots, and path against the shortest one.

`trials`: robots learn for 1, 2, 3, 5, 10, 20, 40 trials and are then tested, weights frozen. Rows
go to `results/study_snn_trials.json`, with the first of these numbers after which at least 90 % of
the testing trials arrive; `scripts/train_rl.py` gives the same for Q-learning and PPO.

About 5 CPU-minutes each.
"""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, Literal

from tyro.conf import arg

from snn_fusion_failure.records.detour_rows import row_name, train_map
from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    print_result,
    progress,
    repository,
    run_command,
)

CHECKPOINTS = (1, 2, 3, 5, 10, 20, 40)
MAP_KEY = 2_000_000
"""Root of the keys of the unseen maps."""


@dataclasses.dataclass(frozen=True)
class Transfer:
    """What to study."""

    study: Literal["maps", "trials"] = "maps"
    model: Annotated[Literal["S1", "S2", "S3", "S4"], arg(aliases=["--network"])] = "S4"
    reading: Annotated[str, arg(aliases=["--setting"])] = "tuned"
    scenarios: tuple[str, ...] = ("1", "2", "3")
    """Maps to learn on: 1 to 3, or D1 to D3 for their detour readings."""
    engine: Literal["xla", "native"] = "xla"
    """What computes the network's windows; native is faster (`jaxsnn.native`)."""
    seeds: int = 32
    maps: int = 100
    """Unseen maps."""
    test_trials: int = 20
    """Per checkpoint of `trials`."""
    checkpoints: tuple[int, ...] = CHECKPOINTS
    """Numbers of learning trials of `trials`; 20 is the source's."""
    max_steps: int = 200
    block: int = 8
    record: bool = True
    """Write the rows into results/."""


def _training_map(network: Any, scenario: str) -> Any:
    from jaxsnn import ways

    map = train_map(row_name(scenario))
    return ways.with_way(map) if network.guidance == "way" else map


def _network(config: Transfer) -> tuple[Any, Any]:
    from jaxsnn.presets import preset

    return preset(config.model, config.reading, config={"engine": config.engine})


def study_maps(config: Transfer, scenario: str) -> dict[str, list[float]]:
    """Percent of unseen maps solved by each robot, of robots that solve each map, path ratios."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn import agents, maps, planner, random_maps, trials
    from jaxsnn.experiment import learning_circles, phase_keys, run_experiment, seed_keys
    from jaxsnn.status import Status

    built, constants = _network(config)
    map, number = _training_map(built, scenario), int(scenario[-1])
    root = jax.random.key(MAP_KEY)
    unseen = [random_maps.random_map(key=jax.random.fold_in(root, i)) for i in range(config.maps)]
    stacked = maps.stack_maps(unseen)
    keys = seed_keys(jnp.arange(config.seeds))
    params = jax.tree.map(jnp.float32, agents.snn_params(built, constants))
    frozen = agents.snn_agent(built, plastic=False)

    @jax.jit
    def learn(keys: Any, params: Any) -> Any:
        return run_experiment(
            built, params, map, keys=keys, n_learn=20, n_test=1, max_steps=config.max_steps,
            block=config.block, circles=learning_circles(number, 20), keep_states=True,
        ).states  # fmt: skip

    def test_keys(keys: Any, i: Any) -> Any:
        return jax.vmap(lambda k: jax.random.fold_in(phase_keys(k)[2], i))(keys)

    @jax.jit
    def test(states: Any, keys: Any, params: Any, stacked: Any) -> Any:
        def one(xs: Any) -> Any:
            i, here = xs
            _, result = trials.run_phase(
                frozen, params, here, states, keys=test_keys(keys, i),
                n_trials=1, max_steps=config.max_steps,
            )  # fmt: skip
            begin = lambda k: trials.start_states(here, key=k, n_trials=1)  # noqa: E731
            starts = jax.vmap(begin)(test_keys(keys, i))
            return result.status[:, 0], result.path[:, 0], starts.x[:, 0], starts.y[:, 0]

        return jax.lax.map(one, (jnp.arange(config.maps), stacked))

    states = learn(keys, params)
    status, path, x, y = (np.asarray(v) for v in test(states, keys, params, stacked))
    arrived = status == Status.ARRIVED
    ratio = np.full(path.shape, np.nan)
    for i, here in enumerate(unseen):
        ok = arrived[i]
        if ok.any():
            starts = np.stack([x[i], y[i]], axis=-1)[ok].astype(np.float64)
            ratio[i, ok] = path[i, ok] / planner.path_field(here).lengths(starts)
    with np.errstate(invalid="ignore"):
        ratios = [float(np.nanmean(r)) for r in ratio.T if np.isfinite(r).any()]
    return {
        "sr_unseen": (100.0 * arrived.mean(axis=0)).tolist(),
        "sr_unseen_by_map": (100.0 * arrived.mean(axis=1)).tolist(),
        "collided_unseen": (100.0 * (status == Status.COLLIDED).mean(axis=0)).tolist(),
        "path_ratio": ratios,
    }


def study_trials(config: Transfer, scenario: str) -> dict[str, list[float]]:
    """SR-testing after so many learning trials, and the first number with at least 90 %."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn import agents
    from jaxsnn.experiment import learning_circles, run_experiment, seed_keys
    from jaxsnn.status import Status

    built, constants = _network(config)
    map, number = _training_map(built, scenario), int(scenario[-1])
    params = jax.tree.map(jnp.float32, agents.snn_params(built, constants))
    keys = seed_keys(jnp.arange(config.seeds))
    values: dict[str, list[float]] = {}
    columns = []
    for n in config.checkpoints:
        # Trial i depends on the key and i alone: every run repeats the shorter ones.
        run = jax.jit(
            lambda keys, params, n=n: run_experiment(
                built, params, map, keys=keys, n_learn=n, n_test=config.test_trials,
                max_steps=config.max_steps, block=config.block,
                circles=learning_circles(number, n),
            ).testing.status
        )  # fmt: skip
        column = (np.asarray(run(keys, params)) == Status.ARRIVED).mean(axis=1)
        columns.append(column)
        values[f"sr_testing_after_{n}"] = (100.0 * column).tolist()
    if config.checkpoints != CHECKPOINTS:
        return values  # the first number that suffices is known among all of them only
    reached = np.stack(columns) >= 0.9
    first = [float(CHECKPOINTS[r.argmax()]) for r in reached.T if r.any()]
    values["trials_to_90"] = first
    values["share_reaching_90"] = [100.0 * float(r.any()) for r in reached.T]
    return values


UNITS = {"path_ratio": "1", "trials_to_90": "trials"}


def shown_metric(config: Transfer) -> str:
    """The score that the progress bar and the last line show."""
    if config.study == "maps":
        return "sr_unseen"
    return f"sr_testing_after_{20 if 20 in config.checkpoints else config.checkpoints[-1]}"


def main(config: Transfer) -> dict[str, dict[str, list[float]]]:
    """Run the study on every scenario; returns the values by scenario."""
    if config.seeds < 1 or config.maps < 1:
        raise ValueError(f"seeds={config.seeds}, maps={config.maps}: expected at least 1; raise it")
    if not config.checkpoints or list(config.checkpoints) != sorted({*config.checkpoints} - {0}):
        raise ValueError(
            f"checkpoints={config.checkpoints}: expected rising numbers from 1 on; reorder them"
        )
    known = [f"{kind}{n}" for kind in ("", "D") for n in (1, 2, 3)]
    if unknown := [s for s in config.scenarios if s not in known]:
        raise ValueError(f"scenarios={unknown}: expected some of {', '.join(known)}; choose")
    enable_compilation_cache()
    run = study_maps if config.study == "maps" else study_trials
    found: dict[Any, Any] = {}
    with progress() as bar:
        task = bar.add_task(config.study, total=len(config.scenarios), status="")
        for scenario in config.scenarios:
            values = run(config, scenario)
            found[scenario] = values
            name = shown_metric(config)
            mean = sum(values[name]) / len(values[name])
            bar.update(task, advance=1, status=f"{row_name(scenario)}: {mean:.0f} %")
            if not config.record:
                continue
            model: str = config.model
            if config.reading != "tuned":
                model += f" {config.reading}"
            rows = [
                {"row": f"trained on {row_name(scenario)}", "model": model, "metric": metric,
                 "unit": UNITS.get(metric, "%"), **summarize(v)}
                for metric, v in values.items() if v
            ]  # fmt: skip
            path = repository.RESULTS / f"study_snn_{config.study}.json"
            title = {
                "maps": f"{config.maps} unseen random maps",
                "trials": "Success against the number of learning trials",
            }[config.study]
            preset = f"{config.seeds} robots"
            record_table(path, path.stem, title, rows, preset=preset)
    print_result(**fields(config, found))
    return found


def fields(config: Transfer, found: dict[str, dict[str, list[float]]]) -> dict[str, Any]:
    """What the result line says."""
    name = shown_metric(config)
    rates = {f"scenario{s}": sum(v[name]) / len(v[name]) for s, v in found.items()}
    return {"study": config.study, "metric": name, **rates}


if __name__ == "__main__":
    run_command(Transfer, main, description=__doc__)
