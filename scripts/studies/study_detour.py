"""Maps on which drivers that learn nothing fail: every driver and learner in one table.

    python scripts/studies/study_detour.py --models blind reflex_60 reflex_100 q_learning
    python scripts/studies/study_detour.py --models S4 S4_literal S1 S2 S3 --seeds 16
    python scripts/studies/study_detour.py --models S2_way --seeds 64 --engine native
    python scripts/studies/study_detour.py --models S4_way --seeds 8 --choose

Rows are the three scenarios, their detour readings D1 to D3 (`jaxsnn.scenarios.detour`) and the
held-out detour family: there a learner trains on one map of the family's training split and drives
on maps of its test split that nothing was tuned on, weights or table frozen. Metrics: `sr_testing`
after the source's 20 learning trials (2,000 for Q-learning, about 10,000 for PPO, whose reward
counts progress along the shortest way), `sr_testing_60_trials` with `--learn-trials 60`, and
`path_ratio` of the trials that arrived. `S1` to `S4` are the reading "tuned", `S1_literal` to
`S4_literal` the source's, `S4_guided` the one with a graded reward, `S4_way` the one whose trainer
knows the way, as PPO's, `S4_critic` that one with a critic.
Networks use the seeds of the tables of record from 0 on. `--choose` trains on several maps of the
training split, one after the other, and drives on maps of the validation split, which says what a
map is worth as a teacher (`results/study_detour_choice.json`).

The networks "S2_way" and "S4_way" are compared with the drivers, with the same networks under the
additive rule and with each other robot by robot (`comparisons`: paired t tests, Holm's correction
over all of them). Rows go to `results/study_detour.json` as each one ends; one that is there
already with as many seeds is skipped, so the study can be broken off and gone on with. Drivers take
seconds, Q-learning two CPU-minutes per row, a network two CPU-seconds per seed and row, with
`--engine native` one.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from typing import Any, Literal

from snn_fusion_failure.records.detour_rows import (
    ROWS,
    is_family,
    tested_maps,
    train_map,
    trials_per_map,
    values_of,
)
from snn_fusion_failure.records.detour_runs import drive_tests, frozen_phase, learn_on
from snn_fusion_failure.records.rows import Compared, record_table, recorded, summarize
from snn_fusion_failure.runs import enable_compilation_cache, progress, repository, run_command
from snn_fusion_failure.runs.origin import check_recordable

DRIVERS = ("blind", "reflex_60", "reflex_100")
NETWORKS = (
    *("S1", "S2", "S3", "S4", "S4_guided", "S3_guided"),
    *("S1_literal", "S2_literal", "S3_literal", "S4_literal"),
    *("S1_way", "S2_way", "S3_way", "S4_way"),
    *("S2_critic", "S4_critic"),
)
LEARNERS = ("q_learning", "ppo")
UNITS = {"path_ratio": "1"}
# Robot by robot, same seeds and starts: the networks against drivers that learn nothing, the
# multiplicative rule against the additive one, and inhibition against none.
COMPARED = Compared(
    "sr_testing",
    (
        *((network, driver) for network in ("S2_way", "S4_way") for driver in DRIVERS),
        *(("S2_way", "S1_way"), ("S4_way", "S3_way"), ("S4_way", "S2_way")),
    ),
)
TITLE = "Drivers and learners on maps that need a detour"


@dataclasses.dataclass(frozen=True)
class Study:
    """Fill the table of detours."""

    models: tuple[str, ...] = (*DRIVERS, *LEARNERS, "S4_way", "S4_guided", "S4", "S4_literal")
    rows: tuple[str, ...] = ROWS
    seeds: int = 16
    """Robots, or learners of Q-learning."""
    test_trials: int = 20
    learn_trials: int = 20
    """Of the networks: 20 (the source) or 60 for the second column."""
    family_maps: int = 20
    """Unseen maps of the family, one trial of each robot on each."""
    choose: bool = False
    """Train on maps of the training split, test on maps of the validation split."""
    teachers: int = 8
    """Training maps that are compared (`--choose`)."""
    max_steps: int = 200
    block: int = 8
    engine: Literal["xla", "native"] = "xla"
    """What computes the networks' windows; native is faster (`jaxsnn.native`)."""
    max_minutes: float = 25.0
    """No row is begun after so many minutes of CPU time."""


def _tests(config: Study, row: str) -> tuple[int, list[Any]]:
    """Trials on each map of the test of a row, and these maps."""
    split = "validation" if config.choose else "test"
    return trials_per_map(row, config.test_trials), tested_maps(row, config.family_maps, split)


def _seeds(config: Study) -> range:
    # A choice is made with seeds that no table of record has.
    first = 1000 if config.choose else 0
    return range(first, first + config.seeds)


def run_driver(config: Study, model: str, row: str) -> dict[str, list[float]]:
    """A driver that learns nothing, from the networks' own starts."""
    import jax
    import jax.numpy as jnp

    from jaxsnn.drivers import DRIVERS as PARAMS
    from jaxsnn.drivers import drive

    params = jax.tree.map(jnp.float32, PARAMS[model])

    def phase(map: Any, keys: Any, n: int) -> Any:
        return drive(params, map, keys=keys, n_trials=n, max_steps=config.max_steps)

    n, maps = _tests(config, row)
    return drive_tests(maps, n, _seeds(config), phase)


def run_network(config: Study, model: str, row: str) -> dict[str, list[float]]:
    """A spiking network: learning on the row's map, testing with frozen weights."""
    from jaxsnn.presets import preset

    name, _, reading = model.partition("_")
    network, params = preset(name, reading or "tuned")
    network = dataclasses.replace(network, engine=config.engine)
    states = learn_on(
        network, params, train_map(row), _seeds(config),
        scenario=1 if is_family(row) else int(row[-1]), n_learn=config.learn_trials,
        max_steps=config.max_steps, block=config.block,
    )  # fmt: skip
    n, maps = _tests(config, row)
    phase = frozen_phase(network, params, states, max_steps=config.max_steps)
    return drive_tests(maps, n, _seeds(config), phase)


