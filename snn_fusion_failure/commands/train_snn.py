"""Train and test spiking networks on a scenario, many independent robots (seeds) at a time.

    python scripts/train_snn.py --scenario 1 --network S4 --seeds 64
    python scripts/train_snn.py --scenario 1 --network S4 --preset quick

Each seed is one run as in the source: random weights, 20 learning trials, then 30 / 20 / 20 testing
trials with frozen weights. Seeds are run in chunks; each chunk is one file under OUT/seeds, and a
run that was broken off goes on with `--resume`. Prints SR-learning, SR-testing and N_mv, the mean
over seeds with its 95 % interval, and draws the trajectories of the first seed and the learning
curve. `--record` writes the numbers into results/ as rows of the source's table.

Run time on one core: about 8 CPU-seconds per seed (S4, setting "tuned"); `quick` under a minute.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    open_run,
    progress,
    repository,
    write_json,
)
from snn_fusion_failure.runs.command import run_command
from snn_fusion_failure.runs.provenance import check_recordable

TEST_TRIALS = {1: 30, 2: 20, 3: 20}
UNITS = {"n_mv": "steps", "path": "px", "path_ratio": "1", "path_ratio_median": "1"}
TABLES = {1: "2.3", 2: "2.4", 3: "2.5"}


@dataclasses.dataclass(frozen=True)
class TrainSnn:
    """What a run is."""

    scenario: Literal[1, 2, 3] = 1
    """Map of the source."""
    network: Literal["S1", "S2", "S3", "S4"] = "S4"
    """Network and learning rule (Table 2.2 of the source)."""
    setting: Literal["tuned", "literal"] = "tuned"
    """Readings and options, see docs/snn_networks.md."""
    seeds: int = 64
    """Independent runs."""
    first_seed: int = 0
    """Number of the first of them."""
    preset: Literal["paper", "quick"] = "paper"
    """quick: 4 seeds, 10 testing trials."""
    online_trials: int = 0
    """Further testing trials with plasticity left on."""
    max_steps: int = 200
    """Control steps after which a trial is given up."""
    block: int = 8
    """Robots per block; 4 to 8 on a CPU, all on an accelerator."""
    chunk: int = 16
    """Seeds per file and per call of the compiled program."""
    changes: tuple[str, ...] = ()
    """Changed constants as part.name=value: `params.gamma=5e-4 config.bounds=soft`."""
    out: Path | None = None
    """Run folder; default runs/train_snn/SCENARIO_NETWORK_SETTING."""
    resume: bool = False
    """Go on with the run in OUT."""
    overwrite: bool = False
    """Forget the run in OUT."""
    record: bool = False
    """Write the rows of the source's table into results/."""
    figures: bool = True
    """Draw trajectories and the learning curve."""


