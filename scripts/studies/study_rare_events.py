"""Do the 95 % intervals of the failure probability cover the truth?

    python scripts/studies/study_rare_events.py [--runs 100]

Problems in 60 dimensions whose probability is known: linear (1e-3, 1e-6, 1e-9), quadratic (10 of
the 60 dimensions bend the boundary), two failure regions. Every estimator runs `runs` times with
other random keys; counted is how often its interval covers the truth (at least 90 of 100 wanted),
with the median width (upper over lower end), the mean of estimate over truth and the simulations of
a run. Importance sampling is given the most likely failure points, and once those that
`design_points` finds from failures far away. Writes `results/study_rare_events.json`; about
3 CPU-minutes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from snn_fusion_failure.runs import progress, provenance, repository, run_command, write_json

DIM = 60


@dataclass(frozen=True)
class Config:
    """Size of the study."""

    runs: int = 100
    """Runs of every estimator on every problem."""
    n_importance: int = 1000
    """Samples of a run of importance sampling."""
    n_subset: int = 1000
    """Samples per level and replicate of subset simulation."""
    replicates: int = 10
    """Replicates of a run of subset simulation."""
    out: Path = repository.RESULTS / "study_rare_events.json"


class Problem(NamedTuple):
    """A performance function, its threshold, the exact probability, most likely failures."""

    name: str
    performance: Callable[[Any], Any]
    threshold: float
    truth: float
    points: Any


def problems() -> list[Problem]:
    """The problems with a known answer."""
    import jax.numpy as jnp
    import numpy as np
    from scipy import integrate, stats

    slope = np.arange(1.0, DIM + 1.0)
    slope /= np.linalg.norm(slope)

    def linear(x: Any) -> Any:
        return x @ jnp.asarray(slope, x.dtype)

    def quadratic(x: Any) -> Any:
        return x[:, 0] + 0.02 * jnp.sum(x[:, 1:11] ** 2, 1)

    def two_regions(x: Any) -> Any:
        return jnp.maximum(x[:, 0], 0.3 - x[:, 1])

    def bent(s: float) -> float:
        return float(stats.norm.sf(6.0 - 0.02 * s) * stats.chi2.pdf(s, 10))

    found = []
    for p in (1e-3, 1e-6, 1e-9):
        reach = float(stats.norm.isf(p))
        found.append(Problem(f"linear {p:.0e}", linear, reach, p, reach * slope[None]))
    unit = np.eye(DIM)
    truth = integrate.quad(bent, 0, 200, epsabs=0, epsrel=1e-10)[0]
    found.append(Problem("quadratic", quadratic, 6.0, truth, 6.0 * unit[:1]))
    a, b = stats.norm.sf(5.5), stats.norm.sf(5.2)
    corners = np.stack([5.5 * unit[0], -5.2 * unit[1]])
    found.append(Problem("two regions", two_regions, 5.5, float(a + b - a * b), corners))
    return found


def main(config: Config) -> dict[str, Any]:
    """Run the study; returns the rows that are also written."""
    import jax
    import numpy as np

    from failure import rare_events

    rows: list[dict[str, Any]] = []
    cases = problems()
    with progress() as bar:
        job = bar.add_task("rare events", total=3 * len(cases) * config.runs, status="")

        def measure(name: str, case: Problem, run: Callable[[int], Any], extra: int = 0) -> None:
            results = []
            for k in range(config.runs):
                results.append(run(k))
                bar.advance(job)
            inside = [r.lower <= case.truth <= r.upper for r in results]
            widths = [r.upper / r.lower if r.lower > 0 else float("inf") for r in results]
            rows.append(
                {
                    "problem": case.name,
                    "estimator": name,
                    "truth": case.truth,
                    "runs": config.runs,
                    "covered": int(np.sum(inside)),
                    "estimate_over_truth": float(np.mean([r.probability for r in results]))
                    / case.truth,
                    "median_upper_over_lower": float(np.median(widths)),
                    "simulations": float(np.mean([r.n_simulations for r in results])) + extra,
                }
            )

        for case in cases:

            def important(k: int, points: Any, case: Problem = case) -> Any:
                return rare_events.importance_sampling(
                    case.performance, case.threshold, points, key=jax.random.key(k),
                    n=config.n_importance, scan=0,
                )  # fmt: skip

            def subset(k: int, case: Problem = case) -> Any:
                return rare_events.subset_simulation(
                    case.performance, case.threshold, DIM, key=jax.random.key(k),
                    n=config.n_subset, replicates=config.replicates,
                )  # fmt: skip

            measure("importance_sampling", case, partial(important, points=case.points))
            rng = np.random.default_rng(0)
            far = np.repeat(1.6 * case.points, 3, axis=0)
            far = far + 0.5 * rng.normal(size=far.shape)
            points, used = rare_events.design_points(case.performance, case.threshold, far)
            measure(
                "design_points + importance_sampling",
                case,
                partial(important, points=points),
                used,
            )
            measure("subset_simulation", case, subset)
    write_json(config.out, {"study": "rare_events", **provenance(), "rows": rows})
    return {"rows": rows}


def summary(found: dict[str, Any]) -> dict[str, int]:
    """Runs, and the least count of intervals that cover by estimator."""
    worst: dict[str, int] = {}
    for row in found["rows"]:
        name = row["estimator"].split(" ")[0]
        worst[name] = min(worst.get(name, row["runs"]), row["covered"])
    return {"runs": found["rows"][0]["runs"], **{f"least_{k}": v for k, v in worst.items()}}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=summary)
