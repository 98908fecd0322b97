"""Failure probabilities of one in a million and one in a billion: what each method needs.

    python scripts/studies/study_sigma.py [--seeds 20] [--problems linear window] [--specs iq]

Parameters are standard normal in units of sigma. Problems whose probability is known exactly
(`failure.problems`) and, with `--specs`, specifications of the circuits at thresholds of a fixed
probability, which are measured first: long line sampling moves the threshold until the probability
is the wanted one, and importance sampling from the same point checks it. `--netlists` are circuits
that only ngspice knows (`examples/`); they have no gradients.

Methods: `lines` (design point, then line sampling), `guided_lines` (values only, differences taken
again where they matter) and `importance_sampling` from the design point trust that there is one
mechanism; `lines_scan`, `guided_lines_scan` and `importance_sampling_scan`, the functions' default,
look for others with 100 wide samples. `regions` (all regions that can be found, each by lines),
`ak_is` (importance sampling on a refined Gaussian process), `subset_simulation`; with `+gradient`
where gradients are used, each counted as one simulation (`sims_factor2`) or as three
(`sims_factor2_price3`). `--searches` look for the first failure in the ball of 1.1 design
distances. A row of record holds the share of runs that end within a factor 2 of the truth with a
verdict "good" (`success_rate`; of searches the share that finds a failure), what they cost, the
share of all intervals that hold the truth (`coverage`), and the cosine between the design point
that was found and a true one. `first_failure` is the number of simulations to the first failing
one, over the runs that have one; `first_failure_share` says how many those are. A search counts
failures within its ball; an estimator counts one wherever it lies, `lines` and
`importance_sampling` on the way to the design point only, `regions` and `subset_simulation` none.
A truth that was measured has its 95 % interval beside it (`truth_interval`). Every cell is kept in
`--out`, so the command can be killed and repeated. Writes
`results/table_4_sigma.json`; with `--pictures FOLDER` errors of all runs against their cost, and
design points by transistor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.records.sigma_cases import SPECS, Case, cached, circuit_case, problem_case
from snn_fusion_failure.records.sigma_netlists import NETLISTS, netlist_case
from snn_fusion_failure.records.sigma_pictures import Cell, draw_design_points, draw_errors
from snn_fusion_failure.records.sigma_searches import (
    SEARCHES,
    monte_carlo_rows,
    rows_of_search,
    search_runs,
)
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    progress,
    repository,
)
from snn_fusion_failure.runs.command import run_command

UNCOUNTED = ("regions", "subset_simulation")
"""Methods that do not count their simulations to the first failing one."""


@dataclass(frozen=True)
class Config:
    """What to measure."""

    problems: tuple[str, ...] = (
        "linear", "window", "opposite_mechanisms", "many_regions", "hidden_region", "bent",
        "curved_manifold", "shell", "steps", "never_settles",
    )  # fmt: skip
    """Problems of known probability."""
    specs: tuple[str, ...] = ()
    """Specifications: iq, undershoot, load_regulation, overshoot, output_accuracy."""
    netlists: tuple[str, ...] = ()
    """Netlists: memory_cell, opamp_settling, opamp_offset."""
    probabilities: tuple[float, ...] = (1e-6, 1e-9)
    """Failure probabilities."""
    dim: int = 60
    """Parameters of the problems."""
    methods: tuple[str, ...] = (
        "lines", "lines+gradient", "regions", "regions+gradient", "importance_sampling",
        "subset_simulation",
    )  # fmt: skip
    """Methods."""
    seeds: int = 20
    """Runs of each method."""
    searches: tuple[str, ...] = ()
    """Searches for the first failure, keys of `sigma_searches.SEARCHES`."""
    search_seeds: int = 10
    """Runs of each search."""
    search_most: int = 150
    """Simulations of each search at most."""
    out: Path = Path("runs/study_sigma")
    """Folder of the cells."""
    record: Path = repository.RESULTS / "table_4_sigma.json"
    """Table of record."""
    pictures: Path | None = None
    """Folder for pictures of the rows and methods of this command."""


def one_run(case: Case, method: str, seed: int) -> dict[str, Any]:
    """One run of a method: cost, estimate, first failure, cosine."""
    import jax
    import numpy as np

    from failure import rare_events
    from failure.ak_sampling import ak_sampling
    from failure.guided_lines import guided_lines
    from failure.hlrf import find_design_point
    from failure.regions import probability_by_lines

    key = jax.random.key(seed)
    slopes = case.slopes if method.endswith("+gradient") else None
    first = cosine = math.nan
    spent = 0
    base = method.removesuffix("+gradient")
    scan = 100 if base.endswith("_scan") else 0
    base = base.removesuffix("_scan")
    gradients = 0
    if base == "ak_is":
        ak = ak_sampling(case.performance, case.threshold, case.dim, key=key, slopes=slopes)
        found, first, gradients = ak.estimate, ak.first_failure, ak.n_gradients
        cosine = nearest(case, ak.point)
    elif base == "guided_lines":
        found, point, first = guided_lines(
            case.performance, case.threshold, case.dim, key=key, most=max(400, 4 * case.dim),
            scan=scan,
        )  # fmt: skip
        cosine = nearest(case, point)
    elif base == "subset_simulation":
        found = rare_events.subset_simulation(
            case.batched, case.threshold, case.dim, key=key, n=500, replicates=5
        )
    elif base == "regions":
        regions = probability_by_lines(
            case.performance, case.threshold, case.dim, key=key, slopes=slopes
        )
        found, gradients = regions.estimate, regions.n_gradients
        # A descent counts from its own start: there is no count to the first failure of them all.
        cosine = nearest(case, regions.points[0].point)
    else:
        start = 0.5 * np.random.default_rng(seed).normal(size=case.dim) if seed else None
        design = find_design_point(
            case.performance, case.threshold, case.dim, slopes=slopes, start=start, seed=seed
        )
        spent = design.n_simulations + design.n_gradients
        gradients = design.n_gradients
        first, cosine = design.first_failure, nearest(case, design.point)
        if base == "lines":
            found = rare_events.line_sampling(
                case.performance, case.threshold, design, key=key, slopes=slopes, scan=scan
            )
            # The look at the opposite side and the scan are values.
            gradients += max(found.n_simulations - 1 - scan, 0) if slopes else 0
        elif design.converged:
            found = rare_events.importance_sampling(
                case.performance, case.threshold, design.point[None], key=key, n=300, scan=scan
            )
        else:
            found = rare_events.Estimate(math.nan, 0.0, 1.0, 0, 0, 0.0, design.verdict)
    return {
        "simulations": spent + found.n_simulations, "probability": found.probability,
        "lower": found.lower, "upper": found.upper, "verdict": found.verdict,
        "first_failure": first, "cosine": cosine, "gradients": gradients,
    }  # fmt: skip


def nearest(case: Case, point: Any) -> float:
    """Cosine between a point and the true design point that it is most like."""
    import numpy as np

    norms = np.linalg.norm(case.points, axis=1) * max(float(np.linalg.norm(point)), 1e-300)
    return float(np.max(case.points @ np.nan_to_num(point) / norms))


def rows_of(case: Case, method: str, runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of record of one cell."""

    def number(value: Any) -> float:
        return math.nan if value is None else float(value)

    base = {"row": case.row, "model": method, "truth": case.truth, "threshold": case.threshold}
    base |= case.measured
    inside = [number(r["lower"]) <= case.truth <= number(r["upper"]) for r in runs]
    near = [
        r["verdict"] == "good" and 0.5 <= number(r["probability"]) / case.truth <= 2.0 for r in runs
    ]
    cost = [float(r["simulations"]) for r, good in zip(runs, near, strict=True) if good]
    dear = [
        float(r["simulations"]) + 2.0 * float(r["gradients"])
        for r, good in zip(runs, near, strict=True)
        if good and "gradients" in r
    ]
    first = [v for r in runs if math.isfinite(v := number(r["first_failure"]))]
    cosine = [v for r in runs if math.isfinite(v := number(r["cosine"]))]
    n = len(runs)
    rows = [
        {**base, "metric": "success_rate", "unit": "1", "n": n, "mean": sum(near) / n},
        {**base, "metric": "coverage", "unit": "1", "n": n, "mean": sum(inside) / n},
        {**base, "metric": "known", "unit": "1", "n": n,
         "mean": sum(r["verdict"] == "good" for r in runs) / n},
        {**base, "metric": "simulations", "unit": "simulations",
         **summarize([float(r["simulations"]) for r in runs])},
    ]  # fmt: skip
    if method.removesuffix("+gradient") not in UNCOUNTED:
        rows.append(
            {**base, "metric": "first_failure_share", "unit": "1", "n": n, "mean": len(first) / n}
        )
    for metric, unit, values in (
        ("sims_factor2", "simulations", cost),
        ("sims_factor2_price3", "simulations", dear if method.endswith("+gradient") else []),
        ("first_failure", "simulations", first),
        ("design_point_cosine", "1", cosine),
    ):
        if values:
            rows.append({**base, "metric": metric, "unit": unit, **summarize(values)})
    return rows


