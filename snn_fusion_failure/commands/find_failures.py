"""Search a circuit for parameter variations that break a specification.

    python scripts/find_failures.py --circuit ldo --spec undershoot --seeds 20 --out DIR

Runs `seeds` searches side by side (`--preset paper`: 50 initial and 250 further simulations each;
`quick`: 10 and 20), shows progress and the worst case so far, and writes to DIR:
`evaluations.jsonl` (every simulation, as it comes), `result.json`, `failures.csv`, `trend.png`,
`worst.png`. A run that was killed goes on with `--resume`; no simulation is repeated. Without
`--threshold` it is set at 90 % of the way from the nominal value to the worst one that gradient
ascents find. `--set search.refit_every=4` changes a constant of the search.

A netlist of your own: `sff find-failures --netlist FILE --help`.

One seed takes 10 to 30 CPU-seconds beside the simulations, the first run 30 more to compile.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import (
    WorkFailedError,
    apply_changes,
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
    """Circuit name, or module:function of yours, `x [d] -> value` (with --spec value)."""
    dimensions: int | None = None
    """Numbers that a function of yours takes."""
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
    preset: str = "paper"
    """quick (10 initial of 30 simulations) or paper (50 of 300)."""
    n_init: int | None = None
    """Initial simulations, instead of the preset's."""
    n_total: int | None = None
    """Simulations in all, instead of the preset's."""
    set: tuple[str, ...] = ()
    """Constants of the search to change: search.NAME=VALUE."""
    embedding_dim: int | None = None
    """Search dimensions of HDBO and Rev-ARGate; 22 of 60 and its share elsewhere without."""
    threshold: float | None = None
    """A value beyond it is a failure, in the specification's unit."""
    verify: str | None = None
    """ngspice: simulate every claimed failure again with it."""
    out: Path = Path("runs/find_failures")
    """Run folder."""
    resume: bool = False
    """Go on with the run in `out`, also with a larger budget."""
    overwrite: bool = False
    """Forget the run in `out`."""


BUDGETS = {"quick": (10, 30), "paper": (50, 300)}
"""Preset -> initial simulations, simulations in all."""


def search_of(config: Config, task: Any) -> Any:
    """The search that the options ask for."""
    from failure.search.bayesopt import SearchConfig

    if config.preset not in BUDGETS:
        raise ValueError(f"preset={config.preset!r}: expected one of {', '.join(BUDGETS)}")
    n_init, n_total = BUDGETS[config.preset]
    search = SearchConfig(
        task,
        config.method,
        seeds=tuple(range(config.first_seed, config.first_seed + config.seeds)),
        n_init=n_init if config.n_init is None else config.n_init,
        n_total=n_total if config.n_total is None else config.n_total,
        embedding_dim=config.embedding_dim,
    )
    return apply_changes({"search": search}, config.set)["search"]


def main(config: Config) -> dict[str, Any]:
    """Run the searches; returns the result that is also written."""
    import numpy as np

    from failure.search.bayesopt import METHODS, SearchState, best_so_far, first_hit
    from failure.search.runs import run
    from failure.search.task import Task
    from failure.simulators import SimulatorError
    from snn_fusion_failure.commands.own_circuit import find_circuit
    from snn_fusion_failure.records import failure_runs

    if config.verify not in (None, "ngspice"):
        raise ValueError(f"verify={config.verify!r}: expected 'ngspice' or nothing")
    if config.seeds < 1:
        raise ValueError(f"seeds={config.seeds}: expected at least 1")
    circuit = find_circuit(config.circuit, config.dimensions)
    column = circuit.spec_index(config.spec)
    spec = circuit.specs[column]
    size = circuit.box if config.task == "box" else config.radius
    search = search_of(config, Task(config.task, float(size), circuit.n_dims))
    other = ("out", "resume", "overwrite", "verify")
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in other}
    if config.overwrite:
        held = ("evaluations.jsonl", "search.json", "surrogate.npz", "space.npz", "threshold.json")
        for name in held:
            (config.out / name).unlink(missing_ok=True)
    # The search itself refuses a smaller budget and another initial design.
    open_run(
        config.out, settings, resume=config.resume, overwrite=config.overwrite,
        may_change=("n_total", "preset"),
    )  # fmt: skip
    enable_compilation_cache()
    threshold = config.threshold
    if threshold is None:
        threshold = failure_runs.threshold_for(circuit, column, search.task, config.out)
    sign = 1.0 if spec.sense == "max" else -1.0
    with progress() as bar:
        label = f"{config.circuit} {config.spec} {config.method}"
        job = bar.add_task(label, total=search.n_total, status="")

        def show(state: SearchState) -> None:
            worst = sign * best_so_far(state.y)[:, -1].max()
            hits = int(np.isfinite(first_hit(state.y, sign * threshold)).sum())
            status = f"worst {worst:.4g} {spec.unit}, {hits}/{config.seeds} seeds failed"
            bar.update(job, completed=state.n, status=status)

        try:
            state = run(
                search, circuit.simulate, column,
                sense=spec.sense, folder=config.out, on_step=show,
            )  # fmt: skip
        except SimulatorError as error:
            raise WorkFailedError(str(error)) from error
    hits = first_hit(state.y, sign * threshold)
    worst = sign * best_so_far(state.y)[:, -1]
    failed = np.argwhere(state.y > sign * threshold)
    failure_runs.write_failures(config.out, circuit, column, search.seeds, state, sign * threshold)
    result: dict[str, Any] = {
        "settings": settings,
        "threshold": threshold,
        "unit": spec.unit,
        "first_failure": hits,
        "worst_case": worst,
        "success_rate": float(np.isfinite(hits).mean()),
        "clipped_share": float(state.clipped[:, search.n_init :].mean()),
        "invalid": int((state.status != 0).sum()),
        **provenance(),
    }
    if config.verify and len(failed):
        result["verified"] = failure_runs.verified(circuit, column, state, sign * threshold)
    write_json(config.out / "result.json", result)
    label = METHODS[config.method].label
    point = failure_runs.pictures(
        config.out, circuit, column, state, sign * threshold, label=label, n_init=search.n_init
    )
    print(f"{len(failed)} failures in {state.y.size} simulations; the worst point, in sigma:")
    print(failure_runs.describe_point(circuit, point))
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
    """Parse, run, print the result line; `--netlist` asks for a netlist's own options."""
    given = sys.argv[1:] if argv is None else argv
    if any(word.split("=")[0] == "--netlist" for word in given):
        from snn_fusion_failure.commands import netlist_failures as other

        run_command(
            other.NetlistConfig, other.main, description=other.__doc__, argv=argv, prog=prog
        )
        return
    run_command(Config, main, description=__doc__, argv=argv, prog=prog)
