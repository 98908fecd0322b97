"""What a chunk costs, what two workers gain, and how many workers one folder can take.

    python scripts/benchmarks/bench_sweep.py

Measures, on the file system of `--folder`: writing, reading and listing chunk files; several
processes that write into one folder as fast as they can; a sweep with one and with two worker
processes. Then simulates up to 1,000 workers that compute a chunk, wait for their turn at the
folder and go on, with the measured time per file. Writes `results/bench_sweep.json`. About 90
seconds on two free cores.
"""

from __future__ import annotations

import dataclasses
import os
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import (
    enable_compilation_cache,
    provenance,
    repository,
    run_command,
    write_json,
)
from snn_fusion_failure.sweeps.capacity import chunk_costs, writer_rates
from snn_fusion_failure.sweeps.queueing import simulate


@dataclasses.dataclass(frozen=True)
class Config:
    """What to measure."""

    folder: Path | None = None
    """Where to write; a folder of a cluster's shared file system measures that one."""
    repeats: int = 60
    """Files per measurement."""
    writers: tuple[int, ...] = (1, 2, 4, 8)
    """Processes that write at the same time."""
    steps: int = 60_000
    """Steps per trial of the study that the workers run."""
    workers: tuple[int, ...] = (1, 2)
    """Worker processes of the measured sweep; empty skips it."""
    out: Path = repository.RESULTS / "bench_sweep.json"
    """Where the numbers go."""


def sweep_times(folder: Path, workers: tuple[int, ...], steps: int) -> dict[str, Any]:
    """Wall and CPU seconds of one sweep with each number of worker processes."""
    import xarray as xr  # before the clock runs

    from snn_fusion_failure.commands import sweep
    from snn_fusion_failure.sweeps.engine import collect

    found: dict[str, Any] = {}
    for count in workers:
        config = sweep.Config(
            study="lif", options=(f"steps={steps}",), grid=("drive=16:40:16", "tau_m=10,20"),
            seeds=16, chunk_size="16", chunk_trials=16, workers=count, quiet=True,
            out=folder / f"sweep{count}",
        )  # fmt: skip
        made = sweep.open_sweep(config)
        collect(made)  # loads what gathering needs
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        own, start = time.process_time(), time.perf_counter()
        errors = sweep.run(config, made)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        if errors:
            raise RuntimeError(f"{count} workers: {errors}")
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        summary = collect(made)[1]
        assert summary["complete"]
        with xr.open_dataset(made.out / "results.nc") as data:
            inside = float(data.attrs["compute_seconds"])
        found[str(count)] = {
            "wall_s": time.perf_counter() - start,
            "cpu_s": cpu + time.process_time() - own,
            "in_chunks_s": inside,
            "trials": summary["trials"],
            "load_average": os.getloadavg()[0],
        }
    return found


def main(config: Config) -> dict[str, Any]:
    """Measure, simulate, write."""
    enable_compilation_cache()
    with tempfile.TemporaryDirectory(dir=config.folder) as name:
        folder = Path(name)
        costs = chunk_costs(folder, config.repeats)
        rates = writer_rates(folder, config.writers, config.repeats)
        times = sweep_times(folder, config.workers, config.steps)
    # The rate under the largest crowd: a lone writer waits for its own disk and core, not for the
    # folder, so its rate says nothing about what the folder can take.
    file_s = 1.0 / rates[str(max(config.writers))]
    simulated = []
    for chunk_s in (1.0, 10.0, 60.0):
        for workers in (1, 10, 100, 300, 1000):
            for pull in (False, True):
                numbers = simulate(workers, chunk_s, file_s, pull=pull)
                simulated.append({"workers": workers, "chunk_s": chunk_s, "pull": pull, **numbers})
    limits = {f"{c:g} s": c / file_s + 1.0 for c in (1.0, 10.0, 60.0)}
    result = {
        "bench": "sweep",
        "chunk": costs,
        "files_per_second_by_writers": rates,
        "sweep_by_workers": times,
        "load_average": os.getloadavg()[0],
        "file_s": file_s,
        "workers_that_saturate_the_folder": limits,
        "simulated": simulated,
        **provenance(),
    }
    write_json(config.out, result)
    return result


def fields(result: dict[str, Any]) -> dict[str, float]:
    """What the result line says, below a line for each simulated crowd."""
    for row in result["simulated"]:
        way = "pulled" if row["pull"] else "shards"
        print(
            f"{row['workers']:>5} workers, chunks of {row['chunk_s']:>4g} s, {way}: efficiency "
            f"{row['efficiency']:.3f}, wait {1e3 * row['wait_s']:.1f} ms"
        )
    times = result["sweep_by_workers"]
    return {
        "write_ms": result["chunk"]["16 trials"]["write_ms"],
        "files_per_second": 1.0 / result["file_s"],
        "saturate_10s": result["workers_that_saturate_the_folder"]["10 s"],
        **{f"wall_{k}": v["wall_s"] for k, v in times.items()},
    }


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=fields)
