"""Workers that queue for one folder, simulated: how many of them it can keep busy."""

from __future__ import annotations

import heapq

import numpy as np


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
