"""Workers that queue for one folder, simulated: how many of them it can keep busy.

The folder is one server that does what it is asked for first come, first served. A worker computes
a chunk, waits for its turn, has its file written, and takes the next chunk in one of three ways:

`dealt`
    chunks are dealt out beforehand (`--shard i/n`); nothing has to be asked.
`queue`
    one queue hands them out (Ray).
`leases`
    each worker claims chunks by lease files, as `chunks.run_shard` does: it knows the folder as it
    was when it last looked. Once another one was quicker it tries chunks at random, and looks again
    when misses have cost as much as a look; of a crowd with nothing left to claim some stay and
    the others end.
"""

from __future__ import annotations

import heapq
from typing import Literal

import numpy as np

from snn_fusion_failure.sweeps.chunks import MISSES, longest_pause, stays

Way = Literal["dealt", "queue", "leases"]
_FIRST_PAUSE, _GROWTH = 0.05, 1.5


class _Server:
    """One at a time, in the order of arrival."""

    def __init__(self) -> None:
        self.free = self.waited = 0.0

    def serve(self, now: float, seconds: float) -> float:
        """When work of so many seconds that comes at `now` is done."""
        begin = max(now, self.free)
        self.waited += begin - now
        self.free = begin + seconds
        return self.free


class _Chunks:
    """Which chunks are free, in order of place and to be drawn at random."""

    def __init__(self, n: int) -> None:
        self._free = list(range(n))
        self._where = list(range(n))

    def __len__(self) -> int:
        return len(self._free)

    def is_free(self, place: int) -> bool:
        return self._where[place] >= 0

    def draw(self, rng: np.random.Generator) -> int:
        return self._free[rng.integers(len(self._free))]

    def take(self, place: int) -> None:
        last = self._free[-1]
        self._free[self._where[place]], self._where[last] = last, self._where[place]
        self._free.pop()
        self._where[place] = -1


def simulate(
    workers: int,
    chunk_s: float,
    file_s: float,
    *,
    way: Way = "dealt",
    claim_s: float = 0.0,
    entry_s: float = 0.0,
    per_worker: int = 20,
    spread: float = 0.3,
    seed: int = 0,
) -> dict[str, float]:
    r"""Workers that compute a chunk, queue for the folder, write, and take the next one.

    A chunk takes `chunk_s` times a log-normal factor of mean 1 and standard deviation `spread`. At
    most :math:`c / f + 1` workers can be kept busy by a folder that takes f per chunk, c being the
    time of a chunk.

    Args:
        workers: number of workers.
        chunk_s: of a chunk's computing [s].
        file_s: that a chunk's file keeps the folder busy [s].
        way: how chunks are handed out.
        claim_s: that taking and giving back a lease keeps the folder busy [s]; a quarter of it for
            a chunk that somebody else has.
        entry_s: per file of a look into the folder [s].
        per_worker: chunks per worker.
        spread: of the chunks' times.
        seed: of the chunks' times.

    Returns:
        `efficiency`, the share of the workers' time until the last file that was spent computing;
        `wait_s`, the mean wait for the folder per chunk; and `looks`, looks into the folder per
        chunk.

    Example:
        >>> one = simulate(1, 1.0, 0.5, spread=0.0)
        >>> round(one["efficiency"], 3), one["wait_s"]
        (0.667, 0.0)
    """
    rng = np.random.default_rng(seed)
    sigma = np.sqrt(np.log1p(spread**2))
    n = workers * per_worker
    times = chunk_s * np.exp(sigma * rng.standard_normal(n) - sigma**2 / 2)
    server, end, looks = _Server(), 0.0, 0
    if way != "leases":
        end = _handed_out(server, times.reshape(workers, per_worker), file_s, way == "queue")
    else:
        end, looks = _leased(server, times, workers, (file_s, claim_s, entry_s), rng)
    return {
        "efficiency": float(times.sum()) / (workers * end),
        "wait_s": float(server.waited / n),
        "looks": looks / n,
    }


def _handed_out(server: _Server, times: np.ndarray, file_s: float, queue: bool) -> float:
    """When the last file is written, with one queue for all or one for each."""
    every = iter(times.ravel())
    own = [every] * len(times) if queue else [iter(row) for row in times]
    # (time at which a worker comes to the folder, worker)
    arrivals = [(float(next(mine)), i) for i, mine in enumerate(own)]
    heapq.heapify(arrivals)
    while arrivals:
        now, worker = heapq.heappop(arrivals)
        done = server.serve(now, file_s)
        following = next(own[worker], None)
        if following is not None:
            heapq.heappush(arrivals, (done + float(following), worker))
    return server.free


def _leased(
    server: _Server,
    times: np.ndarray,
    workers: int,
    costs: tuple[float, float, float],
    rng: np.random.Generator,
) -> tuple[float, int]:
    """When the last file is written, and how often workers looked, with leases."""
    file_s, claim_s, entry_s = costs
    miss_s = 0.25 * claim_s
    n = len(times)
    chunks = _Chunks(n)
    # Of each worker: its place in the order, or -1 once it goes by chance; chunks that it does not
    # know to be taken; what its last look took; its share, see `stays`; its pause.
    place = [i * n // workers for i in range(workers)]
    known, look_s = [n] * workers, [0.0] * workers
    share, pause = rng.random(workers).tolist(), [_FIRST_PAUSE] * workers
    written, end, looks = 0, 0.0, 0
    # (time, worker, what it comes for): a file to be written, the next chunk, a look.
    events = [(0.0, i, "look") for i in range(workers)]
    heapq.heapify(events)
    while written < n:
        now, worker, what = heapq.heappop(events)
        if what == "file":
            done = server.serve(now, file_s)
            written, end = written + 1, max(end, done)
            heapq.heappush(events, (done, worker, "next"))
        elif what == "look" or not len(chunks):
            looks += 1
            done = server.serve(now, entry_s * (n - len(chunks)))
            known[worker], look_s[worker] = len(chunks), done - now
            if len(chunks):
                heapq.heappush(events, (done, worker, "next"))
            elif stays(n - written, share[worker]):
                heapq.heappush(events, (done + pause[worker], worker, "look"))
                most = longest_pause(n - written, done - now)
                pause[worker] = min(most, _GROWTH * pause[worker])
        else:
            found, misses = place[worker], 0
            if found < 0 or not chunks.is_free(found):
                hits = len(chunks) / max(known[worker], len(chunks))
                misses = int(found >= 0) + int(rng.geometric(hits)) - 1
                found, place[worker] = chunks.draw(rng), -1
            else:
                place[worker] = (found + 1) % n
            allowed = max(MISSES, int(look_s[worker] / miss_s) if miss_s else MISSES)
            done = server.serve(now, miss_s * min(misses, allowed))
            if misses > allowed:
                heapq.heappush(events, (done, worker, "look"))
                continue
            known[worker] -= misses + 1
            chunks.take(found)
            done = server.serve(done, claim_s)
            heapq.heappush(events, (done + float(times[found]), worker, "file"))
    return end, looks
