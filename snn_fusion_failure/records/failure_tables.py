"""Tables 4.1 and 4.2: all methods, all specifications, box and ball, many seeds.

    python scripts/studies/study_failures.py --circuit ldo --seeds 20 --out runs/table_4_1 --record
    python scripts/studies/study_failures.py --circuit dcdc --seeds 20 --out runs/table_4_2 --record

One folder per specification, task and method; every simulation is logged as it comes, so the
command can be killed and repeated. With `--record` the rows go to `results/table_4_1.json` or
`table_4_2.json` after every method. Thresholds: 90 % of the way from nominal to the worst value
that gradient ascents find; their probability for normal parameters by subset simulation.

For one specification, task and method: about 3 CPU-minutes for 20 seeds, 10 with Rev-ARGate.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    print_result,
    progress,
    repository,
    write_json,
)
from snn_fusion_failure.runs.origin import check_recordable

TABLES = {"ldo": ("4.1", "LDO regulator"), "dcdc": ("4.2", "DC-DC converter")}

# Worst case and first failure of the source, for its own circuits and targets.
SOURCE: dict[str, dict[str, dict[str, tuple[float, float | None]]]] = {
    "ldo": {
        "quiescent_current": {
            "pBO": (9.4e-3, None), "HDBO": (10.35e-3, 92),
            "Rev-ARGate zeros": (11.0e-3, 298), "Rev-ARGate BNN": (10.5e-3, 206),
        },
        "undershoot": {
            "pBO": (0.31, None), "HDBO": (0.36, 221),
            "Rev-ARGate zeros": (0.36, 262), "Rev-ARGate BNN": (0.37, 242),
        },
        "load_regulation": {
            "pBO": (26.1, None), "HDBO": (29.1, 287),
            "Rev-ARGate zeros": (27.2, 191), "Rev-ARGate BNN": (30.6, 261),
        },
    },
    "dcdc": {
        "output_accuracy": {
            "pBO": (34.25e-3, None), "HDBO": (35.61e-3, None),
            "Rev-ARGate zeros": (38.68e-3, 112), "Rev-ARGate BNN": (38.99e-3, 112),
        },
        "overshoot": {
            "pBO": (10.31e-3, None), "HDBO": (11.11e-3, None),
            "Rev-ARGate zeros": (9.5e-3, None), "Rev-ARGate BNN": (11.95e-3, 210),
        },
    },
}  # fmt: skip

# Features that the source found to matter.
EMBEDDING_DIM = {"ldo": 22, "dcdc": 18}


@dataclasses.dataclass(frozen=True)
class Config:
    """What to run."""

    circuit: str = "ldo"
    """ldo (Table 4.1) or dcdc (Table 4.2)."""
    specs: tuple[str, ...] = ()
    """Specifications; all without."""
    tasks: tuple[str, ...] = ("box", "ball")
    """box and ball."""
    methods: tuple[str, ...] = ()
    """Methods; all without."""
    seeds: int = 20
    """Searches per method."""
    n_total: int = 300
    """Simulations per search."""
    radius: float = 6.0
    """Radius of the ball [sigma]."""
    retrain_every: int = 100
    """Simulations between trainings of a Rev-ARGate; the first is on the 50 initial ones."""
    together: bool = False
    """Run the methods of a task at once, their simulations in common batches: faster where a call
    of the simulator costs more than a sample; CPU time by method is not known then."""
    probability: bool = True
    """Estimate the failure probability at each threshold."""
    out: Path = Path("runs/study_failures")
    """Folder of all runs."""
    record: bool = False
    """Write the table of record."""


def cached(path: Path, make: Any) -> Any:
    """A JSON object that is computed once, and again where its file is damaged."""
    from failure.search.trees import set_aside

    if path.exists():
        try:
            held = json.loads(path.read_bytes())
            if not held or not isinstance(held, dict):
                raise ValueError("no values in it")
            return held
        except ValueError as error:
            set_aside(path, str(error), "computed again")
    write_json(path, make())
    return json.loads(path.read_text(encoding="utf-8"))


def _seconds(path: Path) -> float | None:
    """CPU time of a method, where it was measured."""
    if not path.exists():
        return None
    seconds: float = json.loads(path.read_text(encoding="utf-8"))["seconds"]
    return seconds


def describe(values: Any) -> dict[str, Any]:
    """Number, median and quartiles, mean and its interval of the finite values; all values."""
    import numpy as np

    values = np.asarray(values, np.float64)
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return {"n": len(values), "median": None, "iqr": None, "mean": None, "ci95": None,
                "values": values.tolist()}  # fmt: skip
    low, middle, high = np.quantile(finite, [0.25, 0.5, 0.75])
    return {
        **summarize([float(v) for v in finite]),
        "n": len(values),
        "median": middle,
        "iqr": [low, high],
        "values": values.tolist(),
    }


def rows_of(
    circuit: str,
    spec: Any,
    task: str,
    method: str,
    y: Any,
    target: dict[str, Any],
    seconds: float | None,
) -> list[dict[str, Any]]:
    """The rows of one method: first failure, share of runs with one, worst case."""
    import numpy as np

    from failure.search.bayesopt import METHODS, best_so_far, first_hit

    sign = 1.0 if spec.sense == "max" else -1.0
    hits = first_hit(y, sign * target["threshold"])
    label = METHODS[method].label
    base = {
        "row": f"{spec.name} ({task})",
        "model": label,
        "threshold": target["threshold"],
        "nominal": target["nominal"],
        "reachable": target["worst"],
        "probability": target.get("probability"),
        "cpu_s_per_seed": seconds,
    }
    source = SOURCE.get(circuit, {}).get(spec.name, {}).get(label) if task == "box" else None
    extra = [{"source": source[i]} if source and source[i] is not None else {} for i in (0, 1)]
    return [
        {**base, "metric": "first_failure_hit", "unit": "simulations", **describe(hits),
         **extra[1]},
        {**base, "metric": "success_rate", "unit": "1", "n": len(hits),
         "mean": float(np.isfinite(hits).mean())},
        {**base, "metric": "worst_case", "unit": spec.unit,
         **describe(sign * best_so_far(y)[:, -1]), **extra[0]},
    ]  # fmt: skip


def targets_of(config: Config, circuit: Any, column: int, task: Any, folder: Path) -> Any:
    """Threshold of a task, and how likely it is for normal parameters."""
    import jax

    from failure.rare_events import subset_simulation
    from failure.search.thresholds import reachable

    spec = circuit.specs[column]
    sign = 1.0 if spec.sense == "max" else -1.0

    def signed(x: Any) -> Any:
        specs, status = circuit.run(x)
        return sign * specs, status

    target = cached(
        folder / "threshold.json",
        lambda: reachable(circuit.run, column, task, sense=spec.sense)._asdict(),
    )
    if config.probability:
        import jax.numpy as jnp

        def performance(x: Any) -> Any:
            specs, status = signed(x)
            return jnp.where(status == 0, specs[:, column], jnp.nan)

        target["probability"] = cached(
            folder / "probability.json",
            lambda: subset_simulation(
                performance, sign * target["threshold"], task.dim, key=jax.random.key(0),
                n=500, replicates=4, max_levels=12,
            )._asdict(),
        )  # fmt: skip
    return target


def run_method(
    config: Config,
    circuit: Any,
    column: int,
    task: Any,
    folder: Path,
    method: str,
    simulate: Any,
) -> Any:
    """All searches of one method, or what is missing of them; returns their history."""
    from failure.search.methods import METHODS, SearchConfig
    from failure.search.runs import run

    search = SearchConfig(
        task,
        method,
        seeds=tuple(range(config.seeds)),
        n_total=config.n_total,
        retrain_every=config.retrain_every if METHODS[method].learned else None,
        embedding_dim=EMBEDDING_DIM.get(config.circuit) if METHODS[method].reduced else None,
    )
    sense = circuit.specs[column].sense
    return run(search, simulate, column, sense=sense, folder=folder / method)


def main(config: Config) -> dict[str, Any]:
    """Run or finish the study; returns all rows."""
    import time
    from functools import partial

    from failure import circuits, plots
    from failure.search.bayesopt import METHODS
    from failure.search.methods import BY_VALUES
    from failure.search.sharing import side_by_side
    from failure.search.task import Task

    circuit = circuits.get(config.circuit)
    table, title = TABLES.get(config.circuit, (config.circuit, config.circuit))
    names = config.specs or circuit.spec_names
    methods = config.methods or BY_VALUES
    columns = [circuit.spec_index(name) for name in names]
    if config.record:
        check_recordable()
    enable_compilation_cache()
    rows: list[dict[str, Any]] = []
    with progress() as bar:
        job = bar.add_task("study", total=len(names) * len(config.tasks) * len(methods), status="")
        for column in columns:
            spec = circuit.specs[column]
            for kind in config.tasks:
                size = circuit.box if kind == "box" else config.radius
                task = Task(kind, float(size), circuit.n_dims)
                folder = config.out / config.circuit / spec.name / kind
                target = targets_of(config, circuit, column, task, folder)
                search = partial(run_method, config, circuit, column, task, folder)
                if config.together:
                    side_by_side([partial(search, method) for method in methods], circuit.simulate)
                outputs = {}
                for method in methods:
                    bar.update(job, status=f"{spec.name} {kind} {method}")
                    # A resumed method, or one of several at once, has no CPU time of its own.
                    spent = folder / method / "cpu.json"
                    alone = not (folder / method / "evaluations.jsonl").exists()
                    started = time.process_time()
                    state = search(method, circuit.simulate)
                    if alone:
                        per_seed = (time.process_time() - started) / config.seeds
                        write_json(spent, {"seconds": per_seed})
                    seconds = _seconds(spent)
                    outputs[METHODS[method].label] = state.y
                    new = rows_of(config.circuit, spec, kind, method, state.y, target, seconds)
                    rows += new
                    if config.record:
                        path = repository.RESULTS / f"table_{table.replace('.', '_')}.json"
                        record_table(path, table, title, new, preset="paper")
                    bar.advance(job)
                sign = 1.0 if spec.sense == "max" else -1.0
                figure = plots.plot_trend(
                    outputs,
                    threshold=sign * target["threshold"],
                    n_init=50,
                    label=f"{spec.name} [{spec.unit}]",
                )
                figure.savefig(folder / "trend.png")
    write_json(config.out / f"rows_{config.circuit}.json", rows)
    solved = [row["mean"] for row in rows if row["metric"] == "success_rate"]
    print_result(rows=len(rows), mean_success=sum(solved) / max(len(solved), 1))
    return {"rows": rows}
