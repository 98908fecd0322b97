"""Search a circuit for parameter variations that break a specification.

    python scripts/find_failures.py --circuit ldo --spec undershoot --seeds 20 --out DIR

Runs `seeds` searches side by side (50 initial and 250 sequential simulations each), shows progress
and the worst case so far, and writes to DIR: `evaluations.jsonl` (every simulation, as it comes),
`result.json`, `failures.csv`, `trend.png`, `worst.png`. A run that was killed goes on with
`--resume`; no simulation is repeated. Without `--threshold` it is set at 90 % of the way from the
nominal value to the worst one that gradient ascents find.

One seed takes 10 to 30 CPU-seconds beside the simulations, the first run 30 more to compile.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import (
    enable_compilation_cache,
    open_run,
    print_result,
    progress,
    provenance,
    write_json,
)
from snn_fusion_failure.runs.command import run_command


@dataclasses.dataclass(frozen=True)
class Config:
    """What to search and how."""

    circuit: str = "ldo"
    """Circuit name."""
    spec: str = "undershoot"
    """Specification name."""
    method: str = "full"
    """Search method; an unknown name lists the known ones."""
    task: str = "box"
    """box: every parameter within its bounds; ball: distance from nominal at most `radius`."""
    radius: float = 6.0
    """Radius of the ball [sigma]."""
    seeds: int = 1
    """Searches side by side."""
    first_seed: int = 0
    """Seed of the first one."""
    n_init: int = 50
    """Initial simulations."""
    n_total: int = 300
    """Simulations in all."""
    embedding_dim: int | None = None
    """Search dimensions of HDBO and Rev-ARGate; 22 of 60 and its share elsewhere without."""
    threshold: float | None = None
    """A value beyond it is a failure, in the specification's unit."""
    verify: str | None = None
    """ngspice: simulate every claimed failure again with it."""
    out: Path = Path("runs/find_failures")
    """Run folder."""
    resume: bool = False
    """Go on with the run in `out`."""
    overwrite: bool = False
    """Forget the run in `out`."""


def describe_points(circuit: Any, x: Any) -> str:
    """One failure point as a table: a row per transistor, a column per quantity, in sigma."""
    quantities = list(dict.fromkeys(q for _, q in circuit.parameter_names))
    transistors = list(dict.fromkeys(t for t, _ in circuit.parameter_names))
    values = dict(zip(circuit.parameter_names, x, strict=True))
    lines = ["transistor  " + "  ".join(f"{q:>10}" for q in quantities)]
    for name in transistors:
        cells = (values.get((name, q)) for q in quantities)
        lines.append(
            f"{name:<10}  "
            + "  ".join(f"{c:>+10.2f}" if c is not None else " " * 10 for c in cells)
        )
    return "\n".join(lines)


def threshold_for(circuit: Any, column: int, task: Any, out: Path) -> float:
    """The threshold of this task, computed once per folder."""
    import json

    from failure.search.thresholds import reachable

    path = out / "threshold.json"
    if path.exists():
        return float(json.loads(path.read_text(encoding="utf-8"))["threshold"])
    reach = reachable(circuit.run, column, task, sense=circuit.specs[column].sense)
    write_json(path, reach._asdict())
    return reach.threshold


