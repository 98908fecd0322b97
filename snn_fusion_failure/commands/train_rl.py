"""Q-learning and PPO on Scenarios 1-3: the baselines of the spiking networks.

    python scripts/train_rl.py --algorithm qlearning --seeds 64 --record
    python scripts/train_rl.py --algorithm ppo --seeds 16 --record

Each seed is an independent learner with its own starts. The first command (2,000 training and 100
testing trials, as the source) takes about five minutes on one core, the second about four;
`--preset quick` takes one minute. `--record` writes the rows of Tables 2.3-2.5 for Q-learning and
`results/study_rl.json`. Expect a success rate in testing near 100 % for both, far above the
source's Q-learning (10, 0 and 0 %); docs/snn_world.md says what that means.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import (
    append_metrics,
    enable_compilation_cache,
    open_run,
    progress,
    repository,
    write_json,
)
from snn_fusion_failure.runs.command import run_command
from snn_fusion_failure.runs.provenance import check_recordable

# Greedy tests of the Q-learner after so many training trials, each a multiple of the chunk before
# it.
CHECKPOINTS = (20, 40, 60, 80, 100, 200, 300, 500, 1000, 2000)
TABLES = {1: "2.3", 2: "2.4", 3: "2.5"}
# Path ratios are planned on the host for so many testing trials of each seed.
PLANNED = 10


@dataclasses.dataclass(frozen=True)
class Config:
    """Train and test Q-learning or PPO."""

    algorithm: Literal["qlearning", "ppo"] = "qlearning"
    preset: Literal["quick", "paper"] = "paper"
    """quick: 4 seeds, a tenth of the training."""
    scenarios: tuple[int, ...] = (1, 2, 3)
    seeds: int = 64
    """Independent training runs."""
    test_trials: int = 100
    max_steps: int = 200
    """A trial that has not ended after so many control steps has failed."""
    learning_rate: float | None = None
    """Of Q-learning (0.1 when left out) or PPO (0.001)."""
    discount: float | None = None
    """Of Q-learning (0.9 when left out) or PPO (0.98)."""
    epsilon: float = 0.3
    """Q-learning: chance of a random action in training."""
    test_epsilon: float = 0.0
    """Q-learning: the same in testing."""
    seed: int = 0
    """Root of all keys."""
    out: Path | None = None
    """Run folder; runs/rl_<algorithm>_s<seed> when left out."""
    record: bool = False
    """Write rows into results/."""
    overwrite: bool = False
    """Replace the run in the folder."""


def _path_ratio(params: Any, start: Any, length: Any, arrived: Any) -> list[float]:
    """Mean over successful testing trials of path / shortest path, one number for each seed."""
    import numpy as np

    from jaxsnn import planner

    field = planner.path_field(params)
    ratios = []
    for s, n, ok in zip(start[:, :PLANNED], length[:, :PLANNED], arrived[:, :PLANNED], strict=True):
        if ok.any():
            ratios.append(float(np.mean(n[ok] / field.lengths(s[ok]))))
    return ratios


def run_qlearning(config: Config, number: int) -> dict[str, list[float]]:
    """One scenario: percentages and means, one value for each seed."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn import qlearning, scenarios

    params = scenarios.scenario(number)
    q = qlearning.default_params(
        learning_rate=0.1 if config.learning_rate is None else config.learning_rate,
        discount=0.9 if config.discount is None else config.discount,
        epsilon=config.epsilon,
    )
    greedy = q._replace(epsilon=jnp.float32(config.test_epsilon))
    root = jax.random.fold_in(jax.random.key(config.seed), number)
    seeds = jnp.arange(config.seeds)
    train_keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.fold_in(root, 0), i))(seeds)
    test_keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.fold_in(root, 1), i))(seeds)
    run = jax.jit(qlearning.run_trials, static_argnames=("n_trials", "max_steps", "learn"))

    tables, done = qlearning.init(config.seeds), 0
    phases, tested = [], {}
    last = CHECKPOINTS[-1] if config.preset == "paper" else 200
    while done < last:
        chunk = 20 if done < 100 else 100
        tables, trials = run(
            train_keys, tables, q, params,
            n_trials=chunk, max_steps=config.max_steps, learn=True, first_trial=done,
        )  # fmt: skip
        phases.append(jax.tree.map(np.asarray, trials))
        done += chunk
        if done in CHECKPOINTS:
            _, test = run(
                test_keys, tables, greedy, params,
                n_trials=config.test_trials, max_steps=config.max_steps, learn=False,
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
        "path_ratio": _path_ratio(params, final.start, final.length, final.arrived),
        "trials_to_90": first[np.isfinite(first)].tolist(),
        "sr_learning_first_20": (100.0 * training.arrived[:, :20].mean(axis=1)).tolist(),
    }
    for n, column in zip(tested, curve.T, strict=True):
        values[f"sr_testing_after_{n}"] = (100.0 * column).tolist()
    return values


