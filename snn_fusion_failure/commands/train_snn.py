"""Train and test spiking networks on a scenario, many independent robots (seeds) at a time.

    python scripts/train_snn.py --scenario 1 --model S4 --seeds 64
    python scripts/train_snn.py --scenario 1 --model S4 --preset quick

Each seed is one run as in the source: random weights, 20 learning trials, then 30 / 20 / 20 testing
trials with frozen weights. Seeds are run in chunks; each chunk is one file under OUT/seeds, and a
run that was broken off goes on with `--resume`. Prints SR-learning, SR-testing and N_mv, the mean
over seeds with its 95 % interval, and draws the trajectories of the first seed and the learning
curve. `--record` writes the numbers into results/ as rows of the source's table. About 8 CPU-s
per seed (S4, reading "tuned"); `quick` under a minute.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    open_run,
    progress,
    repository,
    write_json,
)
from snn_fusion_failure.runs.command import run_command
from snn_fusion_failure.runs.networks import changed_preset
from snn_fusion_failure.runs.origin import check_recordable

UNITS = {"n_mv": "steps", "path": "px", "path_ratio": "1", "path_ratio_median": "1"}
TABLES = {1: "2.3", 2: "2.4", 3: "2.5"}
N_LEARN = 20


@dataclasses.dataclass(frozen=True)
class Config:
    """Train and test a spiking network."""

    scenario: Literal[1, 2, 3] = 1
    """Map of the source."""
    model: Annotated[Literal["S1", "S2", "S3", "S4"], arg(aliases=["--network"])] = "S4"
    """Network and learning rule (Table 2.2 of the source)."""
    reading: Annotated[Literal["tuned", "literal"], arg(aliases=["--setting"])] = "tuned"
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
    changes: Annotated[tuple[str, ...], arg(name="set", aliases=["--changes"])] = ()
    """Changed constants as part.name=value: `params.gamma=5e-4 config.bounds=soft`."""
    out: Path | None = None
    """Run folder; default runs/train_snn/SCENARIO_MODEL_READING."""
    resume: bool = False
    """Go on with the run in OUT."""
    overwrite: bool = False
    """Forget the run in OUT."""
    record: bool = False
    """Write the rows of the source's table into results/."""
    figures: bool = True
    """Draw trajectories and the learning curve."""


# Options that do not change the numbers, so a resumed run may change them.
_NOT_SETTINGS = ("out", "resume", "overwrite", "record", "figures", "seeds", "block")


def run_seeds(
    config: Config, out: Path, map: Any, n_seeds: int, n_test: int
) -> tuple[list[dict[str, Any]], Any]:
    """The records of all seeds, those in `out` read back; and the first experiment that was run."""
    from jaxsnn import scores
    from jaxsnn.experiment import learning_circles, make_runner

    network, params = changed_preset(config.model, config.reading, config.changes)
    run = make_runner(
        network, map, n_learn=N_LEARN, n_test=n_test, n_online=config.online_trials,
        max_steps=config.max_steps, block=config.block,
        circles=learning_circles(config.scenario, N_LEARN), record=config.figures,
    )  # fmt: skip
    last = config.first_seed + n_seeds
    records, shown = [], None
    with progress() as bar:
        task = bar.add_task("seeds", total=n_seeds, status="")
        for start in range(config.first_seed, last, config.chunk):
            numbers = list(range(start, min(start + config.chunk, last)))
            file = out / "seeds" / f"{start:05d}_{len(numbers)}.json"
            if file.exists():
                records += json.loads(file.read_text(encoding="utf-8"))
            else:
                experiment = run(numbers, params)
                chunk = scores.per_seed(experiment, numbers)
                write_json(file, chunk)
                records += chunk
                shown = shown or experiment
            rate = sum(scores.success(r, "testing") for r in records) / len(records)
            bar.update(task, advance=len(numbers), status=f"SR-testing {rate:.0f} %")
    return records, shown


