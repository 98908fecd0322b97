"""Q-learning and PPO on Scenarios 1-3 and D1-D3: the baselines of the spiking networks.

    python scripts/train_rl.py --model qlearning --seeds 64 --record
    python scripts/train_rl.py --model ppo --seeds 16 --record
    python scripts/train_rl.py --model ppo --scenarios D1 D2 D3 --seeds 16 --record

Each seed is an independent learner with its own starts. The first command (2,000 training and 100
testing trials, as the source) takes about five minutes on one core, the second about four;
`--preset quick` takes one minute. `--record` writes the rows of Tables 2.3-2.5 for Q-learning and
`results/study_rl.json`. Expect a success rate in testing near 100 % for both, far above the
source's Q-learning (10, 0 and 0 %); docs/snn_world.md says what that means.

On the detours D1 to D3 PPO has the sizes and rates of `scripts/studies/study_detour.py` (about
10,000 trials) and a reward that counts progress along the shortest way; their rows go to
`results/study_rl.json` alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from snn_fusion_failure.records.detour_rows import row_name, train_map
from snn_fusion_failure.records.robot_rows import record_learner
from snn_fusion_failure.records.rows import summarize
from snn_fusion_failure.runs import (
    append_metrics,
    apply_changes,
    enable_compilation_cache,
    open_run,
    progress,
    write_json,
)
from snn_fusion_failure.runs.command import run_command
from snn_fusion_failure.runs.origin import check_recordable

# Number of a map -> its own root of keys; those of Scenarios 1-3 are the numbers of record.
MAPS = {"1": 1, "2": 2, "3": 3, "D1": 11, "D2": 12, "D3": 13}
NAMES = {"qlearning": "Q-learning", "ppo": "PPO"}


@dataclasses.dataclass(frozen=True)
class Config:
    """Train and test Q-learning or PPO."""

    model: Annotated[Literal["qlearning", "ppo"], arg(aliases=["--algorithm"])] = "qlearning"
    preset: Literal["paper", "quick"] = "paper"
    """quick: 4 seeds, a tenth of the training."""
    scenarios: tuple[str, ...] = ("1", "2", "3")
    """Maps: 1 to 3, or D1 to D3 for their detour readings."""
    seeds: int = 64
    """Independent training runs."""
    test_trials: int = 100
    max_steps: int = 200
    """A trial that has not ended after so many control steps has failed."""
    learning_rate: float | None = None
    """The same as `--set params.learning_rate=...`."""
    discount: float | None = None
    """The same as `--set params.discount=...`."""
    epsilon: float | None = None
    """Q-learning, chance of a random action in training; `--set params.epsilon=...`."""
    test_epsilon: float = 0.0
    """Q-learning: the same in testing."""
    changes: Annotated[tuple[str, ...], arg(name="set", aliases=["--changes"])] = ()
    """Changed constants as part.name=value: `params.discount=0.99 config.n_updates=300`."""
    seed: int = 0
    """Root of all keys."""
    out: Path | None = None
    """Run folder; runs/rl_MODEL_sSEED when left out."""
    record: bool = False
    """Write rows into results/."""
    overwrite: bool = False
    """Replace the run in the folder."""


def _is_detour(scenario: str) -> bool:
    return scenario.startswith("D")


def _changes(config: Config) -> list[str]:
    """Constants that the command line changes, `part.name=value`."""
    given = {name: getattr(config, name) for name in ("learning_rate", "discount", "epsilon")}
    named = [f"params.{name}={value}" for name, value in given.items() if value is not None]
    return [*named, *config.changes]


def build(config: Config, scenario: str) -> dict[str, Any]:
    """The learner's constants (and PPO's sizes) on a map, with the command line's changes."""
    from jaxsnn import learners, ppo, qlearning

    parts: dict[str, Any] = {"params": qlearning.QParams()}
    if config.model == "ppo":
        sizes, params = ppo.PPOConfig(n_updates=150), ppo.PPOParams()
        if _is_detour(scenario):
            sizes, params = learners.DETOUR_PPO, learners.DETOUR_PPO_PARAMS
        if config.preset == "quick":
            sizes = dataclasses.replace(sizes, n_updates=sizes.n_updates // 5)
        parts = {"params": params, "config": sizes}
    parts = apply_changes(parts, _changes(config))
    check: Any = ppo.check_ppo if config.model == "ppo" else qlearning.check_q
    check(parts["params"])
    return parts


def train(config: Config, parts: dict[str, Any], scenario: str) -> dict[str, list[float]]:
    """One map: percentages and means, one value for each seed."""
    from jaxsnn import learners, ways

    root, keys = learners.learner_keys(config.seed, MAPS[scenario], config.seeds)
    map = train_map(row_name(scenario))
    if config.model == "ppo":
        return learners.train_ppo(
            parts["config"], parts["params"], map, keys=keys,
            n_test=config.test_trials, max_steps=config.max_steps,
            way=ways.way_length(map) if _is_detour(scenario) else None,
        )  # fmt: skip
    return learners.train_qlearning(
        parts["params"], map, key=root, learners=config.seeds,
        n_train=learners.CHECKPOINTS[-1] if config.preset == "paper" else 200,
        n_test=config.test_trials, max_steps=config.max_steps, test_epsilon=config.test_epsilon,
    )  # fmt: skip


def main(config: Config) -> dict[str, Any]:
    """Train and test on every map asked for; returns `{scenario: {metric: summary}}`."""
    if unknown := [s for s in config.scenarios if s not in MAPS]:
        raise ValueError(f"scenarios={unknown}: expected some of {', '.join(MAPS)}; choose")
    for name in ("seeds", "test_trials"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name}={getattr(config, name)}: expected at least 1; raise it")
    if config.record and config.preset != "paper":
        raise ValueError(
            f"preset={config.preset!r}: expected 'paper' with --record, a quick run is no result "
            "of record; leave one of them out"
        )
    if config.record and (_changes(config) or config.test_epsilon):
        raise ValueError(
            f"record=True, set={_changes(config)}, test_epsilon={config.test_epsilon}: expected "
            "the constants of the study, a row of record is known by its name alone; leave one out"
        )
    if config.record:
        check_recordable()
    if config.preset == "quick":
        config = dataclasses.replace(config, seeds=min(config.seeds, 4))
    parts = {scenario: build(config, scenario) for scenario in config.scenarios}
    enable_compilation_cache()
    out = config.out or Path("runs") / f"rl_{config.model}_s{config.seed}"
    settings = {
        f.name: getattr(config, f.name)
        for f in dataclasses.fields(config)
        if f.name not in ("out", "record", "overwrite")
    }
    open_run(out, settings, overwrite=config.overwrite)
    model = NAMES[config.model]
    results: dict[str, Any] = {}
    with progress() as bar:
        task = bar.add_task(model, total=len(config.scenarios), status="")
        for scenario in config.scenarios:
            values = train(config, parts[scenario], scenario)
            summary = {name: summarize(v) for name, v in values.items() if v}
            results[scenario] = summary
            append_metrics(out, {"scenario": scenario, "model": model, **summary})
            if config.record:
                record_learner(model, row_name(scenario), summary, config.preset)
            bar.update(task, advance=1, status=f"testing {summary['sr_testing']['mean']:.1f} %")
    write_json(out / "result.json", results)
    return results


def _fields(found: dict[str, Any]) -> dict[str, Any]:
    return {
        f"{metric}_{number}": found[number][metric]["mean"]
        for number in found
        for metric in ("sr_learning", "sr_testing", "n_mv")
    }


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, fields=_fields, argv=argv, prog=prog)
