"""Work through chunks: those that are missing and nobody works on, one after another."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from snn_fusion_failure.sweeps import leases
from snn_fusion_failure.sweeps.chunkfile import DamagedError, set_aside
from snn_fusion_failure.sweeps.folder import (
    Segment,
    Sweep,
    all_chunks,
    chunk_name,
    chunk_path,
    done_chunks,
    read_plan,
    segments_of,
)
from snn_fusion_failure.sweeps.results import Reader
from snn_fusion_failure.sweeps.rungs import is_complete, next_work
from snn_fusion_failure.sweeps.worker import Worker


@dataclasses.dataclass(frozen=True)
class Progress:
    """Where a sweep stands, as it is told after each chunk."""

    budget: int | None
    done: int
    total: int
    messages: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a worker ended.

    Attributes:
        complete: nothing is left to do.
        errors: what went wrong, trial by trial or chunk by chunk.
    """

    complete: bool
    errors: tuple[str, ...] = ()


class _Queue:
    """Chunks to run, without asking the folder more often than it has to be."""

    def __init__(
        self, sweep: Sweep, worker: Worker, shard: int, shards: int, exclusive: bool
    ) -> None:
        self.sweep, self.worker, self.reader = sweep, worker, Reader(sweep.out)
        self.shard, self.shards, self.exclusive = shard, shards, exclusive
        self.waiting: list[tuple[Segment, int]] = []
        self.given_up: dict[str, str] = {}
        self._pause = 0.05

    def refill(self) -> bool:
        """Look into the folder; False when nothing is left (that this worker may do)."""
        while True:
            planned = all_chunks(self.sweep)
            done = done_chunks(self.sweep.out)
            left = [
                (i, s, c) for i, (s, c) in enumerate(planned)
                if (s.number, c) not in done and chunk_name(s.number, c) not in self.given_up
            ]  # fmt: skip
            if self.exclusive:
                left = [x for x in left if x[0] % self.shards == self.shard]
            if left:
                break
            if len(done & {(s.number, c) for s, c in planned}) < len(planned):
                return False  # others', or given up
            try:
                if not next_work(self.sweep, self.reader):
                    return False
            except DamagedError as error:
                set_aside(error.path)
        start = self.shard * len(left) // self.shards if not self.exclusive else 0
        rotated = left[start:] + left[:start]
        # What is compiled already comes first: every program is compiled in as few workers as can.
        rotated.sort(key=lambda x: not self.worker.has(x[1]))
        self.waiting = [(s, c) for _, s, c in rotated]
        return True

    def take(self) -> tuple[Segment, int, leases.Lease] | None:
        """The next chunk with its lease, None when nothing is left."""
        while True:
            busy = False
            while self.waiting:
                segment, number = self.waiting.pop(0)
                name = chunk_name(segment.number, number)
                path = chunk_path(self.sweep.out, segment.number, number)
                if path.exists():
                    continue
                lease = leases.take(self.sweep.out, name, self.sweep.lease)
                if lease is None:
                    busy = True
                    continue
                if path.exists():  # its holder ended between the two looks
                    lease.release()
                    continue
                if leases.deaths(self.sweep.out, name) >= leases.DEATHS:
                    lease.release()
                    self.given_up[name] = (
                        f"chunk {name} given up: {leases.DEATHS} workers died in it; "
                        "--retry-failed tries again"
                    )
                    continue
                self._pause = 0.05
                return segment, number, lease
            if busy:
                try:
                    more = next_work(self.sweep, self.reader, idle=True)
                except DamagedError as error:
                    set_aside(error.path)
                    more = True
                if not more:
                    time.sleep(self._pause)
                    self._pause = min(1.0, 1.5 * self._pause)
            if not self.refill():
                return None


def run_shard(
    sweep: Sweep,
    *,
    shard: int = 0,
    shards: int = 1,
    exclusive: bool = False,
    on_chunk: Callable[[Progress], None] | None = None,
    on_start: Callable[[str], None] | None = None,
) -> Outcome:
    """Run the chunks that are not there yet and that nobody else works on.

    Args:
        sweep: from its folder, with its study.
        shard, shards: where this worker begins to look.
        exclusive: run the chunks `c` with `c % shards == shard` and no others.
        on_chunk: called after each chunk.
        on_start: called with the name of a chunk before it is run.

    Returns:
        Outcome. Without `exclusive` a worker waits for chunks of others, and takes them over when
        their holders die.
    """
    worker = Worker(sweep)
    queue = _Queue(sweep, worker, shard, shards, exclusive)
    errors: list[str] = []
    segments: dict[int, Segment] = {}
    told = 0.0
    while True:
        taken = queue.take() if _leads() else None
        place = _agreed((taken[0].number, taken[1]) if taken else (-1, -1))
        if place[0] < 0:
            break
        if place[0] not in segments:
            segments = {s.number: s for s in segments_of(read_plan(sweep.out))}
        segment, number = segments[place[0]], place[1]
        name = chunk_name(segment.number, number)
        if on_start is not None:
            on_start(name)
        try:
            messages = worker.run(segment, number, write=_leads())
        except DamagedError as error:
            set_aside(error.path)
            messages = []
        finally:
            if taken is not None:
                taken[2].release()
        errors += messages
        # Counting looks through the whole folder: not for each of many small chunks.
        if on_chunk is not None and _leads() and (messages or time.monotonic() - told > 0.2):
            told = time.monotonic()
            planned = all_chunks(sweep)
            same = {(s.number, c) for s, c in planned if s.budget == segment.budget}
            on_chunk(
                Progress(segment.budget, len(same & done_chunks(sweep.out)), len(same),
                         tuple(messages))
            )  # fmt: skip
    errors += queue.given_up.values()
    return Outcome(_agreed((int(_leads() and is_complete(sweep, queue.reader)), 0))[0] == 1,
                   tuple(errors))  # fmt: skip


def _leads() -> bool:
    """Whether this process decides and writes: the only one, or the first of a distributed run."""
    import jax

    return jax.process_index() == 0


def _agreed(pair: tuple[int, int]) -> tuple[int, int]:
    """The same pair in every process of a distributed run: that of the process that decides."""
    import jax

    if jax.process_count() == 1:
        return pair
    from jax.experimental import multihost_utils

    found = multihost_utils.broadcast_one_to_all(np.asarray(pair, np.int32))
    return int(found[0]), int(found[1])