def run_ppo(config: Config, number: int) -> dict[str, list[float]]:
    """One scenario: percentages and means, one value for each seed."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from jaxsnn import navigation, ppo, scenarios, world

    settings = ppo.Config(n_updates=150 if config.preset == "paper" else 30)
    if config.learning_rate is not None:
        settings = dataclasses.replace(settings, learning_rate=config.learning_rate)
    if config.discount is not None:
        settings = dataclasses.replace(settings, discount=config.discount)
    root = jax.random.fold_in(jax.random.key(config.seed), number)

    # The map is an argument, so that all scenarios share one compiled program.
    def one(key: jax.Array, params: world.Params) -> tuple[Any, ...]:
        env = navigation.navigation_env(params, max_steps=config.max_steps)
        k_train, k_test = jax.random.split(key)
        result = ppo.make_train(settings, env)(k_train)
        keys = jax.random.split(k_test, config.test_trials)
        test = ppo.evaluate(settings, env, result.params, keys, max_steps=config.max_steps)
        return result.metrics, *test

    params = scenarios.scenario(number)
    keys = jax.vmap(lambda i: jax.random.fold_in(root, i))(jnp.arange(config.seeds))
    metrics, states, success, _ = jax.tree.map(
        np.asarray, _compiled(one, config)(jax.random.key_data(keys), params)
    )
    episodes, successes = metrics.episodes.cumsum(1), metrics.successes.cumsum(1)
    first = []
    for e, s in zip(episodes, successes, strict=True):
        for i in range(len(e)):
            # The latest updates that hold at least 20 trials.
            j = int(np.searchsorted(e, e[i] - 20, side="right")) - 1
            before = (e[j], s[j]) if j >= 0 else (0, 0)
            if e[i] - before[0] >= 20 and (s[i] - before[1]) >= 0.9 * (e[i] - before[0]):
                first.append(float(e[i]))
                break
    return {
        "sr_learning": (100.0 * successes[:, -1] / episodes[:, -1]).tolist(),
        "sr_testing": (100.0 * success.mean(axis=1)).tolist(),
        "n_mv": states.robot.t.mean(axis=1).tolist(),
        "path_ratio": _path_ratio(params, states.start, states.length, success),
        "trials_to_90": first,
        "training_trials": episodes[:, -1].astype(float).tolist(),
    }


_PROGRAMS: dict[Config, Any] = {}


def _compiled(one: Any, config: Config) -> Any:
    """The training of all seeds, compiled once for a Config; keys travel as their raw words."""
    import jax

    if config not in _PROGRAMS:

        def batch(words: jax.Array, params: Any) -> Any:
            states = jax.vmap(one, (0, None))(jax.random.wrap_key_data(words), params)
            metrics, final, success, terminated = states
            robot = final.robot._replace(key=jax.random.key_data(final.robot.key))
            return metrics, final._replace(robot=robot), success, terminated

        _PROGRAMS[config] = jax.jit(batch)
    return _PROGRAMS[config]


def main(config: Config) -> dict[str, Any]:
    """Train and test on every scenario asked for; returns `{scenario: {metric: summary}}`."""
    if config.seeds < 1 or config.test_trials < 1:
        raise ValueError(
            f"seeds = {config.seeds} and test_trials = {config.test_trials} must be >= 1"
        )
    if config.record and config.preset != "paper":
        raise ValueError("a quick run is no result of record; leave --record or --preset quick out")
    if config.record:
        check_recordable()
    if config.preset == "quick":
        config = dataclasses.replace(config, seeds=min(config.seeds, 4))
    enable_compilation_cache()
    out = config.out or Path("runs") / f"rl_{config.algorithm}_s{config.seed}"
    settings = {
        f.name: getattr(config, f.name)
        for f in dataclasses.fields(config)
        if f.name not in ("out", "record", "overwrite")
    }
    open_run(out, settings, overwrite=config.overwrite)
    model = {"qlearning": "Q-learning", "ppo": "PPO"}[config.algorithm]
    train = {"qlearning": run_qlearning, "ppo": run_ppo}[config.algorithm]
    results: dict[str, Any] = {}
    with progress() as bar:
        task = bar.add_task(model, total=len(config.scenarios), status="")
        for number in config.scenarios:
            values = train(config, number)
            summary = {name: summarize(v) for name, v in values.items() if v}
            results[str(number)] = summary
            append_metrics(out, {"scenario": number, "model": model, **summary})
            if config.record:
                _record(config, model, number, summary)
            bar.update(task, advance=1, status=f"testing {summary['sr_testing']['mean']:.1f} %")
    write_json(out / "result.json", results)
    return results


def _record(config: Config, model: str, number: int, summary: dict[str, Any]) -> None:
    """Rows of one scenario into results/."""
    import json

    units = {"sr": "%", "n_mv": "steering movements", "path": "1", "trials": "trials"}
    row = f"Scenario {number}"
    source_file = repository.RESULTS / "source_tables.json"
    source = json.loads(source_file.read_text())[TABLES[number]]["rows"].get(model, {})
    cells = []
    for metric, numbers in summary.items():
        unit = next((u for start, u in units.items() if metric.startswith(start)), "trials")
        cell = {"row": row, "model": model, "metric": metric, "unit": unit, **numbers}
        if metric in source:
            cell["source"] = source[metric]
        cells.append(cell)
    record_table(
        repository.RESULTS / "study_rl.json", "study_rl",
        "Q-learning and PPO on Scenarios 1-3", cells, preset=config.preset,
    )  # fmt: skip
    if model == "Q-learning":
        table = TABLES[number]
        record_table(
            repository.RESULTS / f"table_{table.replace('.', '_')}.json",
            table,
            row,
            [c for c in cells if c["metric"] in ("sr_learning", "sr_testing", "n_mv")],
            preset=config.preset,
        )


def _fields(found: dict[str, Any]) -> dict[str, Any]:
    return {
        f"{metric}_{number}": found[number][metric]["mean"]
        for number in found
        for metric in ("sr_learning", "sr_testing", "n_mv")
    }


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, fields=_fields, argv=argv, prog=prog)
