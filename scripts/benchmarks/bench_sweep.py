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
import heapq
import multiprocessing
import os
import resource
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import tyro

from snn_fusion_failure.runs import (
    enable_compilation_cache,
    print_result,
    provenance,
    repository,
    write_json,
)


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


def write_chunks(folder: str, first: int, count: int, n_trials: int) -> list[float]:
    """Seconds that each of `count` chunk files took to write."""
    import numpy as np

    from snn_fusion_failure.sweeps.chunkfile import save_chunk

    trials = np.stack([np.arange(n_trials)] * 2, 1)
    words = np.zeros((n_trials, 2), np.uint32)
    metrics = {f"metric{i}": np.random.default_rng(i).random(n_trials) for i in range(4)}
    status = np.zeros(n_trials, np.int8)
    seconds = []
    for number in range(first, first + count):
        start = time.perf_counter()
        save_chunk(
            Path(folder) / f"{number:06d}.npz", trials, words, metrics, status, seconds=1.0,
            messages={}, source="", notes=[], device="",
        )  # fmt: skip
        seconds.append(time.perf_counter() - start)
    return seconds


def chunk_costs(folder: Path, repeats: int) -> dict[str, Any]:
    """Milliseconds per chunk file: written, read, listed; and its size."""
    from snn_fusion_failure.sweeps.chunkfile import load_chunk

    costs: dict[str, Any] = {}
    names = [f"metric{i}" for i in range(4)]
    for n_trials in (16, 1024):
        place = folder / f"trials{n_trials}"
        seconds = write_chunks(str(place), 0, repeats, n_trials)
        files = sorted(place.iterdir())
        start = time.perf_counter()
        for file in files:
            load_chunk(file, names)
        read = (time.perf_counter() - start) / len(files)
        costs[f"{n_trials} trials"] = {
            "write_ms": 1e3 * statistics.median(seconds),
            "write_ms_p95": 1e3 * sorted(seconds)[int(0.95 * len(seconds))],
            "read_ms": 1e3 * read,
            "bytes": files[0].stat().st_size,
        }
    crowd = folder / "crowd"
    crowd.mkdir()
    for number in range(10_000):
        (crowd / f"{number:06d}.npz").touch()
    times = []
    for _ in range(9):
        start = time.perf_counter()
        sum(name.endswith(".npz") for name in os.listdir(crowd))
        times.append(time.perf_counter() - start)
    costs["list_10000_files_ms"] = 1e3 * statistics.median(times)
    return costs


def crowd_rates(folder: Path, writers: tuple[int, ...], repeats: int) -> dict[str, float]:
    """Files per second of all of `k` processes that write into one folder."""
    context = multiprocessing.get_context("spawn")
    rates = {}
    for k in writers:
        place = folder / f"writers{k}"
        with context.Pool(k) as pool:
            # Started, imported and once through before the clock runs.
            pool.starmap(write_chunks, [(str(place), 900_000 + i, 1, 16) for i in range(4 * k)])
            start = time.perf_counter()
            pool.starmap(
                write_chunks, [(str(place), i * repeats, repeats, 16) for i in range(k)],
                chunksize=1,
            )  # fmt: skip
            rates[str(k)] = k * repeats / (time.perf_counter() - start)
    return rates


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


def simulate(
    workers: int, chunk_s: float, file_s: float, *, per_worker: int = 20, spread: float = 0.3,
    pull: bool = False, seed: int = 0,
) -> dict[str, float]:  # fmt: skip
    r"""Workers that compute a chunk, queue for the folder, write, and take the next one.

    The folder is one server that takes `file_s` per file, first come first served; a chunk takes
    `chunk_s` times a log-normal factor of mean 1 and standard deviation `spread`. At most
    :math:`c / f + 1` workers can be kept busy by a folder that takes f per file, c being the time
    of a chunk.

    Args:
        workers: number of workers.
        chunk_s, file_s: seconds.
        per_worker: chunks per worker.
        spread: of the chunks' times.
        pull: chunks are taken from one queue (Ray) rather than dealt out beforehand (shards).
        seed: of the chunks' times.

    Returns:
        `efficiency`, the share of the workers' time until the last file that was spent computing,
        and `wait_s`, the mean wait for the folder per file.

    Example:
        >>> one = simulate(1, 1.0, 0.5, spread=0.0)
        >>> round(one["efficiency"], 3), one["wait_s"]
        (0.667, 0.0)
    """
    import numpy as np

    rng = np.random.default_rng(seed)
    sigma = np.sqrt(np.log1p(spread**2))
    times = chunk_s * np.exp(sigma * rng.standard_normal((workers, per_worker)) - sigma**2 / 2)
    flat = iter(times.ravel())
    own = [iter(row) for row in times]
    total = workers * per_worker

    def take(worker: int) -> float | None:
        value = next(flat if pull else own[worker], None)
        return None if value is None else float(value)

    # (time at which a worker comes to the folder, worker): a heap serves them in order of arrival.
    arrivals: list[tuple[float, int]] = []
    for worker in range(workers):
        first = take(worker)
        if first is not None:
            heapq.heappush(arrivals, (first, worker))
    free = wait = 0.0
    while arrivals:
        now, worker = heapq.heappop(arrivals)
        begin = max(now, free)
        wait += begin - now
        free = begin + file_s
        following = take(worker)
        if following is not None:
            heapq.heappush(arrivals, (free + following, worker))
    return {"efficiency": float(times.sum()) / (workers * free), "wait_s": wait / total}


def main(config: Config) -> dict[str, Any]:
    """Measure, simulate, write."""
    enable_compilation_cache()
    with tempfile.TemporaryDirectory(dir=config.folder) as name:
        folder = Path(name)
        costs = chunk_costs(folder, config.repeats)
        rates = crowd_rates(folder, config.writers, config.repeats)
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


def run_cli() -> None:
    """Parse, run, print the result line."""
    result = main(tyro.cli(Config, description=__doc__))
    for row in result["simulated"]:
        way = "pulled" if row["pull"] else "shards"
        print(
            f"{row['workers']:>5} workers, chunks of {row['chunk_s']:>4g} s, {way}: efficiency "
            f"{row['efficiency']:.3f}, wait {1e3 * row['wait_s']:.1f} ms"
        )
    times = result["sweep_by_workers"]
    fields = {f"wall_{k}": v["wall_s"] for k, v in times.items()}
    print_result(
        write_ms=result["chunk"]["16 trials"]["write_ms"],
        files_per_second=1.0 / result["file_s"],
        saturate_10s=result["workers_that_saturate_the_folder"]["10 s"],
        **fields,
    )


if __name__ == "__main__":
    run_cli()
