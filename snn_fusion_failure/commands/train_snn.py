"""Train and test spiking networks on a scenario, many independent robots (seeds) at a time.

    python scripts/train_snn.py --scenario 1 --model S4 --seeds 64
    python scripts/train_snn.py --scenario 1 --model S4 --preset quick

Each seed is one run as in the source: random weights, 20 learning trials, then 30 / 20 / 20 testing
trials with frozen weights. `--map` takes another map (a JSON file, `D1`, `detour/train/0`),
`--save` keeps the trained networks and `--from` goes on with them. Seeds are run in chunks; each
chunk is one file under OUT/seeds, and a run that was broken off goes on with `--resume`. Prints
SR-learning, SR-testing and N_mv, the mean over seeds with its 95 % interval, and draws the map, the
trajectories of the first seed and the learning curve. `--record` writes the numbers into results/
as rows of the source's table. About 8 CPU-s per seed (S4, reading "tuned"); `quick` under a minute.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.commands.snn_runs import N_LEARN, Config, draw, name_of, run_seeds
from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    open_run,
    repository,
    write_json,
)
from snn_fusion_failure.runs.command import run_command
from snn_fusion_failure.runs.networks import changed_preset
from snn_fusion_failure.runs.origin import check_recordable

UNITS = {"n_mv": "steps", "path": "px", "path_ratio": "1", "path_ratio_median": "1"}
TABLES = {1: "2.3", 2: "2.4", 3: "2.5"}


# Options that do not change the numbers, so a resumed run may change them.
_NOT_SETTINGS = ("out", "resume", "overwrite", "record", "figures", "seeds", "block", "save")


def main(config: Config) -> dict[str, Any]:
    """Run the seeds that are missing, summarize all of them."""
    from jaxsnn import scenarios, scores
    from jaxsnn.experiment import TEST_TRIALS, shortest_paths
    from jaxsnn.map_files import named_map

    for name in ("seeds", "chunk"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name}={getattr(config, name)}: expected at least 1; raise it")
    if config.learn_trials < 1:
        raise ValueError(f"learn_trials={config.learn_trials}: expected at least 1; raise it")
    if config.save is not None and config.save.suffix != ".npz":
        raise ValueError(f"save={config.save}: expected a name that ends in .npz; rename it")
    if config.record:
        if config.map or config.source or config.learn_trials != N_LEARN:
            raise ValueError(
                "record=True: expected a scenario of the source, new networks and 20 learning "
                "trials; leave out --map, --from and --learn-trials"
            )
        if config.changes or config.preset != "paper":
            raise ValueError(
                f"record=True, preset={config.preset!r}, set={list(config.changes)}: expected the "
                "constants of the network and the whole run, a row of record is known by its name "
                "alone; leave out --set and --preset quick"
            )
        check_recordable()
    map = named_map(config.map) if config.map else scenarios.scenario(config.scenario)
    quick = config.preset == "quick"
    n_seeds = min(config.seeds, 4) if quick else config.seeds
    n_test = 10 if quick else 20 if config.map else TEST_TRIALS[config.scenario]
    changed_preset(config.model, config.reading, config.changes)  # refused before a folder is made
    place = name_of(config).lower().replace(" ", "")
    default = f"{place}_{config.model}_{config.reading}"
    out = config.out or Path("runs") / "train_snn" / default
    settings = {
        k: str(v) if isinstance(v, Path) else v
        for k, v in dataclasses.asdict(config).items()
        if k not in _NOT_SETTINGS
    }
    for file in (out / "seeds").glob("*.json") if config.overwrite else ():
        file.unlink()
    open_run(out, settings, resume=config.resume, overwrite=config.overwrite)
    enable_compilation_cache()
    if config.figures:
        from jaxsnn import plots

        plots.plot_maps({name_of(config): map}).savefig(out / "map.png", dpi=120)
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
    model = config.model if config.reading == "tuned" else f"{config.model} {config.reading}"
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
