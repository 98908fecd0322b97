"""Cost of one step of a full-space search that already has a thousand points and more.

    taskset -c 0 python scripts/benchmarks/bench_bo_steps.py [--points 1000 --dim 60]

A search of the whole space (`full`) starts from `--points` given samples of a curved function, as
`failure.start_from` takes them, and goes on for `--steps` simulations. Printed: CPU seconds of a
step, the mean over all (refits of the hyper-parameters included, one in `points / 128` steps) and
the dearest one; compiling is told apart: the first two steps are not counted. Wanted: 2 s at 1,000
points in 60 dimensions. Writes `results/bench_bo_steps.json`; about one CPU-minute.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import (
    enable_compilation_cache,
    provenance,
    repository,
    run_command,
    write_json,
)


@dataclass(frozen=True)
class Config:
    """What to time."""

    points: tuple[int, ...] = (1000,)
    """Points that the search starts with."""
    dim: int = 60
    """Parameters."""
    steps: int = 16
    """Steps that count."""
    method: str = "full"
    """Search: full or turbo."""
    seed: int = 0
    out: Path = repository.RESULTS / "bench_bo_steps.json"


def steps_at(config: Config, points: int) -> dict[str, float]:
    """Seconds of CPU of the steps after `points` points."""
    import jax
    import numpy as np

    from failure import SearchConfig, Task, ask, start_from, tell

    rng = np.random.default_rng(config.seed)
    weight = rng.normal(size=config.dim) / config.dim**0.5

    def simulate(x: Any) -> Any:
        return x @ weight + 0.1 * x[..., 0] * x[..., 1] - 0.05 * x[..., 2] ** 2

    x = rng.normal(size=(points, config.dim))
    # As a search leaves them: half spread out, half about the best.
    x[points // 2 :] = x[np.argmax(simulate(x))] + 0.3 * x[points // 2 :]
    x *= np.minimum(1.0, 12.0 / np.linalg.norm(x, axis=1))[:, None]
    search = SearchConfig(
        Task("ball", 12.0, config.dim), config.method, n_init=50, n_total=points + config.steps + 2
    )
    state = start_from(search, x, simulate(x))
    spent = []
    for _ in range(config.steps + 2):
        start = time.process_time()
        new, state = ask(search, state)
        state = tell(search, state, jax.block_until_ready(simulate(np.asarray(new))))
        spent.append(time.process_time() - start)
    counted = spent[2:]
    return {
        "points": points,
        "mean_s": statistics.mean(counted),
        "median_s": statistics.median(counted),
        "dearest_s": max(counted),
        "first_s": spent[0],
    }


def main(config: Config) -> dict[str, Any]:
    """Time all sizes; returns what is also written."""
    if config.steps < 1 or min(config.points) < 50:
        raise ValueError(
            f"steps={config.steps}, points={config.points}: expected at least 1 and 50"
        )
    enable_compilation_cache()
    cases = [steps_at(config, points) for points in config.points]
    result = {"dim": config.dim, "method": config.method, "cases": cases}
    write_json(config.out, {"benchmark": "bo_steps", **provenance(), **result})
    return result


def fields(result: dict[str, Any]) -> dict[str, float]:
    """What the result line says."""
    return {
        f"{name}_{case['points']}": case[name]
        for case in result["cases"]
        for name in ("mean_s", "dearest_s")
    }


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=fields)
