"""More than one process: local workers, Ray actors, SLURM arrays. All fill the same folder.

What is started only needs the folder: the sweep is read from it. Nothing is lost with a worker but
the chunk that it was in, and that is taken over by another one.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import enable_compilation_cache
from snn_fusion_failure.sweeps import leases
from snn_fusion_failure.sweeps.chunks import Progress, run_shard
from snn_fusion_failure.sweeps.definition import Sweep
from snn_fusion_failure.sweeps.folder import chunk_name, chunk_path, done_chunks, held_sweep
from snn_fusion_failure.sweeps.plan import all_chunks, read_plan, segments_of
from snn_fusion_failure.sweeps.results import Reader
from snn_fusion_failure.sweeps.rungs import next_work
from snn_fusion_failure.sweeps.worker import Worker

OnChunk = Callable[[Progress], None]
_POLL = 0.5  # seconds between looks into the folder
_CHILD = """
import signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends its workers
from snn_fusion_failure.sweeps.launchers import work
work(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4] == "mixed", float(sys.argv[5]))
"""


def work(out: str, shard: int, shards: int, allow_mixed: bool = False, lease: float = 60.0) -> bool:
    """What a started process does: chunks of the sweep in a folder, until none is left."""
    enable_compilation_cache()
    sweep = held_sweep(Path(out), load=True, allow_mixed=allow_mixed, lease=lease)
    return run_shard(sweep, shard=shard, shards=shards).complete


def standing(sweep: Sweep) -> Progress:
    """How many of the planned chunks are there."""
    planned = {(s.number, c) for s, c in all_chunks(sweep)}
    return Progress(None, len(planned & done_chunks(sweep.out)), len(planned))


def launch_local(sweep: Sweep, workers: int, on_chunk: OnChunk) -> list[str]:
    """`workers` processes on this machine, which share the chunks by leases.

    Returns:
        What was wrong with processes that ended badly; the others did their chunks.
    """
    out = str(sweep.out.resolve())
    mixed = "mixed" if sweep.allow_mixed else "one"
    # The study is found where this process finds it, whatever the current directory is.
    path = os.pathsep.join(dict.fromkeys(p or os.getcwd() for p in sys.path))
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", _CHILD, out, str(i), str(workers), mixed, str(sweep.lease)],
            stdout=sys.stderr, env={**os.environ, "PYTHONPATH": path},
        )
        for i in range(workers)
    ]  # fmt: skip
    try:
        while any(p.poll() is None for p in processes):
            on_chunk(standing(sweep))
            time.sleep(_POLL)
    finally:
        for process in processes:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in processes:
            process.wait()
    on_chunk(standing(sweep))
    return [
        f"worker {i} ended with status {p.returncode}"
        for i, p in enumerate(processes)
        if p.returncode
    ]


def launch_submitit(
    sweep: Sweep,
    jobs: int,
    on_chunk: OnChunk,
    *,
    cluster: str | None = None,
    parameters: dict[str, Any] | None = None,
) -> list[str]:
    """A SLURM array of `jobs` workers by submitit, or its local stand-in.

    Args:
        sweep: claimed.
        jobs: size of the array.
        on_chunk: see `run_shard`.
        cluster: "slurm", "local", or None for SLURM where it is installed.
        parameters: of `submitit.AutoExecutor.update_parameters` (`timeout_min`,
            `slurm_partition`, `gpus_per_node` ...).

    Returns:
        What was wrong with jobs that failed; the others did their chunks.
    """
    import submitit

    out = sweep.out.resolve()
    executor = submitit.AutoExecutor(folder=out / "jobs", cluster=cluster)
    executor.update_parameters(**{"name": "sweep", "timeout_min": 60, **(parameters or {})})
    # A name, not the function: nothing of this process but numbers is pickled.
    array = executor.map_array(
        work, [str(out)] * jobs, range(jobs), [jobs] * jobs, [sweep.allow_mixed] * jobs,
        [sweep.lease] * jobs,
    )  # fmt: skip
    try:
        while not all(job.done() for job in array):
            on_chunk(standing(sweep))
            time.sleep(_POLL)
    except KeyboardInterrupt:
        for job in array:
            job.cancel()
        raise
    on_chunk(standing(sweep))
    failures = [(job.job_id, job.exception()) for job in array]
    return [f"job {i}: {str(e).strip().splitlines()[-1]}" for i, e in failures if e is not None]


class _Actor:
    """A Ray actor: keeps its compiled programs between chunks."""

    def __init__(self, out: str, allow_mixed: bool, lease: float) -> None:
        enable_compilation_cache()
        self._sweep = held_sweep(Path(out), load=True, allow_mixed=allow_mixed, lease=lease)
        self._worker = Worker(self._sweep)

    def run(self, segment: int, number: int) -> tuple[int, list[str]]:
        """Run a chunk unless it is there, or somebody outside of Ray has it."""
        made = segments_of(read_plan(self._sweep.out))[segment]
        if chunk_path(self._sweep.out, segment, number).exists():
            return os.getpid(), []
        lease = leases.take(self._sweep.out, chunk_name(segment, number), self._sweep.lease)
        if lease is None:
            return os.getpid(), []
        try:
            return os.getpid(), self._worker.run(made, number)
        finally:
            lease.release()


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

    Scheduling and faults are Ray's: an actor whose process or node is lost is restarted (elsewhere,
    if it has to be) and its chunk is tried again, up to `deaths` times.

    Args:
        sweep: claimed, in a folder that all nodes see.
        workers: actors.
        on_chunk: see `run_shard`.
        address: of a running Ray cluster ("auto" finds it); None starts one on this machine.
        cpus, gpus: what an actor asks for.
        deaths: restarts of an actor and tries of a chunk.
        on_pid: called with the process id of the actor that ended a chunk.

    Returns:
        What was given up; those chunks are left for the next run.
    """
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray
    from ray.exceptions import RayError

    options: dict[str, Any] = {"address": address}
    if address is None:
        # A cluster of this machine alone stays on its loopback: no other address need work.
        options = {
            "num_cpus": max(1, round(workers * cpus)),
            "include_dashboard": False,
            "_node_ip_address": "127.0.0.1",
        }
    path = os.pathsep.join(dict.fromkeys(p or os.getcwd() for p in sys.path))
    context = ray.init(
        log_to_driver=False, logging_level=logging.WARNING, ignore_reinit_error=True,
        runtime_env={"env_vars": {"PYTHONPATH": path}}, **options,
    )  # fmt: skip
    if getattr(context, "dashboard_url", None):
        print(f"Ray dashboard: http://{context.dashboard_url}", file=sys.stderr)
    errors: list[str] = []
    try:
        actor: Any = ray.remote(
            num_cpus=cpus, num_gpus=gpus, max_restarts=deaths, max_task_retries=deaths
        )(_Actor)
        out = str(sweep.out.resolve())
        crew = [actor.remote(out, sweep.allow_mixed, sweep.lease) for _ in range(workers)]
        reader = Reader(sweep.out)
        given_up: set[tuple[int, int]] = set()
        while True:
            planned = [(s.number, c) for s, c in all_chunks(sweep)]
            done = done_chunks(sweep.out)
            waiting = [x for x in planned if x not in done and x not in given_up]
            if not waiting:
                if given_up or not next_work(sweep, reader):
                    return errors
                continue
            free = list(crew)
            running: dict[Any, tuple[Any, tuple[int, int]]] = {}
            while waiting or running:
                while waiting and free:
                    one, place = free.pop(), waiting.pop(0)
                    running[one.run.remote(*place)] = (one, place)
                ready, _ = ray.wait(list(running), num_returns=1)
                one, place = running.pop(ready[0])
                try:
                    pid, messages = ray.get(ready[0])
                except RayError as error:
                    given_up.add(place)
                    first = str(error).strip().splitlines()[0]
                    name = chunk_name(*place)
                    errors.append(f"chunk {name} given up after {deaths} deaths: {first}")
                    crew.remove(one)
                    crew.append(actor.remote(out, sweep.allow_mixed, sweep.lease))
                    free.append(crew[-1])
                    continue
                free.append(one)
                errors += messages
                now = standing(sweep)
                on_chunk(Progress(None, now.done, now.total, tuple(messages)))
                if on_pid is not None:
                    on_pid(pid)
    finally:
        ray.shutdown()
