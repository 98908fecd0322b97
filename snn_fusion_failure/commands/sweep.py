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

import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from snn_fusion_failure.commands.show_sweep import Show, show
from snn_fusion_failure.runs import enable_compilation_cache, progress
from snn_fusion_failure.runs.command import run_command


@dataclasses.dataclass(frozen=True)
class Config:
    """What to sweep and where to run it."""

    study: str = "lif"
    """snn, argate, failure, lif, or module:function (a trial, or it returns a Study)."""
    options: tuple[str, ...] = ()
    """Choices of the study, name=value; an unknown name lists the known ones."""
    grid: tuple[str, ...] = ()
    """Axes of which every value is visited, leaf=values."""
    choice: tuple[str, ...] = ()
    """Axes that compile a program per value (sizes, names), leaf=values."""
    random: tuple[str, ...] = ()
    """Axes of random draws, leaf=low:high[:log]."""
    sobol: tuple[str, ...] = ()
    """Axes of a scrambled Sobol sequence, leaf=low:high[:log]."""
    tpe: tuple[str, ...] = ()
    """Axes of an adaptive design: Optuna's tree-structured Parzen estimator."""
    cma: tuple[str, ...] = ()
    """Axes of an adaptive design: CMA-ES."""
    gp: tuple[str, ...] = ()
    """Axes of an adaptive design: expected improvement under a Gaussian process."""
    samples: int = 0
    """Settings of a design that is not a grid."""
    batch: int = 8
    """Settings that an adaptive design asks for at a time."""
    design_seed: int = 0
    """Seed of a design that is not a grid."""
    seeds: int = 8
    """Trials per setting."""
    root: int = 0
    """Seed of all trials."""
    common_seeds: bool = False
    """Seed k draws the same numbers in every setting, so that settings compare in pairs."""
    objective: str | None = None
    """Metric to rank by; the study's own when left out."""
    goal: Literal["", "max", "min"] = ""
    """Which way the objective is better; the study's own when left out."""
    min_valid: float = 0.75
    """Share of a setting's seeds that must be valid for it to be ranked."""
    out: Path = Path("runs/sweep")
    """The sweep's folder."""
    overwrite: bool = False
    """Delete the sweep that is in OUT first."""
    retry_failed: bool = False
    """Run trials again that raised an exception."""
    allow_mixed: bool = False
    """Go on though the study's source has changed; the results say which trials are whose."""
    chunk_size: str = "auto"
    """Trials side by side on a device: 1 (one after another), a number, all, or auto (measured)."""
    chunk_trials: int = 0
    """Trials per file, lost at most when killed; default: 16 or a chunk size, whichever is more."""
    halving: tuple[int, ...] = ()
    """Drop settings after so many units of training (snn: learning trials), for example 5 10."""
    asha: tuple[int, ...] = ()
    """The same without waiting for a whole rung."""
    keep: float = 0.25
    """Share of the settings that goes on at each of them."""
    launcher: Literal["local", "ray", "submitit"] = "local"
    """What starts the workers."""
    workers: int = 1
    """Processes, actors or jobs of the launcher."""
    lease: float = 60.0
    """Seconds after which the chunk of a worker that has gone silent is taken over."""
    shard: str = ""
    """i/n: run part i (from 0) of n parts and nothing else."""
    distributed: bool = False
    """This is one process of a jax.distributed run (see docs/sweeps.md)."""
    coordinator: str | None = None
    """host:port of process 0; found by itself under SLURM and on TPU pods, as the next two are."""
    processes: int | None = None
    """Processes of the distributed run."""
    process: int | None = None
    """Number of this one, from 0."""
    ray_address: str | None = None
    """A running Ray cluster; without it Ray is started on this machine."""
    cpus_per_worker: float = 1.0
    """CPUs that a Ray actor asks for."""
    gpus_per_worker: float = 0.0
    """GPUs that a Ray actor asks for."""
    cluster: Literal["slurm", "local"] | None = None
    """Where submitit runs; SLURM where it is installed."""
    slurm: tuple[str, ...] = ()
    """Parameters of the jobs, name=value, as submitit names them."""
    tracker: Literal["", "tensorboard", "mlflow", "wandb"] = ""
    """Send ranked settings to a tracker as they come; each needs its library."""
    quiet: bool = False
    """No progress bar."""


_DRAWN = ("random", "sobol", "tpe", "cma", "gp")


def read_axes(config: Config) -> tuple[str, list[Any], Any]:
    """Kind of the design, its axes, and the study."""
    from snn_fusion_failure.sweeps.api import with_objective
    from snn_fusion_failure.sweeps.axes import parse_axis
    from snn_fusion_failure.sweeps.study import Study, load_study
    from snn_fusion_failure.sweeps.trial import from_trial

    drawn = [k for k in _DRAWN if getattr(config, k)]
    if len(drawn) > 1 or not (drawn or config.grid or config.choice):
        raise ValueError(
            f"{' and '.join(drawn) or 'no axis'} given: give one of --grid, --random, --sobol, "
            "--tpe, --cma, --gp, for example --grid drive=16:40:13"
        )
    loaded = load_study(config.study, config.options)
    is_study = isinstance(loaded, Study)

    def known(name: str) -> Any:
        return loaded.axis_of(name)

    def any_name(body: str) -> Any:
        """Axes of a trial are what is given: words are static, numbers are traced."""
        words = [part for part in body.split(",") if ":" not in part and not _is_number(part)]
        return lambda name: (name, "static" if words else "float", None)

    axes = []
    for kind in ("grid", "choice", *drawn):
        for text in getattr(config, kind):
            lookup = known if is_study else any_name(text.partition("=")[2])
            if kind == "choice":
                lookup = _static(lookup)
            unit_of = loaded.unit_of if is_study else (lambda leaf: "")
            axis = parse_axis(text, lookup, unit_of)
            axes.append(axis._replace(every=kind == "grid" and bool(drawn)))
    if is_study:
        study = loaded
        if config.objective or config.goal:
            study = with_objective(study, config.objective, config.goal)
    else:
        study = from_trial(loaded, axes, name=config.study)
        study = with_objective(study, config.objective, config.goal)
    return (drawn or ["grid"])[0], axes, study


def _is_number(text: str) -> bool:
    from snn_fusion_failure.sweeps.leaves import parse_number

    try:
        parse_number(text, "", "")
    except ValueError:
        return False
    return True


def _static(lookup: Any) -> Any:
    def static(name: str) -> Any:
        leaf, kind, default = lookup(name)
        if kind == "float" and default is None:
            return leaf, "static", None
        return leaf, kind, default

    return static


def build(config: Config) -> Any:
    """The sweep that a command line asks for, checked, before anything is compiled."""
    from snn_fusion_failure.sweeps import engine

    kind, axes, study = read_axes(config)
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


def check(config: Config) -> None:
    """Refuse ways to run that exclude each other."""
    from snn_fusion_failure.sweeps.engine import parse_shard

    if config.distributed:
        if config.shard or config.workers > 1 or config.launcher != "local":
            raise ValueError("--distributed is one program; leave --shard and --workers out")
        if config.chunk_size == "auto":
            raise ValueError("--distributed: processes would measure apart; give --chunk-size N")
    if config.shard:
        parse_shard(config.shard)
        if config.workers > 1 or config.launcher != "local":
            raise ValueError("--shard is one process; leave --workers and --launcher out")


def main(config: Config) -> dict[str, Any]:
    """Run a sweep, or what is left of it; returns the counts and the best setting."""
    import jax

    from snn_fusion_failure.sweeps.engine import collect

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
    for error in dict.fromkeys(errors[:5]):
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