def main(config: Config) -> dict[str, Any]:
    """Measure what is missing; returns all rows."""
    for name in config.specs:
        if name not in SPECS:
            raise ValueError(f"specs={name!r}: expected some of {', '.join(SPECS)}")
    for name in config.searches:
        if name not in SEARCHES:
            raise ValueError(f"searches={name!r}: expected some of {', '.join(SEARCHES)}")
    for name in config.netlists:
        if name not in NETLISTS:
            raise ValueError(f"netlists={name!r}: expected some of {', '.join(NETLISTS)}")
        slow = [m for m in (*config.methods, *config.searches) if m.endswith("+gradient")]
        if slow:
            raise ValueError(f"methods={slow[0]!r}: a netlist has no gradients; leave it out")
    if config.seeds < 1:
        raise ValueError(f"seeds={config.seeds}: expected at least 1")
    if not config.methods and not config.searches:
        raise ValueError("methods and searches are empty: expected at least one of either")
    enable_compilation_cache()
    names = [*config.specs, *config.netlists, *config.problems]
    rows: list[dict[str, Any]] = []
    cells: list[Cell] = []
    cases: list[Case] = []
    with progress() as bar:
        parts = len(config.methods) + len(config.searches)
        total = len(names) * len(config.probabilities) * parts
        job = bar.add_task("sigma", total=total, status="")
        for name in names:
            for p in config.probabilities:
                if name in SPECS:
                    case = circuit_case(name, p, config.out)
                elif name in NETLISTS:
                    case = netlist_case(name, p, config.out)
                else:
                    case = problem_case(name, p, config.dim)
                cases.append(case)
                bar.update(job, status=case.row)
                rows += other_rows(config, case)
                bar.advance(job, len(config.searches))
                for method in config.methods:
                    bar.update(job, status=f"{case.row} {method}")
                    folder = config.out / case.row.replace(" ", "_") / method
                    runs = [
                        cached(folder / f"{seed}.json", lambda s=seed: one_run(case, method, s))  # type: ignore[misc]  # noqa: B023
                        for seed in range(config.seeds)
                    ]
                    cells.append(Cell(case, method, runs))
                    new = rows_of(case, method, runs)
                    rows += new
                    title = "Failures at fixed probability"
                    record_table(
                        config.record, "4.sigma", title, new, preset="paper", whole_cells=True
                    )
                    bar.advance(job)
    if config.pictures is not None:
        draw_errors(cells, config.pictures / "table_4_sigma.png")
        draw_design_points(cases, config.pictures)
    return {"rows": rows}


