"""A tour in a few minutes: each part of the project does its main job once, at small size.

    make demo

Four robots with the S4 network learn for 20 trials to find a target and are tested; ARGate-L learns
from HAR windows with eight of nine sensors failing (from simulated windows when the HAR data is not
at hand, and says so); a search over 60 dimensions looks for process variations that break the
undershoot specification of an LDO regulator. Leaves pictures and numbers under `runs/demo`, and
`report/index.html`: all results of record beside the source's, on one page. About five minutes on
two CPU cores, half of it compiling.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.records import cells, failure_tables, report
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    print_result,
    provenance,
    repository,
    write_json,
)
from snn_fusion_failure.runs.command import run_command


@dataclasses.dataclass(frozen=True)
class Config:
    """Run the demo."""

    data_dir: Path | None = None
    """Folder of the real data sets; $FUSION_DATA_DIR is searched next."""
    out: Path = Path("runs/demo")
    """Where the pictures and numbers go; an earlier demo there is replaced."""
    report: Path = Path("report")
    """Folder of the page."""


def spiking_robots(config: Config) -> dict[str, Any]:
    """S4 learns Scenario 1 in 20 trials; trajectories before and after."""
    from snn_fusion_failure.commands import train_snn

    found = train_snn.main(
        train_snn.Config(
            scenario=1, model="S4", preset="quick", out=config.out / "robots_S4", overwrite=True
        )
    )
    means = {name: value["mean"] for name, value in found["metrics"].items()}
    return {k: means[k] for k in ("sr_learning", "sr_testing", "path_ratio") if k in means}


def sensor_fusion(config: Config) -> dict[str, Any]:
    """ARGate-L and the baseline on the same corrupted windows."""
    from fusion.data import load
    from snn_fusion_failure.commands import argate_runs, train_argate

    dataset = "har"
    try:
        load("har", config.data_dir)
    except FileNotFoundError:
        print("   HAR data not found (set FUSION_DATA_DIR): simulated windows instead", flush=True)
        dataset = "simulated"
    results = {}
    for model in ("baseline", "argate_l"):
        results[model] = train_argate.main(
            argate_runs.Config(
                dataset=dataset,
                model=model,
                preset="quick",
                protocol="random",
                n_clean=1,
                data_dir=config.data_dir,
                out=config.out / f"fusion_{model}",
                overwrite=True,
            )
        )
    return {
        "dataset": dataset,
        "baseline": results["baseline"]["accuracy"],
        "argate_l": results["argate_l"]["accuracy"],
    }


def _threshold_of_record(circuit: str, spec: str) -> float | None:
    """The failure threshold that Table 4.1 or 4.2 was made with; None where there is none."""
    number, _ = failure_tables.TABLES.get(circuit, ("", ""))
    table = cells.load_tables(repository.RESULTS).get(number, {"rows": []})
    found = (row["threshold"] for row in table["rows"] if row["row"] == f"{spec} (box)")
    return next(found, None)


def failure_search(
    config: Config,
    *,
    circuit: str = "ldo",
    spec: str = "undershoot",
    method: str = "pbo",
    n_total: int = 80,
) -> dict[str, Any]:
    """Bayesian optimisation finds variations of the LDO regulator that break its specification."""
    import numpy as np

    from failure import circuits
    from snn_fusion_failure.commands import find_failures

    built = circuits.get(circuit)
    worst = {"max": max, "min": min}[built.specs[built.spec_index(spec)].sense]
    found = find_failures.main(
        find_failures.Config(
            circuit=circuit, spec=spec, method=method, seeds=2, n_total=n_total,
            threshold=_threshold_of_record(circuit, spec),
            out=config.out / "failures", overwrite=True,
        )
    )  # fmt: skip
    hits = np.asarray(found["first_failure"], float)
    reached = hits[np.isfinite(hits)]
    return {
        "searches_with_failure": len(reached),
        "first_failure": float(np.median(reached)) if len(reached) else None,
        "worst": float(worst(found["worst_case"])),
        "threshold": found["threshold"],
    }


def main(config: Config) -> dict[str, Any]:
    """Run every part and print one line for each."""
    enable_compilation_cache()
    print("== spiking robots: S4 learns to reach a target", flush=True)
    robots = spiking_robots(config)
    print("== sensor fusion: train with most sensors failing", flush=True)
    fusion = sensor_fusion(config)
    print("== rare failures: search 60 process parameters of an LDO regulator", flush=True)
    failures = failure_search(config)
    parts = {"robots": robots, "fusion": fusion, "failures": failures}
    write_json(config.out / "result.json", parts | provenance())
    page = report.write(config.report, fresh=Path("runs/report/results"), record=repository.RESULTS)
    print(f"pictures and numbers in {config.out}; all results of record in {page}")
    print_result(**robots, **fusion, **failures)
    return parts


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line."""
    run_command(Config, main, description=__doc__, argv=argv, prog=prog)
