"""More than one process: local workers, Ray actors, SLURM arrays. All fill the same folder.

What is started only needs the folder: the sweep is read from it. Nothing is lost with a worker but
the chunk that it was in.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import enable_compilation_cache, repository
from snn_fusion_failure.sweeps.chunks import Rung, Worker, next_rung, run_shard
from snn_fusion_failure.sweeps.folder import Sweep, done_chunks, held_sweep

__all__ = ["OnChunk", "launch_local", "launch_ray", "launch_submitit", "work"]

# (rung, chunks that are there, chunks in all, what went wrong)
OnChunk = Callable[[Rung, int, int, str], None]
_POLL = 0.5  # seconds between looks into the folder
_CHILD = """
import sys
from snn_fusion_failure.sweeps.launchers import work
work(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
"""


def work(out: str, shard: int, shards: int) -> bool:
    """What a started process does: its shard of the sweep in a folder."""
    enable_compilation_cache()
    return run_shard(held_sweep(Path(out)), shard=shard, shards=shards)


def launch_local(sweep: Sweep, workers: int, on_chunk: OnChunk) -> list[str]:
    """`workers` processes on this machine, one shard each; a rung at a time.

    Returns:
        What was wrong with processes that ended badly; their chunks are left for the next run.
    """
    errors: list[str] = []
    while not errors:
        rung = next_rung(sweep)
        total = rung.n_chunks(sweep)
        if len(done_chunks(sweep, rung.budget)) >= total:
            break
        processes = [
            subprocess.Popen(
                [sys.executable, "-c", _CHILD, str(sweep.out), str(i), str(workers)],
                cwd=repository.ROOT, stdout=sys.stderr,
            )
            for i in range(workers)
        ]  # fmt: skip
        try:
            while any(p.poll() is None for p in processes):
                on_chunk(rung, len(done_chunks(sweep, rung.budget)), total, "")
                time.sleep(_POLL)
        finally:
            for process in processes:
                process.terminate()
                process.wait()
        on_chunk(rung, len(done_chunks(sweep, rung.budget)), total, "")
        for i, process in enumerate(processes):
            if process.returncode:
                errors.append(f"worker {i} ended with status {process.returncode}")
    return errors


def launch_submitit(
    sweep: Sweep,
    jobs: int,
    on_chunk: OnChunk,
    *,
    cluster: str | None = None,
    parameters: dict[str, Any] | None = None,
) -> list[str]:
    """A SLURM array of `jobs` shards by submitit, or its local stand-in; a rung at a time.

    Args:
        sweep: claimed.
        jobs: size of the array.
        on_chunk: see `run_shard`.
        cluster: "slurm", "local", or None for SLURM where it is installed.
        parameters: of `submitit.AutoExecutor.update_parameters` (`timeout_min`,
            `slurm_partition`, `gpus_per_node` ...).

    Returns:
        What was wrong with jobs that failed; their chunks are left for the next run.
    """
    import submitit

    executor = submitit.AutoExecutor(folder=sweep.out / "jobs", cluster=cluster)
    executor.update_parameters(**{"name": "sweep", "timeout_min": 60, **(parameters or {})})
    errors: list[str] = []
    while not errors:
        rung = next_rung(sweep)
        total = rung.n_chunks(sweep)
        if len(done_chunks(sweep, rung.budget)) >= total:
            break
        # A name, not the function: nothing of this process but numbers is pickled.
        array = executor.map_array(work, [str(sweep.out)] * jobs, range(jobs), [jobs] * jobs)
        try:
            while not all(job.done() for job in array):
                on_chunk(rung, len(done_chunks(sweep, rung.budget)), total, "")
                time.sleep(_POLL)
        except KeyboardInterrupt:
            for job in array:
                job.cancel()
            raise
        on_chunk(rung, len(done_chunks(sweep, rung.budget)), total, "")
        for job in array:
            error = job.exception()
            if error is not None:
                errors.append(f"job {job.job_id}: {str(error).strip().splitlines()[-1]}")
    return errors


class _Actor:
    """A Ray actor: keeps its compiled program between chunks."""

    def __init__(self, out: str) -> None:
        enable_compilation_cache()
        self._worker = Worker(held_sweep(Path(out)))

    def run(self, rung: Rung, number: int) -> tuple[int, int, str]:
        message = self._worker.run(rung, number)
        return number, os.getpid(), message


def launch_ray(
    sweep: Sweep,
    workers: int,
    on_chunk: OnChunk,
    *,
    address: str | None = None,
    cpus: float = 1.0,
    gpus: float = 0.0,
    deaths: int = 3,
    on_pid: Callable[[int], None] | None = None,
) -> list[str]:
    """Ray actors that take the next chunk whenever they are free.

    An actor that dies is replaced and its chunk is given to another one, up to `deaths` times per
    chunk: a chunk that kills whoever touches it must not stop the rest.

    Args:
        sweep: claimed, in a folder that all nodes see.
        workers: actors.
        on_chunk: see `run_shard`.
        address: of a running Ray cluster ("auto" finds it); None starts one on this machine.
        cpus, gpus: what an actor asks for.
        deaths: actors that a chunk may cost.
        on_pid: called with the process id of the actor that ended a chunk.

    Returns:
        What was given up; those chunks are left for the next run.
    """
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray
    from ray.exceptions import RayActorError

    options: dict[str, Any] = {"address": address}
    if address is None:
        # A cluster of this machine alone stays on its loopback: no other address need work.
        options = {
            "num_cpus": max(1, round(workers * cpus)),
            "include_dashboard": False,
            "_node_ip_address": "127.0.0.1",
        }
    ray.init(
        log_to_driver=False, logging_level=logging.WARNING, ignore_reinit_error=True, **options
    )
    errors: list[str] = []
    try:
        # Ray's own restarts would hide a death; the loop below has to see it to count it.
        actor: Any = ray.remote(num_cpus=cpus, num_gpus=gpus, max_restarts=0)(_Actor)
        crew = [actor.remote(str(sweep.out)) for _ in range(workers)]
        while True:
            rung = next_rung(sweep)
            total = rung.n_chunks(sweep)
            done = done_chunks(sweep, rung.budget)
            waiting = [c for c in range(total) if c not in done]
            lost: dict[int, int] = {}
            running: dict[Any, tuple[int, int]] = {}
            while waiting or running:
                busy = {place for place, _ in running.values()}
                for place in range(workers):
                    if waiting and place not in busy:
                        number = waiting.pop(0)
                        running[crew[place].run.remote(rung, number)] = (place, number)
                ready, _ = ray.wait(list(running), num_returns=1)
                place, number = running.pop(ready[0])
                try:
                    _, pid, message = ray.get(ready[0])
                except RayActorError as error:
                    crew[place] = actor.remote(str(sweep.out))
                    # It may have died between the file and the answer.
                    if number in done_chunks(sweep, rung.budget):
                        continue
                    lost[number] = lost.get(number, 0) + 1
                    if lost[number] < deaths:
                        waiting.insert(0, number)
                    else:
                        first = str(error).strip().splitlines()[0]
                        errors.append(f"chunk {number} given up after {deaths} deaths: {first}")
                    continue
                done.add(number)
                on_chunk(rung, len(done), total, message)
                if on_pid is not None:
                    on_pid(pid)
            if errors or rung.budget is None:
                return errors
    finally:
        ray.shutdown()
