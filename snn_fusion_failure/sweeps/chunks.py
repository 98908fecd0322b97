"""Work through chunks: those that are missing, one after another, each into its file at once."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from snn_fusion_failure.sweeps import halving
from snn_fusion_failure.sweeps.folder import (
    FAILED,
    NON_FINITE,
    OK,
    Sweep,
    chunk_path,
    done_chunks,
    load_chunk,
    save_chunk,
)
from snn_fusion_failure.sweeps.program import Program, compile_study

__all__ = ["Rung", "Worker", "check_design", "next_rung", "retry_failed", "run_shard"]


@dataclasses.dataclass(frozen=True)
class Rung:
    """Trials to run on one budget (None: all of it), in chunks of `sweep.chunk_trials`."""

    budget: int | None
    trials: np.ndarray

    def n_chunks(self, sweep: Sweep) -> int:
        """Chunks of this rung."""
        return -(-len(self.trials) // sweep.chunk_trials)

    def chunk(self, sweep: Sweep, number: int) -> np.ndarray:
        """Trial numbers of a chunk."""
        return self.trials[number * sweep.chunk_trials : (number + 1) * sweep.chunk_trials]


def next_rung(sweep: Sweep) -> Rung:
    """The first rung that is not complete, or the last one.

    Without successive halving there is one rung with all trials. With it, which settings reach a
    rung follows from the files of the rung below and from nothing else.
    """
    settings = np.arange(sweep.design.n)
    for budget in sweep.budgets:
        rung = Rung(budget, _trials(sweep, settings))
        if len(done_chunks(sweep, budget)) < rung.n_chunks(sweep):
            return rung
        scores = halving.scores(sweep, budget, rung.trials)
        settings = halving.survivors(scores, settings, sweep.keep)
    return Rung(None, _trials(sweep, settings))


def _trials(sweep: Sweep, settings: np.ndarray) -> np.ndarray:
    return (settings[:, None] * sweep.seeds + np.arange(sweep.seeds)[None]).ravel()


def check_design(sweep: Sweep) -> None:
    """Let the study look at every setting before anything is compiled.

    Raises:
        ValueError: from the study, for a setting that cannot run.
    """
    from snn_fusion_failure.sweeps.leaves import batch

    study = sweep.study
    first = np.arange(sweep.design.n) * sweep.seeds
    units = {leaf: study.unit_of(leaf) for leaf in study.leaves}
    study.check(batch(study.params, sweep.columns(first), sweep.design.n, units, "float64"))


class Worker:
    """Runs chunks of a sweep; compiles when the first one comes, once per budget."""

    def __init__(self, sweep: Sweep) -> None:
        self.sweep = sweep
        self._programs: dict[int | None, Program] = {}

    def _program(self, budget: int | None) -> Program:
        if budget not in self._programs:
            study = self.sweep.study
            if budget is not None:
                assert study.with_budget is not None
                study = study.with_budget(budget)
            self._programs[budget] = compile_study(
                study, root=self.sweep.root, width=self.sweep.width
            )
        return self._programs[budget]

    def run(self, rung: Rung, number: int, *, write: bool = True) -> str:
        """Run one chunk and write its file; returns what went wrong, empty when nothing did.

        An exception of the trials becomes a file that says so, and the sweep can go on.
        """
        sweep = self.sweep
        trials = rung.chunk(sweep, number)
        names = list(sweep.study.metrics)
        start = time.perf_counter()
        message = ""
        try:
            metrics = self._program(rung.budget)(sweep.columns(trials), trials)
            required = [n for n, m in sweep.study.metrics.items() if not m.optional]
            finite = np.all([np.isfinite(metrics[n]) for n in required], axis=0)
            status = np.where(finite, OK, NON_FINITE).astype(np.int8)
        except Exception as error:
            message = f"{type(error).__name__}: {error}"
            metrics = {name: np.full(len(trials), np.nan) for name in names}
            status = np.full(len(trials), FAILED, np.int8)
        if write:
            path = chunk_path(sweep, number, rung.budget)
            seconds = time.perf_counter() - start
            save_chunk(path, trials, metrics, status, seconds=seconds, message=message)
        return message


def run_shard(
    sweep: Sweep,
    *,
    shard: int = 0,
    shards: int = 1,
    on_chunk: Callable[[Rung, int, int, str], None] | None = None,
    on_start: Callable[[int], None] | None = None,
) -> bool:
    """Run the chunks `c` with `c % shards == shard` that are not there yet.

    Args:
        sweep: from its folder.
        shard, shards: which part of the chunks this process takes.
        on_chunk: called with the rung, the number of chunks that are there, of all chunks, and
            what went wrong.
        on_start: called with the number of a chunk before it is run.

    Returns:
        True when the sweep is complete; False when other shards have chunks left to do (with
        successive halving, run the shard again when they have done them).
    """
    worker = Worker(sweep)
    while True:
        rung = next_rung(sweep)
        total = rung.n_chunks(sweep)
        mine = [c for c in range(total) if c % shards == shard]
        done = _agreed(done_chunks(sweep, rung.budget), total)
        todo = [c for c in mine if c not in done]
        for number in todo:
            if on_start is not None:
                on_start(number)
            message = worker.run(rung, number, write=_writes())
            done = done | {number}
            if on_chunk is not None:
                on_chunk(rung, len(done), total, message)
        _barrier()
        if len(_agreed(done_chunks(sweep, rung.budget), total)) < total:
            return False
        if rung.budget is None:
            return True


def retry_failed(sweep: Sweep) -> int:
    """Delete the files of chunks that failed, so that they are run again; returns their number."""
    count = 0
    for budget in (*sweep.budgets, None):
        for number in sorted(done_chunks(sweep, budget)):
            path = chunk_path(sweep, number, budget)
            if (load_chunk(path, ())["status"] == FAILED).any():
                path.unlink(missing_ok=True)
                count += 1
    return count


def _writes() -> bool:
    import jax

    return jax.process_index() == 0


def _agreed(done: set[int], total: int) -> set[int]:
    """The same set in every process of a distributed run: that of the process that writes."""
    import jax

    if jax.process_count() == 1:
        return done
    from jax.experimental import multihost_utils

    flags = np.asarray([c in done for c in range(total)], np.int32)
    flags = np.asarray(multihost_utils.broadcast_one_to_all(flags))
    return {int(c) for c in np.flatnonzero(flags)}


def _barrier() -> None:
    import jax

    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices("sweep")