def parse_changes(changes: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """`part.name=value` strings as keyword arguments of `jaxsnn.presets.network_setting`.

    Raises:
        ValueError: a string is not of that form.
    """
    parts: dict[str, dict[str, Any]] = {}
    for change in changes:
        left, equals, text = change.partition("=")
        part, dot, name = left.partition(".")
        if not (equals and dot) or part not in ("config", "params", "stdp", "reward"):
            raise ValueError(
                f"change {change!r}: expected part.name=value with part config, params, stdp or "
                "reward, for example params.gamma=5e-4"
            )
        try:
            value = json.loads(text)
        except json.JSONDecodeError:
            value = text
        parts.setdefault(part, {})[name] = value
    return parts


def seed_keys(seeds: Any) -> Any:
    """Key of each seed `[n]`: the same robot in every table and study."""
    import jax

    return jax.vmap(lambda i: jax.random.fold_in(jax.random.key(0), i))(seeds)


def learning_circles(scenario: int, n_learn: int) -> Any:
    """Start circles of the learning trials: Scenario 2's in turn, as the source; None is random."""
    import jax.numpy as jnp

    return jnp.arange(n_learn) % 2 if scenario == 2 else None


def make_runner(
    config: Any, scenario: int, *, n_learn: int, n_test: int, n_online: int, max_steps: int,
    block: int, record: bool, keep_states: bool = False,
) -> Any:  # fmt: skip
    """A compiled `(seeds, params) -> Experiment` of numpy arrays; a change of params is free."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn import scenarios
    from jaxsnn.agents import snn_params
    from jaxsnn.trials import run_experiment

    place = scenarios.scenario(scenario)
    circles = learning_circles(scenario, n_learn)

    @jax.jit
    def run(numbers: Any, params: Any) -> Any:
        keys = seed_keys(numbers)
        return run_experiment(
            config, snn_params(config, params), place, keys,
            n_learn=n_learn, n_test=n_test, n_online=n_online, max_steps=max_steps, block=block,
            circles=circles, record=record, keep_states=keep_states,
        )  # fmt: skip

    def call(numbers: Any, params: Any) -> Any:
        params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)
        out = run(jnp.asarray(numbers, jnp.int32), params)
        return jax.tree.map(np.asarray, out)

    return call


def per_seed(experiment: Any, numbers: list[int]) -> list[dict[str, Any]]:
    """One JSON record per seed: status, steps and path of every trial, and mean firing rates."""
    records = []
    phases = {"learning": experiment.learning, "testing": experiment.testing}
    if experiment.online is not None:
        phases["online"] = experiment.online
    for index, number in enumerate(numbers):
        record: dict[str, Any] = {"seed": number}
        for name, phase in phases.items():
            record[name] = {
                "status": phase.status[index].tolist(),
                "steps": phase.steps[index].tolist(),
                "path": [round(float(x), 2) for x in phase.path[index]],
                "rates": [round(float(x), 2) for x in phase.info[index].mean(axis=0)],
            }
        records.append(record)
    return records


def success(record: dict[str, Any], phase: str) -> float:
    """Arrivals in percent of the trials of one seed."""
    status = record[phase]["status"]
    return 100.0 * sum(s == 0 for s in status) / len(status)


def mean_of_arrivals(record: dict[str, Any], field: str) -> float | None:
    """Mean of steps or path over the testing trials that arrived; None when none did."""
    test = record["testing"]
    values = [v for v, s in zip(test[field], test["status"], strict=True) if s == 0]
    return sum(values) / len(values) if values else None


def shortest_paths(numbers: list[int], scenario: int, n_test: int) -> list[list[float]]:
    """Shortest collision-free path from each testing start of each seed, to the arrival circle."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn import planner, scenarios
    from jaxsnn.trials import phase_keys, start_states

    place = scenarios.scenario(scenario)

    @jax.jit
    def starts(seeds: Any) -> Any:
        keys = seed_keys(seeds)
        found = jax.vmap(lambda k: start_states(phase_keys(k)[2], place, n_test))(keys)
        return jnp.stack([found.x, found.y], axis=-1)

    field = planner.path_field(place)
    positions = np.asarray(starts(jnp.asarray(numbers, jnp.int32)), np.float64)
    return [field.lengths(p).tolist() for p in positions]


def path_ratios(
    records: list[dict[str, Any]], shortest: list[list[float]]
) -> tuple[list[float], list[float]]:
    """Mean and median over the testing trials that arrived of path / shortest, per seed."""
    import numpy as np

    means, medians = [], []
    for record, lengths in zip(records, shortest, strict=True):
        test = record["testing"]
        ratio = [
            path / length
            for path, length, status in zip(test["path"], lengths, test["status"], strict=True)
            if status == 0
        ]
        if ratio:
            means.append(float(np.mean(ratio)))
            medians.append(float(np.median(ratio)))
    return means, medians


def metrics(
    records: list[dict[str, Any]], shortest: list[list[float]] | None = None
) -> dict[str, dict[str, Any]]:
    """Mean, interval and values over seeds of what the source reports, and the path's length."""
    columns: dict[str, list[float | None]] = {
        "sr_learning": [success(r, "learning") for r in records],
        "sr_testing": [success(r, "testing") for r in records],
        "n_mv": [mean_of_arrivals(r, "steps") for r in records],
        "path": [mean_of_arrivals(r, "path") for r in records],
    }
    if "online" in records[0]:
        columns["sr_online"] = [success(r, "online") for r in records]
    if shortest is not None:
        means, medians = path_ratios(records, shortest)
        columns["path_ratio"], columns["path_ratio_median"] = list(means), list(medians)
    kept = {k: [v for v in values if v is not None] for k, values in columns.items()}
    return {name: summarize(values) for name, values in kept.items() if values}


def draw(out: Path, config: TrainSnn, experiment: Any, records: list[dict[str, Any]]) -> None:
    """Trajectories of the first seed in both phases and the learning curve over all seeds."""
    import numpy as np

    from jaxsnn import plots, scenarios

    place = scenarios.scenario(config.scenario)
    for name, phase in (("learning", experiment.learning), ("testing", experiment.testing)):
        steps, status = phase.steps[0], phase.status[0]
        figure = plots.trajectories(
            place,
            [phase.poses[0, i, : n + 1, :2] for i, n in enumerate(steps)],
            arrived=[bool(s == 0) for s in status],
            collided=[bool(s == 1) for s in status],
            title=f"{config.network}, Scenario {config.scenario}, {name} phase",
        )
        figure.savefig(out / f"trajectories_{name}.png", dpi=120)
    curve = np.array([[float(s == 0) for s in r["learning"]["status"]] for r in records])
    figure = plots.learning_curves({config.network: curve}, window=3)
    figure.savefig(out / "learning_curve.png", dpi=120)


def main(config: TrainSnn) -> dict[str, Any]:
    """Run the seeds that are missing, summarize all of them."""
    from jaxsnn.presets import network_setting

    if config.seeds < 1 or config.chunk < 1:
        raise ValueError(f"seeds = {config.seeds}, chunk = {config.chunk}: expected at least 1")
    if config.record:
        check_recordable()
    quick = config.preset == "quick"
    n_seeds = min(config.seeds, 4) if quick else config.seeds
    n_test = 10 if quick else TEST_TRIALS[config.scenario]
    built, params = network_setting(config.network, config.setting, **parse_changes(config.changes))
    name = f"scenario{config.scenario}_{config.network}_{config.setting}"
    out = config.out or Path("runs") / "train_snn" / name
    settings = dataclasses.asdict(config)
    for key in ("out", "resume", "overwrite", "record", "figures", "seeds", "block"):
        settings.pop(key)
    if config.overwrite and (out / "seeds").exists():
        for file in (out / "seeds").glob("*.json"):
            file.unlink()
    open_run(out, settings, resume=config.resume, overwrite=config.overwrite)
    enable_compilation_cache()

    run = make_runner(
        built, config.scenario, n_learn=20, n_test=n_test, n_online=config.online_trials,
        max_steps=config.max_steps, block=config.block, record=config.figures,
    )  # fmt: skip
    last = config.first_seed + n_seeds
    starts = range(config.first_seed, last, config.chunk)
    records: list[dict[str, Any]] = []
    shown = None
    with progress() as bar:
        task = bar.add_task("seeds", total=n_seeds, status="")
        for start in starts:
            numbers = list(range(start, min(start + config.chunk, last)))
            file = out / "seeds" / f"{start:05d}_{len(numbers)}.json"
            if file.exists():
                records += json.loads(file.read_text(encoding="utf-8"))
            else:
                experiment = run(numbers, params)
                chunk = per_seed(experiment, numbers)
                write_json(file, chunk)
                records += chunk
                shown = shown or experiment
            rate = sum(success(r, "testing") for r in records) / len(records)
            bar.update(task, advance=len(numbers), status=f"SR-testing {rate:.0f} %")

    shortest = shortest_paths([r["seed"] for r in records], config.scenario, n_test)
    summary = metrics(records, shortest)
    if config.figures and shown is not None:
        draw(out, config, shown, records)
    write_json(out / "result.json", {"settings": settings, "metrics": summary})
    if config.record:
        table = json.loads((repository.RESULTS / "source_tables.json").read_text(encoding="utf-8"))
        number = TABLES[config.scenario]
        source = table[number]["rows"][config.network]
        model = config.network if config.setting == "tuned" else f"{config.network} literal"
        rows = [
            {"row": f"Scenario {config.scenario}", "model": model, "metric": metric,
             "unit": UNITS.get(metric, "%"), **values,
             **({"source": source[metric]} if metric in source else {})}
            for metric, values in summary.items()
        ]  # fmt: skip
        path = repository.RESULTS / f"table_{number.replace('.', '_')}.json"
        title = f"Scenario {config.scenario}: success rates and steering movements"
        record_table(path, number, title, rows, preset=config.preset)
    return {"out": str(out), "n": len(records), "metrics": summary}


def _fields(result: dict[str, Any]) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for metric, values in result["metrics"].items():
        fields[metric] = float(values["mean"])
        if values["ci95"]:
            low, high = values["ci95"]
            fields[f"{metric}_ci95"] = f"{low:.4g}..{high:.4g}"
    return {"n": result["n"], **fields, "out": result["out"]}


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(TrainSnn, main, description=__doc__, fields=_fields, argv=argv, prog=prog)
