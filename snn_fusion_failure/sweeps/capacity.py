"""What a folder of chunk files can take: cost of a file, of several writers at once, of a queue.

    from snn_fusion_failure.sweeps.capacity import chunk_costs, writer_rates
    chunk_costs(Path("/shared/scratch"), 60), writer_rates(Path("/shared/scratch"), (1, 4, 16), 60)

measures the file system of a cluster before a large sweep is started there.
"""

from __future__ import annotations

import multiprocessing
import os
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.sweeps import leases
from snn_fusion_failure.sweeps.chunkfile import load_chunk, save_chunk


def write_chunks(folder: str, first: int, count: int, n_trials: int) -> list[float]:
    """Seconds that each of `count` chunk files took to write."""
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
    """Milliseconds per chunk: file written, read, listed, lease taken and given back; bytes."""
    costs: dict[str, Any] = {}
    names = [f"metric{i}" for i in range(4)]
    for n_trials in (16, 1024):
        files_of = folder / f"trials{n_trials}"
        seconds = write_chunks(str(files_of), 0, repeats, n_trials)
        files = sorted(files_of.iterdir())
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
    costs["list_10000_files_ms"] = _median_ms(lambda: os.listdir(crowd), 9)
    costs["lease_ms"] = _median_ms(lambda: _claim_and_release(folder), repeats)
    return costs


def _median_ms(call: Callable[[], Any], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def _claim_and_release(folder: Path) -> None:
    lease = leases.take(folder, "00000-000000", 60.0)
    assert lease is not None
    lease.release()


def in_processes(
    function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], processes: int
) -> tuple[list[Any], float]:
    """Results of `function(*job)` of all jobs in new processes, and the seconds from start to end.

    Each process has begun and imported the function before the clock runs.

    Args:
        function: a top-level function of a module that a new process can import.
        jobs: its arguments, job by job.
        processes: how many run at the same time.

    Raises:
        RuntimeError: a process died, or could not import the function.
    """
    # Not fork: the parent has threads of its own (XLA's among them).
    context = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(processes, mp_context=context) as pool:
            # As many naps as processes: one that is asleep takes no second one.
            list(pool.map(time.sleep, [0.05] * (4 * processes)))
            start = time.perf_counter()
            futures = [pool.submit(function, *job) for job in jobs]
            return [future.result() for future in futures], time.perf_counter() - start
    except BrokenProcessPool as error:
        raise RuntimeError(
            f"function={function!r}: a process died; expected a top-level function of a "
            "module that a new process can import, and enough memory"
        ) from error


def writer_rates(folder: Path, writers: Sequence[int], repeats: int) -> dict[str, float]:
    """Files per second of all of k processes that write into one folder, for each k."""
    rates = {}
    for k in writers:
        files_of = str(folder / f"writers{k}")
        jobs = [(files_of, i * repeats, repeats, 16) for i in range(k)]
        rates[str(k)] = k * repeats / in_processes(write_chunks, jobs, k)[1]
    return rates