def draw(out: Path, config: Config, map: Any, experiment: Any, records: list[Any]) -> None:
    """Trajectories of the first seed in both phases and the learning curve over all seeds."""
    import numpy as np

    from jaxsnn import plots
    from jaxsnn.status import Status

    for name in ("learning", "testing"):
        phase = getattr(experiment, name)
        steps, status = phase.steps[0], phase.status[0]
        figure = plots.plot_trajectories(
            map,
            [phase.poses[0, i, : n + 1, :2] for i, n in enumerate(steps)],
            arrived=[bool(s == Status.ARRIVED) for s in status],
            collided=[bool(s == Status.COLLIDED) for s in status],
            title=f"{config.model}, Scenario {config.scenario}, {name} phase",
        )
        figure.savefig(out / f"trajectories_{name}.png", dpi=120)
    curve = np.array([r["learning"]["status"] for r in records]) == Status.ARRIVED
    figure = plots.plot_learning_curves({config.model: curve.astype(float)}, window=3)
    figure.savefig(out / "learning_curve.png", dpi=120)


def main(config: Config) -> dict[str, Any]:
    """Run the seeds that are missing, summarize all of them."""
    from jaxsnn import scenarios, scores
    from jaxsnn.experiment import TEST_TRIALS, shortest_paths

    for name in ("seeds", "chunk"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name}={getattr(config, name)}: expected at least 1; raise it")
    if config.record:
        check_recordable()
    quick = config.preset == "quick"
    n_seeds = min(config.seeds, 4) if quick else config.seeds
    n_test = 10 if quick else TEST_TRIALS[config.scenario]
    changed_preset(config.model, config.reading, config.changes)  # refused before a folder is made
    default = f"scenario{config.scenario}_{config.model}_{config.reading}"
    out = config.out or Path("runs") / "train_snn" / default
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_SETTINGS}
    for file in (out / "seeds").glob("*.json") if config.overwrite else ():
        file.unlink()
    open_run(out, settings, resume=config.resume, overwrite=config.overwrite)
    enable_compilation_cache()
    map = scenarios.scenario(config.scenario)
    records, shown = run_seeds(config, out, map, n_seeds, n_test)
    shortest = shortest_paths(map, [r["seed"] for r in records], n_test)
    summary = {k: summarize(v) for k, v in scores.score(records, shortest).items() if v}
    if config.figures and shown is not None:
        draw(out, config, map, shown, records)
    write_json(out / "result.json", {"settings": settings, "metrics": summary})
    if config.record:
        record(config, summary)
    return {"out": str(out), "n": len(records), "metrics": summary}


def record(config: Config, summary: dict[str, Any]) -> None:
    """Rows of the source's table into results/, each with the source's number beside it."""
    number = TABLES[config.scenario]
    tables = json.loads((repository.RESULTS / "source_tables.json").read_text(encoding="utf-8"))
    source = tables[number]["rows"][config.model]
    model = config.model if config.reading == "tuned" else f"{config.model} literal"
    rows = [
        {"row": f"Scenario {config.scenario}", "model": model, "metric": metric,
         "unit": UNITS.get(metric, "%"), **values,
         **({"source": source[metric]} if metric in source else {})}
        for metric, values in summary.items()
    ]  # fmt: skip
    title = f"Scenario {config.scenario}: success rates and steering movements"
    path = repository.RESULTS / f"table_{number.replace('.', '_')}.json"
    record_table(path, number, title, rows, preset=config.preset)


def _fields(result: dict[str, Any]) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for metric, values in result["metrics"].items():
        fields[metric] = float(values["mean"])
        if values["ci95"]:
            fields[f"{metric}_ci95"] = "{:.4g}..{:.4g}".format(*values["ci95"])
    return {"n": result["n"], **fields, "out": result["out"]}


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, fields=_fields, argv=argv, prog=prog)
