"""Sweep constants of a study over many settings and seeds, on one core or on a cluster.

Try it (half a minute):

    python scripts/sweep.py --study lif --grid drive=16:40:13 neuron.tau_m=10,20,40 --seeds 8 \\
        --out runs/sweep_lif
    python scripts/sweep.py show runs/sweep_lif

A study is what one trial does: `lif` (a noisy neuron), `snn` (a robot learns to steer), `argate`
(train a fusion network), `failure` (search a circuit), or your own function of one trial,
`(params, key) -> {metric: number}`, as `module:function` in the current directory. An axis is one
constant of it, by name; an unknown name lists the known ones:

    --grid gamma=1e-4:1e-1:log:16 tau_z=5,25,100     16 x 3 settings
    --grid network=S3,S4 gamma=1e-3,1e-2             words: one compiled program each
    --sobol gamma=1e-4:1e-1:log tau_z=5:100 --samples 64
    --random ...                                     the same with independent draws
    --tpe ..., --cma ..., --gp ...                   the next settings follow from the results

Each setting is run `--seeds` times. Times are in milliseconds unless written as 25ms or 0.025s.

The folder is the sweep. Finished chunks are files that are never changed, so a sweep that was
killed goes on with the same command and repeats no finished chunk. With more seeds, samples or
values it grows; a study whose source has changed is refused. Keys follow from a setting's values
and the seed alone: shards, workers, devices and growth do not change its numbers.

    --workers 4                             four processes on this machine
    --launcher ray --workers 16             Ray actors; --ray-address auto joins a cluster
    --launcher submitit --workers 50 --slurm timeout_min=120 slurm_partition=cpu
    --shard 3/50                            the fourth of 50 parts, under any other scheduler
    --distributed                           one program over all devices of all processes

The last line is `result: ...`; `results.nc` in the folder is the labelled data set (xarray). The
exit status is 1 when trials failed or chunks are missing. Run time: compiling takes 1 to 30 s per
process, once; then a trial of `snn` takes about 8 CPU-seconds, of `lif` a millisecond.
`--chunk-size auto`, the default, prints what a trial of yours takes.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from snn_fusion_failure.commands.show_sweep import Show, show
from snn_fusion_failure.commands.sweep_options import Config, check
from snn_fusion_failure.runs import enable_compilation_cache, progress
from snn_fusion_failure.runs.command import run_command


def build(config: Config) -> Any:
    """The sweep that a command line asks for, checked, before anything is compiled."""
    from snn_fusion_failure.sweeps import engine
    from snn_fusion_failure.sweeps.asked import DRAWN, read_axes

    given = {name: getattr(config, name) for name in ("grid", "choice", *DRAWN)}
    kind, axes, study = read_axes(
        config.study, config.options, given, objective=config.objective, goal=config.goal
    )
    if config.workers < 1:
        raise ValueError(f"workers={config.workers}: expected at least 1")
    if config.halving and config.asha:
        raise ValueError("halving and asha given: expected one of them")
    return engine.build(
        study, kind, axes, config.out, samples=config.samples, design_seed=config.design_seed,
        seeds=config.seeds, root=config.root, budgets=config.halving or config.asha,
        keep=config.keep, mode="asha" if config.asha else "halving",
        common=config.common_seeds, batch=config.batch, min_valid=config.min_valid,
        allow_mixed=config.allow_mixed, lease=config.lease,
    )  # fmt: skip


def open_sweep(config: Config) -> Any:
    """Claim the folder, or go on with the sweep in it."""
    from snn_fusion_failure.sweeps import engine

    made = build(config)
    if config.overwrite and (config.shard or config.distributed):
        raise ValueError("--overwrite with --shard or --distributed would delete the others' work")
    parts = engine.parse_shard(config.shard)[1] if config.shard else config.workers
    layout = engine.Layout(config.chunk_size, config.chunk_trials, parts)
    return engine.open_sweep(made, layout, overwrite=config.overwrite, retry=config.retry_failed)


def run(config: Config, sweep: Any) -> list[str]:
    """Run what is missing; returns what went wrong."""
    from snn_fusion_failure.sweeps import engine, launchers
    from snn_fusion_failure.sweeps.chunks import Progress, run_shard
    from snn_fusion_failure.sweeps.study import parse_pairs
    from snn_fusion_failure.sweeps.trackers import make_tracker

    def missing(sweep: Any, on_chunk: Any) -> Any:
        if config.launcher == "ray":
            return launchers.launch_ray(
                sweep, config.workers, on_chunk, address=config.ray_address,
                cpus=config.cpus_per_worker, gpus=config.gpus_per_worker,
            )  # fmt: skip
        if config.launcher == "submitit":
            parameters = parse_pairs(config.slurm, "slurm")
            return launchers.launch_submitit(
                sweep, config.workers, on_chunk, cluster=config.cluster, parameters=parameters
            )
        if config.workers > 1:
            return launchers.launch_local(sweep, config.workers, on_chunk)
        shard, shards = engine.parse_shard(config.shard) if config.shard else (0, 1)
        return run_shard(
            sweep, shard=shard, shards=shards, exclusive=bool(config.shard), on_chunk=on_chunk
        ).errors

    with progress() as bar, make_tracker(config.tracker, sweep) as tracker:
        bar.disable = config.quiet
        tasks: dict[Any, Any] = {}
        failed = 0

        def show(at: Progress) -> None:
            nonlocal failed
            failed += len(at.messages)
            tracker.look()
            if config.quiet:
                return
            if at.budget not in tasks:
                name = f"sweep {sweep.study_name}"
                if at.budget is not None:
                    name += f" ({at.budget} {sweep.budget_text})"
                tasks[at.budget] = bar.add_task(name, total=at.total, status="")
            status = f"{failed} trials failed" if failed else ""
            bar.update(tasks[at.budget], completed=at.done, total=at.total, status=status)

        show(launchers.standing(sweep))
        return engine.execute(sweep, run=missing, on_chunk=show)


def main(config: Config) -> dict[str, Any]:
    """Run a sweep, or what is left of it; returns the counts and the best setting."""
    import jax

    from snn_fusion_failure.sweeps.engine import collect
    from snn_fusion_failure.sweeps.worker import brief

    check(config)
    if config.distributed:
        jax.distributed.initialize(config.coordinator, config.processes, config.process)
    enable_compilation_cache()
    sweep = open_sweep(config)
    start = time.perf_counter()
    try:
        errors = run(config, sweep)
    except KeyboardInterrupt:
        words = f"finished chunks are in {config.out}; the same command goes on"
        raise KeyboardInterrupt(words) from None
    for error in list(dict.fromkeys(map(brief, errors)))[:5]:
        print(f"warning: {error}", file=sys.stderr)
    if jax.process_index() > 0:
        return {"complete": True}
    _, found = collect(sweep)
    if config.shard:
        # The other parts are other commands' work.
        found["missing"], found["elsewhere"] = 0, found["missing"]
    elif not found["complete"] and not found["missing"]:
        found["missing"] = 1  # a rung that was never planned
    return found | {"seconds": time.perf_counter() - start}


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line; `show FOLDER` prints and draws a sweep."""
    given = list(sys.argv[1:] if argv is None else argv)
    if given[:1] == ["show"]:
        prog = f"{prog or 'sweep.py'} show"
        run_command(Show, show, description=Show.__doc__, fields=lambda found: found["result"],
                    argv=given[1:], prog=prog)  # fmt: skip
    else:
        run_command(Config, main, description=__doc__, fields=dict, argv=given, prog=prog)