def main(config: Config) -> dict[str, Any]:
    """Run the searches; returns the result that is also written."""
    import numpy as np

    from failure import circuits, plots
    from failure.search.bayesopt import METHODS, SearchConfig, SearchState, best_so_far, first_hit
    from failure.search.runs import run
    from failure.search.spaces import Task

    if config.verify not in (None, "ngspice"):
        raise ValueError(f"verify={config.verify!r}: expected 'ngspice' or nothing")
    if config.seeds < 1:
        raise ValueError(f"seeds={config.seeds}: expected at least 1")
    circuit = circuits.get(config.circuit)
    column = circuit.spec_index(config.spec)
    spec = circuit.specs[column]
    size = circuit.box if config.task == "box" else config.radius
    search = SearchConfig(
        Task(config.task, float(size), circuit.n_dims),
        config.method,
        seeds=tuple(range(config.first_seed, config.first_seed + config.seeds)),
        n_init=config.n_init,
        n_total=config.n_total,
        embedding_dim=config.embedding_dim,
    )
    settings = {
        k: v
        for k, v in dataclasses.asdict(config).items()
        if k not in ("out", "resume", "overwrite", "verify")
    }
    if config.overwrite:
        for name in ("evaluations.jsonl", "search.json", "surrogate.npz", "space.npz"):
            (config.out / name).unlink(missing_ok=True)
    open_run(config.out, settings, resume=config.resume, overwrite=config.overwrite)
    enable_compilation_cache()
    threshold = config.threshold
    if threshold is None:
        threshold = threshold_for(circuit, column, search.task, config.out)
    sign = 1.0 if spec.sense == "max" else -1.0
    with progress() as bar:
        label = f"{config.circuit} {config.spec} {config.method}"
        job = bar.add_task(label, total=config.n_total, status="")

        def show(state: SearchState) -> None:
            worst = sign * best_so_far(state.y)[:, -1].max()
            hits = int(np.isfinite(first_hit(state.y, sign * threshold)).sum())
            status = f"worst {worst:.4g} {spec.unit}, {hits}/{config.seeds} seeds failed"
            bar.update(job, completed=state.n, status=status)

        state = run(
            search,
            circuit.simulate,
            column,
            sense=spec.sense,
            folder=config.out,
            on_step=show,
        )
    hits = first_hit(state.y, sign * threshold)
    worst = sign * best_so_far(state.y)[:, -1]
    failed = np.argwhere(state.y > sign * threshold)
    names = [f"{t}.{q}" for t, q in circuit.parameter_names]
    with (config.out / "failures.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["seed", "simulation", config.spec, *names])
        for row, index in failed:
            values = [f"{v:.6g}" for v in state.x[row, index]]
            writer.writerow([search.seeds[row], index + 1, sign * state.y[row, index], *values])
    result: dict[str, Any] = {
        "settings": settings,
        "threshold": threshold,
        "unit": spec.unit,
        "first_failure": hits,
        "worst_case": worst,
        "success_rate": float(np.isfinite(hits).mean()),
        "clipped_share": float(state.clipped[:, config.n_init :].mean()),
        "invalid": int((state.status != 0).sum()),
        **provenance(),
    }
    if config.verify and len(failed):
        specs, status = circuit.reference(state.x[failed[:, 0], failed[:, 1]])
        again = (np.asarray(status) == 0) & (sign * np.asarray(specs)[:, column] > sign * threshold)
        result["verified"] = {"claimed": len(failed), "confirmed": int(again.sum())}
    write_json(config.out / "result.json", result)
    plots.plot_trend(
        config.out / "trend.png",
        {METHODS[config.method].label: state.y},
        threshold=sign * threshold,
        n_init=config.n_init,
        label=f"{config.spec} [{spec.unit}]",
    )
    flat = int(np.nanargmax(state.y))
    point = state.x.reshape(-1, circuit.n_dims)[flat]
    plots.plot_activity(
        config.out / "worst.png", circuit.parameter_names, point, title="worst point [sigma]"
    )
    print(f"{len(failed)} failures in {state.y.size} simulations; the worst point, in sigma:")
    print(describe_points(circuit, point))
    reached = hits[np.isfinite(hits)]
    print_result(
        threshold=threshold,
        success=result["success_rate"],
        median_first_failure=float(np.median(reached)) if len(reached) else "none",
        worst=float(sign * np.max(sign * worst)),
        **({"confirmed": result["verified"]["confirmed"]} if "verified" in result else {}),
    )
    return result


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, argv=argv, prog=prog)
