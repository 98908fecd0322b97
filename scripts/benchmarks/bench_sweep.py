"""What the engine adds to a trial, what workers gain, and how many of them one folder can take.

    python scripts/benchmarks/bench_sweep.py

Measures: the engine's time per trial beside the trial's own; on the file system of `--folder`,
writing, reading and listing chunk files, leases, and several processes that write into one folder
as fast as they can; a sweep with 1, 2 and 4 worker processes. Then simulates up to 10,000 workers
that queue for such a folder and for one that is ten times as slow. Writes
`results/bench_sweep.json`. About three CPU-minutes.
"""

from __future__ import annotations

import dataclasses
import os
import resource
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from snn_fusion_failure.runs import (
    enable_compilation_cache,
    provenance,
    repository,
    run_command,
    write_json,
)
from snn_fusion_failure.sweeps.capacity import chunk_costs, writer_rates
from snn_fusion_failure.sweeps.queueing import simulate

SLOW = 10.0
"""A slow file system takes so many times as long for everything."""


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
    workers: tuple[int, ...] = (1, 2, 4)
    """Worker processes of the measured sweep; empty skips it."""
    chunks: int = 8
    """Chunks from which the engine's time per trial is taken."""
    snn: bool = True
    """Measure a trial of `snn`, to which the engine's time is compared."""
    simulated: tuple[int, ...] = (1, 10, 100, 1_000, 10_000)
    """Workers of the simulation."""
    out: Path = repository.RESULTS / "bench_sweep.json"
    """Where the numbers go."""


class Clocks(NamedTuple):
    """Wall and CPU time of this process [s]."""

    wall: float
    cpu: float

    @classmethod
    def now(cls) -> Clocks:
        """What they show."""
        return cls(time.perf_counter(), time.process_time())


def trial_seconds(study: Any, columns: dict[str, Any], n: int, repeats: int) -> Clocks:
    """Seconds per trial of the study's compiled function alone, `n` side by side; the quickest."""
    import jax
    import numpy as np

    from snn_fusion_failure.sweeps.leaves import batch

    units = {leaf: study.unit_of(leaf) for leaf in study.leaves}
    params = batch(study.params, {k: np.resize(v, n) for k, v in columns.items()}, n, units,
                   study.dtype)  # fmt: skip
    keys = jax.random.split(jax.random.key(0), n)
    run = jax.jit(study.run)
    jax.block_until_ready(run(params, keys))
    spent = []
    for _ in range(repeats):
        start = Clocks.now()
        jax.block_until_ready(run(params, keys))
        end = Clocks.now()
        spent.append((end.wall - start.wall, end.cpu - start.cpu))
    return Clocks(*(min(column) / n for column in zip(*spent, strict=True)))


def _stamp(times: list[Clocks], name: str) -> None:
    times.append(Clocks.now())


def overhead(folder: Path, chunks: int) -> dict[str, Any]:
    """Milliseconds per trial that pass in the engine and not in the trial's own function.

    A sweep in this process, from the beginning of its second chunk (compiled by then) to its end,
    keys, files and leases included, less the time of the compiled function for as many trials.
    Wall time counts what else the machine does; CPU time leaves out waiting for the disk.
    """
    import numpy as np

    from snn_fusion_failure.commands import sweep
    from snn_fusion_failure.sweeps.chunks import run_shard
    from snn_fusion_failure.sweeps.study import load_study

    study = load_study("lif", ["steps=10"])
    found = {}
    for n in (16, 1024):
        count = n * chunks // 16
        config = sweep.Config(
            study="lif", options=("steps=10",), grid=(f"drive=16:40:{count}",), seeds=16,
            chunk_size=str(n), chunk_trials=n, quiet=True, out=folder / f"overhead{n}",
        )  # fmt: skip
        starts: list[Clocks] = []
        made = sweep.open_sweep(config)
        outcome = run_shard(made, on_start=partial(_stamp, starts))
        end = Clocks.now()
        assert outcome.complete and len(starts) == chunks
        own = trial_seconds(study, {"drive": np.linspace(16.0, 40.0, count)}, n, 5)
        trials = n * (chunks - 1)
        found[f"{n} trials a chunk"] = {
            "overhead_ms_per_trial": 1e3 * ((end.wall - starts[1].wall) / trials - own.wall),
            "overhead_cpu_ms_per_trial": 1e3 * ((end.cpu - starts[1].cpu) / trials - own.cpu),
            "trial_ms": 1e3 * own.wall,
        }
    return found