def run_q_learning(config: Study, model: str, row: str) -> dict[str, list[float]]:
    """Tables trained for 2,000 trials on the row's map, greedy in testing."""
    import jax
    import jax.numpy as jnp

    from jaxsnn import learners, qlearning

    run = jax.jit(qlearning.run_trials, static_argnames=("n_trials", "max_steps", "learn"))
    params = qlearning.QParams(*(jnp.float32(v) for v in qlearning.QParams()))
    keys = jax.random.split(jax.random.key(31), config.seeds)
    tables, map = qlearning.init(config.seeds), train_map(row)
    for done in range(0, learners.CHECKPOINTS[-1], 100):
        tables, _ = run(
            params, map, tables, keys=keys, n_trials=100, max_steps=config.max_steps,
            learn=True, first_trial=done,
        )  # fmt: skip
    greedy = params._replace(epsilon=jnp.float32(0.0))

    def drive(map: Any, key: Any, n: int) -> Any:
        keys = jax.random.split(key, config.seeds)
        return run(
            greedy, map, tables, keys=keys, n_trials=n, max_steps=config.max_steps, learn=False
        )[1]

    return _test_learners(config, row, drive)


def run_ppo(config: Study, model: str, row: str) -> dict[str, list[float]]:
    """Policies trained with a reward along the shortest way; sonars and angle are all they see."""
    import jax
    import jax.numpy as jnp

    from jaxsnn import learners, ways

    sizes, map = learners.DETOUR_PPO, train_map(row)
    params = jax.tree.map(jnp.float32, learners.DETOUR_PPO_PARAMS)
    weights = learners.ppo_policies(
        sizes, params, map, ways.way_length(map),
        keys=jax.random.split(jax.random.key(41), config.seeds), max_steps=config.max_steps,
    ).weights  # fmt: skip

    def drive(map: Any, key: Any, n: int) -> Any:
        keys = jax.random.split(key, (config.seeds, n))
        return learners.drive_policies(sizes, map, weights, keys=keys, max_steps=config.max_steps)

    return _test_learners(config, row, drive)


def _test_learners(config: Study, row: str, drive: Any) -> dict[str, list[float]]:
    """Test `drive(map, key, n_trials) -> qlearning.Trials` on the test maps of a row."""
    import jax
    import numpy as np

    from jaxsnn.status import Status

    n, maps = _tests(config, row)
    done = [drive(m, jax.random.key(37 + i), n) for i, m in enumerate(maps)]
    status = np.where(np.stack([d.arrived for d in done]), Status.ARRIVED, Status.TIMEOUT)
    return values_of(
        maps, status, np.stack([d.length for d in done]), np.stack([d.start for d in done])
    )


def runner(model: str) -> Any:
    """What runs a model."""
    if model in DRIVERS:
        return run_driver
    return {"q_learning": run_q_learning, "ppo": run_ppo}.get(model, run_network)


def main(config: Study) -> dict[str, float]:
    """Run the cells that are missing; returns success by model and row."""
    known = (*DRIVERS, *LEARNERS, *NETWORKS)
    for name, given, allowed in (("models", config.models, known), ("rows", config.rows, ROWS)):
        if unknown := [g for g in given if g not in allowed]:
            raise ValueError(f"{name}={unknown}: expected some of {list(allowed)}; choose")
    if config.learn_trials not in (20, 60):
        raise ValueError(f"learn_trials={config.learn_trials}: expected 20 or 60; choose one")
    check_recordable()
    enable_compilation_cache()
    chosen_by = "_choice" if config.choose else ""
    path = repository.RESULTS / f"study_detour{chosen_by}.json"
    title = f"{TITLE}: what training maps are worth on validation maps" if config.choose else TITLE
    teachers = tuple(f"detour/train/{i}" for i in range(config.teachers))
    rows = teachers if config.choose else config.rows
    held = {(r["model"], r["row"], r["metric"]) for r in recorded(path) if r["n"] >= config.seeds}
    metric = "sr_testing" if config.learn_trials == 20 else "sr_testing_60_trials"
    cells = [(m, r) for m in config.models for r in rows if (m, r, metric) not in held]
    start, found = time.process_time(), {}
    record: Any = functools.partial(
        record_table, path, path.stem, title, preset=f"{config.seeds} robots", compared=[COMPARED]
    )
    if not cells:
        record([])  # what is compared is worked out anew from the rows that are there
    with progress() as bar:
        task = bar.add_task("cells", total=len(cells), status="")
        for model, row in cells:
            if time.process_time() - start > 60 * config.max_minutes:
                break
            values = runner(model)(config, model, row)
            if config.learn_trials != 20:
                values = {metric: values["sr_testing"]}
            new = [
                {"row": row, "model": model, "metric": name, "unit": UNITS.get(name, "%"),
                 **summarize(v)}
                for name, v in values.items() if v
            ]  # fmt: skip
            record(new)
            found[f"{model} {row}"] = sum(values[metric]) / len(values[metric])
            bar.update(task, advance=1, status=f"{model}, {row}: {found[f'{model} {row}']:.0f} %")
            print(model, row, round(found[f"{model} {row}"], 1), flush=True)
    return found


def fields(done: dict[str, float]) -> dict[str, Any]:
    """What the result line says."""
    best = max(done, key=lambda name: done[name], default="none")
    return {"cells": len(done), "best": best.replace(" ", "_")}


if __name__ == "__main__":
    run_command(Study, main, description=__doc__, fields=fields)