def other_rows(config: Config, case: Case) -> list[dict[str, Any]]:
    """What Monte Carlo is expected to need, and the searches for a first failure."""
    rows = monte_carlo_rows(case.row, case.truth, case.threshold)
    for name in config.searches:
        path = config.out / case.row.replace(" ", "_") / name / f"first_{config.search_seeds}.json"
        runs = cached(
            path,
            lambda n=name: search_runs(  # type: ignore[misc]
                n, case.performance, case.slopes, case.threshold, case.points,
                seeds=config.search_seeds, most=config.search_most,
            ),
        )  # fmt: skip
        rows += rows_of_search(case.row, name, case.truth, case.threshold, runs)
    rows = [row | case.measured for row in rows]
    title = "Failures at fixed probability"
    record_table(config.record, "4.sigma", title, rows, preset="paper", whole_cells=True)
    return rows


def result(found: dict[str, Any]) -> dict[str, Any]:
    """The result line: least coverage and mean success over the cells of the methods."""
    covered = [r for r in found["rows"] if r["metric"] == "coverage"]
    methods = {r["model"] for r in covered}
    good = [
        r["mean"] for r in found["rows"] if r["metric"] == "success_rate" and r["model"] in methods
    ]
    fields = {"rows": len(found["rows"])}
    if not covered:
        return fields
    least = min(r["mean"] for r in covered)
    return fields | {"least_coverage": least, "mean_success": sum(good) / len(good)}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=result)
