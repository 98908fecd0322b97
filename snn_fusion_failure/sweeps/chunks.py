"""Work through chunks: those that are missing and nobody works on, one after another."""

from __future__ import annotations

import dataclasses
import random
import time
from collections.abc import Callable

import numpy as np

from snn_fusion_failure.sweeps import leases
from snn_fusion_failure.sweeps.chunkfile import DamagedError, set_aside
from snn_fusion_failure.sweeps.definition import Segment, Sweep
from snn_fusion_failure.sweeps.designs import ADAPTIVE
from snn_fusion_failure.sweeps.folder import chunk_name, chunk_path, done_chunks
from snn_fusion_failure.sweeps.plan import all_chunks, read_plan, segments_of
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


MISSES = 4
"""Chunks that others may always have been quicker to take; more while a look would take longer."""


WATCHERS = 64
"""Workers that stay, about, when all that is left is in the hands of more of them than these."""


def stays(leased: int, share: float) -> bool:
    """Whether a worker waits for others, to take over from one that dies, or ends.

    Args:
        leased: chunks that others have.
        share: of this worker, drawn once, between 0 and 1.

    Example:
        >>> stays(64, 0.99), stays(6400, 0.005), stays(6400, 0.5)
        (True, True, False)
    """
    return share * leased < WATCHERS


def longest_pause(leased: int, look: float) -> float:
    """Seconds between two looks of a worker that has nothing to do but to wait for others.

    Longer when many work (a crowd that waits must not keep the folder from those that write), and
    when a look takes long.

    Example:
        >>> longest_pause(2, 0.001), longest_pause(2, 0.2), longest_pause(10_000, 0.001)
        (1.0, 4.0, 15.0)
    """
    return max(min(15.0, max(1.0, 0.01 * leased)), 20.0 * look)


class _Queue:
    """Chunks to run, without asking the folder more often than it has to be."""

    def __init__(
        self, sweep: Sweep, worker: Worker, shard: int, shards: int, exclusive: bool
    ) -> None:
        self.sweep, self.worker, self.reader = sweep, worker, Reader(sweep.out)
        self.shard, self.shards, self.exclusive = shard, shards, exclusive
        self.waiting: list[tuple[Segment, int]] = []
        self.given_up: dict[str, str] = {}
        self._random = random.Random()
        # Since the last look: chunks that others had taken, seconds lost to them; of the look.
        self._misses, self._lost, self._look = 0, 0.0, 0.0
        self._all_leased = False
        self._share = self._random.random()
        # Rungs and adaptive designs plan more work for those that wait.
        self._final = not (sweep.budgets or sweep.design.kind in ADAPTIVE or exclusive)
        self.left_early = False
        self._pause, self._most = 0.05, 1.0

    def refill(self) -> bool:
        """Look into the folder; False when nothing is left (that this worker may do)."""
        began = time.monotonic()
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
        leased = leases.held(self.sweep.out)
        free = [x for x in left if chunk_name(x[1].number, x[2]) not in leased]
        self._all_leased, self._misses, self._lost = not free, 0, 0.0
        self._look = time.monotonic() - began
        self._most = longest_pause(len(leased), self._look)
        self.left_early = not free and self._final and not stays(len(leased), self._share)
        if self.left_early:
            return False
        if free:
            start = 0 if self.exclusive else self.shard * len(free) // self.shards
            chosen = free[start:] + free[:start]
            # What is compiled comes first: every program is compiled in as few workers as can.
            segments = {s.number: s for _, s, _ in free}
            compiled = {number: self.worker.has(s) for number, s in segments.items()}
            chosen.sort(key=lambda x: not compiled[x[1].number])
        else:
            # Somebody may have died: each of those that wait looks after a few leases.
            chosen = self._random.sample(left, min(8, len(left)))
        self.waiting = [(s, c) for _, s, c in reversed(chosen)]
        return True

    def take(self) -> tuple[Segment, int, leases.Lease] | None:
        """The next chunk with its lease, None when nothing is left."""
        while True:
            while self.waiting and (self._misses < MISSES or self._lost < self._look):
                began = time.monotonic()
                segment, number = self.waiting.pop()
                lease = self._claim(segment, number)
                if lease is not None:
                    self._pause = 0.05
                    return segment, number, lease
                if self._misses == 1:
                    self._random.shuffle(self.waiting)  # others are at work here: go elsewhere
                self._lost += time.monotonic() - began
            if self._all_leased:
                try:
                    more = next_work(self.sweep, self.reader, idle=True)
                except DamagedError as error:
                    set_aside(error.path)
                    more = True
                if not more:
                    time.sleep(self._pause)
                    self._pause = min(self._most, 1.5 * self._pause)
            if not self.refill():
                return None

    def _claim(self, segment: Segment, number: int) -> leases.Lease | None:
        """The lease of a chunk that is still to be done, or None."""
        name = chunk_name(segment.number, number)
        path = chunk_path(self.sweep.out, segment.number, number)
        lease = None if path.exists() else leases.take(self.sweep.out, name, self.sweep.lease)
        if lease is None:
            self._misses += 1
            return None
        if path.exists():  # its holder ended between the two looks
            lease.release()
            return None
        if leases.deaths(self.sweep.out, name) >= leases.DEATHS:
            lease.release()
            self.given_up[name] = (
                f"chunk {name} given up: {leases.DEATHS} workers died in it; "
                "--retry-failed tries again"
            )
            return None
        return lease


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
        their holders die; of a large crowd only some wait (`WATCHERS`).
    """
    worker = Worker(sweep)
    queue = _Queue(sweep, worker, shard, shards, exclusive)
    errors: list[str] = []
    segments: dict[int, Segment] = {}
    told, spent = 0.0, 0.0
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
        due = time.monotonic() - told > max(0.2, 20.0 * spent)
        if on_chunk is not None and _leads() and (messages or due):
            told = time.monotonic()
            planned = all_chunks(sweep)
            same = {(s.number, c) for s, c in planned if s.budget == segment.budget}
            on_chunk(
                Progress(segment.budget, len(same & done_chunks(sweep.out)), len(same),
                         tuple(messages))
            )  # fmt: skip
            spent = time.monotonic() - told
    errors += queue.given_up.values()
    complete = _leads() and not queue.left_early and is_complete(sweep, queue.reader)
    return Outcome(_agreed((int(complete), 0))[0] == 1, tuple(errors))


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
