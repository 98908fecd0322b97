"""Learning that goes on: a sonar dies, the map changes, a motor weakens; plasticity on and off.

    python scripts/studies/study_lifelong.py --models blind reflex_60 reflex_100
    python scripts/studies/study_lifelong.py --models S4_way S4_guided --seeds 16

A robot learns 20 trials on a map and is tested there with frozen weights (`sr_before`). Then
something changes: `dead sonar`, the inner left sonar reports an obstacle at 20 px for ever (one
that reports its full range costs a fixed rule nothing on these maps: 95 to 100 % stay); `new map`,
another map; `weak motor`, the right motor makes 80 % of its rate. `sr_after_frozen` is success in
the changed world without a change of the weights, `sr_after_plastic` after 20 more learning trials
in it, from the same starts, weights frozen in the test, and `sr_fresh` that of a naive network
after 20 trials in the changed world alone. Drivers have nothing to learn: their numbers after the
change are the same. Rows go to `results/study_lifelong.json` as each one ends and are skipped when
they are there with as many seeds. About 40 CPU-seconds per robot and row.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

from snn_fusion_failure.records.rows import record_table, recorded, summarize
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    progress,
    repository,
    run_command,
)
from snn_fusion_failure.runs.origin import check_recordable

ROWS = ("dead sonar", "new map", "weak motor")
METRICS = ("sr_before", "sr_after_plastic", "sr_after_frozen", "sr_fresh")
DEAD, STUCK, WEAK = 1, 20.0, 0.8
TITLE = "Learning that goes on after the world has changed"


@dataclasses.dataclass(frozen=True)
class Study:
    """Fill the table of changes."""

    models: tuple[str, ...] = ("blind", "reflex_60", "reflex_100", "S4_way", "S4_guided", "S4")
    rows: tuple[str, ...] = ROWS
    seeds: int = 16
    map: str = "S3"
    """Where the robots learn: S1 to S3, D1 to D3 or FAMILY/SPLIT/NUMBER."""
    new_map: str = "D3"
    """The map of the row `new map`."""
    trials: int = 20
    """Of each phase."""
    max_steps: int = 200
    block: int = 8
    max_minutes: float = 20.0
    """No row is begun after so many minutes of CPU time."""


def changed_map(config: Study, row: str, before: Any) -> Any:
    """The map after the change."""
    from jaxsnn.map_files import named_map

    if row == "new map":
        return named_map(config.new_map)
    if row == "dead sonar":
        return before._replace(
            sonar_failed=before.sonar_failed.at[DEAD].set(True),
            sonar_stuck=before.sonar_stuck.at[DEAD].set(STUCK),
        )
    return before


def run_driver(config: Study, model: str, row: str) -> dict[str, list[float]]:
    """A driver with a rule; a weak right motor makes less of its turns to the left."""
    import jax
    import jax.numpy as jnp

    from jaxsnn.drivers import DRIVERS, drive
    from jaxsnn.experiment import phase_keys, seed_keys
    from jaxsnn.map_files import named_map
    from jaxsnn.trials import success_rate

    params, before = jax.tree.map(jnp.float32, DRIVERS[model]), named_map(config.map)
    keys = jax.vmap(lambda k: phase_keys(k)[2])(seed_keys(range(config.seeds)))
    weak = params._replace(left=jnp.float32(WEAK)) if row == "weak motor" else params

    def success(params: Any, map: Any) -> list[float]:
        result = drive(params, map, keys=keys, n_trials=config.trials, max_steps=config.max_steps)
        return [100.0 * float(x) for x in success_rate(result)]

    after = success(weak, changed_map(config, row, before))
    return dict(zip(METRICS, (success(params, before), after, after, after), strict=True))


def run_network(config: Study, model: str, row: str) -> dict[str, list[float]]:
    """A spiking network: 20 trials, the change, 20 trials with plasticity and none without."""
    import jax
    import jax.numpy as jnp

    from jaxsnn import agents, preset, run_experiment, success_rate
    from jaxsnn.experiment import phase_keys, seed_keys
    from jaxsnn.map_files import named_map
    from jaxsnn.trials import run_phase
    from jaxsnn.ways import training_map

    name, _, reading = model.partition("_")
    network, params = preset(name, reading or "tuned")
    before, n = training_map(network, named_map(config.map)), config.trials
    changed = params._replace(right_motor=WEAK) if row == "weak motor" else params
    frozen = agents.snn_agent(network, plastic=False)

    @jax.jit
    def run(words: Any, params: Any, changed: Any, before: Any, after: Any) -> Any:
        keys = jax.random.wrap_key_data(words)
        constants = agents.snn_params(network, params), agents.snn_params(network, changed)
        options: dict[str, Any] = {"n_learn": n, "n_test": n, "max_steps": config.max_steps,
                   "block": config.block, "keep_states": True}  # fmt: skip
        first = run_experiment(network, constants[0], before, keys=keys, **options)
        later = jax.vmap(lambda k: jax.random.fold_in(k, 1))(keys)
        second = run_experiment(
            network, constants[1], after, keys=later, states=first.states, **options
        )
        fresh = run_experiment(network, constants[1], after, keys=later, **options)
        _, held = run_phase(
            frozen, constants[1], after, first.states,
            keys=jax.vmap(lambda k: phase_keys(k)[2])(later),
            n_trials=n, max_steps=config.max_steps,
        )  # fmt: skip
        tested = first.testing, second.testing, held, fresh.testing
        return tuple(success_rate(result) for result in tested)

    params, changed = (jax.tree.map(jnp.float32, p) for p in (params, changed))
    words = jax.random.key_data(seed_keys(range(config.seeds)))
    after = training_map(network, changed_map(config, row, before))
    rates = run(words, params, changed, before, after)
    return {m: (100.0 * r).tolist() for m, r in zip(METRICS, rates, strict=True)}


def main(config: Study) -> dict[str, float]:
    """Run the cells that are missing; returns success after the change by model and row."""
    from jaxsnn.drivers import DRIVERS

    if unknown := [r for r in config.rows if r not in ROWS]:
        raise ValueError(f"rows={unknown}: expected some of {list(ROWS)}; choose")
    check_recordable()
    enable_compilation_cache()
    path = repository.RESULTS / "study_lifelong.json"
    held = {(r["model"], r["row"]) for r in recorded(path) if r["n"] >= config.seeds}
    cells = [(m, r) for m in config.models for r in config.rows if (m, r) not in held]
    start, found = time.process_time(), {}
    with progress() as bar:
        task = bar.add_task("cells", total=len(cells), status="")
        for model, row in cells:
            if time.process_time() - start > 60 * config.max_minutes:
                break
            values = (run_driver if model in DRIVERS else run_network)(config, model, row)
            rows = [{"row": row, "model": model, "metric": name, "unit": "%", **summarize(v)}
                    for name, v in values.items()]  # fmt: skip
            record_table(path, path.stem, TITLE, rows, preset=f"{config.map}, {config.new_map}")
            found[f"{model} {row}"] = sum(values[METRICS[1]]) / config.seeds
            bar.update(task, advance=1, status=f"{model}, {row}")
            print(model, row, {k: round(sum(v) / len(v), 1) for k, v in values.items()}, flush=True)
    return found


def fields(done: dict[str, float]) -> dict[str, Any]:
    """What the result line says."""
    return {"cells": len(done), "file": "results/study_lifelong.json"}


if __name__ == "__main__":
    run_command(Study, main, description=__doc__, fields=fields)