def share_of_snn(per_trial_ms: float) -> dict[str, float]:
    """The engine's time as a share of that of a trial of `snn` at its defaults, both of the CPU."""
    import numpy as np

    from snn_fusion_failure.sweeps.study import load_study

    seconds = trial_seconds(load_study("snn"), {"gamma": np.asarray([1e-4])}, 4, 1).cpu
    return {"snn_trial_cpu_s": seconds, "overhead_percent": 0.1 * per_trial_ms / seconds}


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


def crowds(costs: dict[str, Any], file_s: float, workers: tuple[int, ...]) -> list[dict[str, Any]]:
    """The simulation, for chunks of several lengths, all ways of handing out, both folders."""
    claim_s, entry_s = 1e-3 * costs["lease_ms"], 1e-7 * costs["list_10000_files_ms"]
    rows = []
    for slower in (1.0, SLOW):
        for chunk_s in (1.0, 10.0, 60.0):
            for count in workers:
                for way in ("dealt", "queue", "leases"):
                    numbers = simulate(
                        count, chunk_s, slower * file_s, way=way, claim_s=slower * claim_s,
                        entry_s=slower * entry_s,
                    )  # fmt: skip
                    rows.append({"workers": count, "chunk_s": chunk_s, "way": way,
                                 "slower": slower, **numbers})  # fmt: skip
    return rows


def main(config: Config) -> dict[str, Any]:
    """Measure, simulate, write."""
    enable_compilation_cache()
    with tempfile.TemporaryDirectory(dir=config.folder) as name:
        folder = Path(name)
        engine: dict[str, Any] = overhead(folder, config.chunks)
        if config.snn:
            # 16 trials a chunk is what a sweep of `snn` has by itself.
            engine |= share_of_snn(engine["16 trials a chunk"]["overhead_cpu_ms_per_trial"])
        costs = chunk_costs(folder, config.repeats)
        rates = writer_rates(folder, config.writers, config.repeats)
        times = sweep_times(folder, config.workers, config.steps)
    # The rate under the largest crowd: a lone writer waits for its own disk and core, not for the
    # folder, so its rate says nothing about what the folder can take.
    file_s = 1.0 / rates[str(max(config.writers))]
    busy_s = {"dealt": file_s, "leases": file_s + 1e-3 * costs["lease_ms"]}
    result = {
        "bench": "sweep",
        "engine": engine,
        "chunk": costs,
        "files_per_second_by_writers": rates,
        "sweep_by_workers": times,
        "cores": os.cpu_count(),
        "load_average": os.getloadavg()[0],
        "file_s": file_s,
        "workers_that_saturate_the_folder": {
            way: {f"{c:g} s": c / busy + 1.0 for c in (1.0, 10.0, 60.0)}
            for way, busy in busy_s.items()
        },
        "simulated": crowds(costs, file_s, config.simulated),
        **provenance(),
    }
    write_json(config.out, result)
    return result


def fields(result: dict[str, Any]) -> dict[str, float]:
    """What the result line says, below a line for each simulated crowd."""
    for row in result["simulated"]:
        print(
            f"{row['workers']:>6} workers, chunks of {row['chunk_s']:>4g} s, {row['way']:<6}, "
            f"folder {row['slower']:>4g} times as slow: efficiency {row['efficiency']:.3f}, "
            f"wait {1e3 * row['wait_s']:.1f} ms"
        )
    engine, times = result["engine"], result["sweep_by_workers"]
    share = {"overhead_percent_of_snn": engine.get("overhead_percent")}
    return {
        **engine["1024 trials a chunk"],
        **{name: value for name, value in share.items() if value is not None},
        "write_ms": result["chunk"]["16 trials"]["write_ms"],
        "files_per_second": 1.0 / result["file_s"],
        "saturate_10s": result["workers_that_saturate_the_folder"]["leases"]["10 s"],
        **{f"wall_{k}": v["wall_s"] for k, v in times.items()},
    }


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=fields)
