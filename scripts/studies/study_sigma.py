"""Failure probabilities of one in a million and one in a billion: what each method needs.

    python scripts/studies/study_sigma.py [--seeds 20] [--problems linear window] [--specs iq]

Parameters are standard normal in units of sigma. Problems whose probability is known exactly
(`failure.problems`) and, with `--specs`, specifications of the circuits at thresholds of a fixed
probability, which are measured first: long line sampling moves the threshold until the probability
is the wanted one, and importance sampling from the same point checks it.

Methods: `lines` (design point, then line sampling), `regions` (all regions that can be found, each
by lines), `importance_sampling` from the design point, `subset_simulation`; with `+gradient` where
gradients are used, each counted as one simulation. A row of record holds simulations to the first
failure, the share of runs that end within a factor 2 of the truth with a verdict "good"
(`success_rate`), what they cost (`sims_factor2`), the share of all intervals that hold the truth
(`coverage`), and the cosine between the design point that was found and a true one. Every cell
is kept in `--out`, so the command can be killed and repeated. Writes `results/table_4_sigma.json`;
the default takes about 6 CPU-minutes, a specification 3 more.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    progress,
    repository,
    write_json,
)
from snn_fusion_failure.runs.command import run_command

SPECS = {
    "iq": ("ldo", "quiescent_current"),
    "undershoot": ("ldo", "undershoot"),
    "load_regulation": ("ldo", "load_regulation"),
    "overshoot": ("dcdc", "overshoot"),
    "output_accuracy": ("dcdc", "output_accuracy"),
}
"""Name in the table -> circuit and specification."""

LINES = 400
"""Lines behind the probability at a measured threshold."""


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
    out: Path = Path("runs/study_sigma")
    """Folder of the cells."""
    record: Path = repository.RESULTS / "table_4_sigma.json"
    """Table of record."""


class Case(NamedTuple):
    """A row: what is simulated, its threshold, the truth."""

    row: str
    performance: Callable[[Any], Any]
    slopes: Callable[[Any], Any]
    threshold: float
    dim: int
    truth: float
    points: Any
    batched: Callable[[Any], Any]


def problem_case(name: str, p: float, dim: int) -> Case:
    """A problem of known probability."""
    import jax

    from failure.performances import slopes_by_jax
    from failure.problems import make_problem

    problem = make_problem(name, p, dim)
    with jax.enable_x64(True):
        program = jax.jit(problem.performance)
    return Case(
        f"{name} P={p:.0e}", program, slopes_by_jax(problem.performance), problem.threshold,
        dim, problem.probability, problem.points, problem.performance,
    )  # fmt: skip


def circuit_case(name: str, p: float, folder: Path) -> Case:
    """A specification at the threshold of a wanted probability."""
    import numpy as np

    from failure import circuits

    circuit_name, spec = SPECS[name]
    circuit = circuits.get(circuit_name)
    column, dim = circuit.spec_index(spec), circuit.n_dims
    sign = 1.0 if circuit.specs[column].sense == "max" else -1.0

    def performance(x: Any) -> Any:
        x = np.asarray(x, np.float64)
        # Two sizes of batch in all, so that two programs are compiled.
        size = 8 if len(x) <= 8 else 128
        fill = -len(x) % size
        blocks = np.concatenate([x, np.repeat(x[-1:], fill, axis=0)]).reshape(-1, size, dim)
        values = []
        for block in blocks:
            specs, status = circuit.simulate(block)
            y = np.asarray(specs)[:, column]
            values.append(np.where(np.asarray(status) == 0, sign * y, np.nan))
        return np.concatenate(values)[: len(x)]

    def slopes(x: Any) -> Any:
        """Central differences in the place of an adjoint; counted as one simulation."""
        x = np.asarray(x, np.float64)
        step = 2e-3 * np.eye(dim)
        up, down = (x[:, None] + s * step for s in (1.0, -1.0))
        y = performance(np.concatenate([x, up.reshape(-1, dim), down.reshape(-1, dim)]))
        n = len(x)
        both = y[n:].reshape(2, n, dim)
        return y[:n], (both[0] - both[1]) / 4e-3

    target = cached(
        folder / f"threshold_{name}_{p:.0e}.json",
        lambda: measured_threshold(performance, slopes, dim, p),
    )
    return Case(
        f"{name} P={p:.0e}", performance, slopes, target["threshold"], dim,
        target["probability"], np.asarray(target["point"])[None], performance,
    )  # fmt: skip


def cached(path: Path, make: Callable[[], Any]) -> Any:
    """A JSON value that is computed once."""
    if not path.exists():
        write_json(path, make())
    return json.loads(path.read_text(encoding="utf-8"))


def measured_threshold(performance: Any, slopes: Any, dim: int, p: float) -> dict[str, Any]:
    """The threshold whose probability is p, to a few percent; the probability there, measured."""
    import jax
    import numpy as np
    from scipy.stats import norm

    from failure.hlrf import find_design_point
    from failure.lines import line_sampling
    from failure.rare_events import importance_sampling

    y, g = slopes(np.zeros((1, dim)))
    threshold = float(y[0]) + float(norm.isf(p)) * float(np.linalg.norm(g[0]))
    for _ in range(4):
        design = find_design_point(performance, threshold, dim, slopes=slopes)
        found = line_sampling(
            performance, threshold, design, key=jax.random.key(7), min_lines=30, max_lines=30
        )
        gap = float(norm.isf(p) - norm.isf(found.probability))
        if abs(gap) < 0.01:
            break
        threshold += gap * float(np.linalg.norm(design.gradient))
    design = find_design_point(performance, threshold, dim, slopes=slopes)
    exact = line_sampling(
        performance, threshold, design, key=jax.random.key(8), min_lines=LINES, max_lines=LINES
    )
    check = importance_sampling(
        performance, threshold, design.point[None], key=jax.random.key(9), n=1500
    )
    return {
        "threshold": threshold, "probability": exact.probability,
        "interval": [exact.lower, exact.upper], "point": design.point, "beta": design.beta,
        "check": check.probability, "check_interval": [check.lower, check.upper],
        "verdict": exact.verdict,
    }  # fmt: skip


def one_run(case: Case, method: str, seed: int) -> dict[str, Any]:
    """One run of a method: cost, estimate, first failure, cosine."""
    import jax
    import numpy as np

    from failure import rare_events
    from failure.hlrf import find_design_point
    from failure.regions import probability_by_lines

    key = jax.random.key(seed)
    slopes = case.slopes if method.endswith("+gradient") else None
    first = cosine = math.nan
    spent = 0
    base = method.removesuffix("+gradient")
    if base == "subset_simulation":
        found = rare_events.subset_simulation(
            case.batched, case.threshold, case.dim, key=key, n=500, replicates=5
        )
    elif base == "regions":
        regions = probability_by_lines(
            case.performance, case.threshold, case.dim, key=key, slopes=slopes
        )
        found = regions.estimate
        # A descent counts from its own start: there is no count to the first failure of them all.
        cosine = nearest(case, regions.points[0].point)
    else:
        start = 0.5 * np.random.default_rng(seed).normal(size=case.dim) if seed else None
        design = find_design_point(
            case.performance, case.threshold, case.dim, slopes=slopes, start=start, seed=seed
        )
        spent = design.n_simulations + design.n_gradients
        first, cosine = design.first_failure, nearest(case, design.point)
        if base == "lines":
            found = rare_events.line_sampling(
                case.performance, case.threshold, design, key=key, slopes=slopes
            )
        elif design.converged:
            found = rare_events.importance_sampling(
                case.performance, case.threshold, design.point[None], key=key, n=300
            )
        else:
            found = rare_events.Estimate(math.nan, 0.0, 1.0, 0, 0, 0.0, design.verdict)
    return {
        "simulations": spent + found.n_simulations, "probability": found.probability,
        "lower": found.lower, "upper": found.upper, "verdict": found.verdict,
        "first_failure": first, "cosine": cosine,
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
    inside = [number(r["lower"]) <= case.truth <= number(r["upper"]) for r in runs]
    near = [
        r["verdict"] == "good" and 0.5 <= number(r["probability"]) / case.truth <= 2.0 for r in runs
    ]
    cost = [float(r["simulations"]) for r, good in zip(runs, near, strict=True) if good]
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
    for metric, unit, values in (
        ("sims_factor2", "simulations", cost),
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
    if config.seeds < 1:
        raise ValueError(f"seeds={config.seeds}: expected at least 1")
    enable_compilation_cache()
    names = [*config.specs, *config.problems]
    rows: list[dict[str, Any]] = []
    with progress() as bar:
        total = len(names) * len(config.probabilities) * len(config.methods)
        job = bar.add_task("sigma", total=total, status="")
        for name in names:
            for p in config.probabilities:
                if name in SPECS:
                    case = circuit_case(name, p, config.out)
                else:
                    case = problem_case(name, p, config.dim)
                for method in config.methods:
                    bar.update(job, status=f"{case.row} {method}")
                    folder = config.out / case.row.replace(" ", "_") / method
                    runs = [
                        cached(folder / f"{seed}.json", lambda s=seed: one_run(case, method, s))  # type: ignore[misc]  # noqa: B023
                        for seed in range(config.seeds)
                    ]
                    new = rows_of(case, method, runs)
                    rows += new
                    title = "Failures at fixed probability"
                    record_table(config.record, "4.sigma", title, new, preset="paper")
                    bar.advance(job)
    return {"rows": rows}


def result(found: dict[str, Any]) -> dict[str, Any]:
    """The result line: least coverage and mean success over the cells."""
    by = {m: [r["mean"] for r in found["rows"] if r["metric"] == m] for m in ("coverage",)}
    good = [r["mean"] for r in found["rows"] if r["metric"] == "success_rate"]
    return {
        "rows": len(found["rows"]),
        "least_coverage": min(by["coverage"]),
        "mean_success": sum(good) / len(good),
    }


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=result)
