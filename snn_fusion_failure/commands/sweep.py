"""Sweep constants of a study over many settings and seeds, on one core or on a cluster.

Try it (half a minute):

    python scripts/sweep.py --study lif --grid drive=16:40:13 neuron.tau_m=10,20,40 --seeds 8 \\
        --out runs/sweep_lif
    python scripts/sweep.py show runs/sweep_lif

A study is what one trial does: `lif` (a noisy neuron), `snn` (a robot learns to steer), `argate`
(train a fusion network), `failure` (search a circuit), or your own as `package.module:function`.
An axis is one constant of it, by name; an unknown name lists the known ones:

    --grid gamma=1e-4:1e-1:log:16 tau_z=5,25,100     16 x 3 settings
    --sobol gamma=1e-4:1e-1:log tau_z=5:100 --samples 64
    --random ...                                     the same with independent draws

Each setting is run `--seeds` times. Times are in milliseconds unless written as 25ms or 0.025s.

The folder is the sweep. Finished chunks are files that are never changed, so a sweep that was
killed goes on with the same command and repeats no finished chunk; other settings are refused.
Trial i draws from `fold_in(key(root), i)`: shards, workers and devices do not change its numbers.

    --workers 4                             four processes on this machine
    --launcher ray --workers 16             Ray actors; --ray-address auto joins a cluster
    --launcher submitit --workers 50 --slurm timeout_min=120 slurm_partition=cpu
    --shard 3/50                            the fourth of 50 parts, under any other scheduler
    --distributed                           one program over all devices of all processes

The last line is `result: ...`; `results.nc` in the folder is the labelled data set (xarray). Run
time: compiling takes 1 to 30 s per process, once; then a trial of `snn` takes about 8 CPU-seconds,
of `lif` a millisecond. `--chunk-size auto`, the default, prints what a trial of yours takes.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from snn_fusion_failure.runs import enable_compilation_cache, progress
from snn_fusion_failure.runs.command import run_command


@dataclasses.dataclass(frozen=True)
class Config:
    """What to sweep and where to run it."""

    study: str = "lif"
    """snn, argate, failure, lif, or package.module:function."""
    options: tuple[str, ...] = ()
    """Choices of the study, name=value; an unknown name lists the known ones."""
    grid: tuple[str, ...] = ()
    """Axes of a grid, leaf=values."""
    random: tuple[str, ...] = ()
    """Axes of random draws, leaf=low:high[:log]."""
    sobol: tuple[str, ...] = ()
    """Axes of a scrambled Sobol sequence, leaf=low:high[:log]."""
    samples: int = 0
    """Settings of a random or Sobol design."""
    design_seed: int = 0
    """Seed of a random or Sobol design."""
    seeds: int = 8
    """Trials per setting."""
    root: int = 0
    """Seed of all trials."""
    out: Path = Path("runs/sweep")
    """The sweep's folder."""
    overwrite: bool = False
    """Delete the sweep that is in OUT first."""
    retry_failed: bool = False
    """Run chunks again that raised an exception."""
    chunk_size: str = "auto"
    """Trials side by side on a device: 1 (one after another), a number, all, or auto (measured)."""
    chunk_trials: int = 0
    """Trials per file, lost at most when killed; default: 16 or a chunk size, whichever is more."""
    halving: tuple[int, ...] = ()
    """Drop settings after so many units of training (snn: learning trials), for example 5 10."""
    keep: float = 0.25
    """Share of the settings that goes on at each of them."""
    launcher: Literal["local", "ray", "submitit"] = "local"
    """What starts the workers."""
    workers: int = 1
    """Processes, actors or jobs of the launcher."""
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
    gpus_per_worker: float = 0.0
    """GPUs that a Ray actor asks for."""
    cluster: Literal["slurm", "local"] | None = None
    """Where submitit runs; SLURM where it is installed."""
    slurm: tuple[str, ...] = ()
    """Parameters of the jobs, name=value, as submitit names them."""
    quiet: bool = False
    """No progress bar."""


@dataclasses.dataclass(frozen=True)
class Show:
    """Print the best settings of a sweep and draw it."""

    out: Annotated[Path, tyro.conf.Positional]
    """The sweep's folder."""
    top: int = 10
    """Settings to print."""
    figures: bool = True
    """Draw heat maps and parallel coordinates into OUT."""


def parse_shard(text: str) -> tuple[int, int]:
    """`i/n` as numbers.

    Raises:
        ValueError: not of that form, or i is not in 0 ... n - 1.

    Example:
        >>> parse_shard("3/8")
        (3, 8)
    """
    left, slash, right = text.partition("/")
    if not (slash and left.isdigit() and right.isdigit() and int(left) < int(right)):
        raise ValueError(f"shard {text!r}: expected i/n with i from 0 to n - 1, for example 0/4")
    return int(left), int(right)


def build(config: Config) -> Any:
    """The sweep that a command line asks for, checked, before anything is compiled."""
    import numpy as np

    from snn_fusion_failure.sweeps import designs
    from snn_fusion_failure.sweeps.chunks import check_design
    from snn_fusion_failure.sweeps.folder import Sweep
    from snn_fusion_failure.sweeps.halving import check_halving
    from snn_fusion_failure.sweeps.study import load_study

    chosen = [k for k in ("grid", "random", "sobol") if getattr(config, k)]
    if len(chosen) != 1:
        raise ValueError(
            f"{' and '.join(chosen) or 'no axis'} given: give one of --grid, --random, --sobol, "
            "for example --grid drive=16:40:13"
        )
    if config.seeds < 1 or config.workers < 1 or config.chunk_trials < 0:
        raise ValueError(
            f"seeds = {config.seeds}, workers = {config.workers}, chunk_trials = "
            f"{config.chunk_trials}: expected at least 1 seed and 1 worker, no negative number"
        )
    study = load_study(config.study, config.options)
    kind: Any = chosen[0]
    axes = [designs.parse_axis(text, study.leaves, study.unit_of) for text in getattr(config, kind)]
    design = designs.design(kind, axes, samples=config.samples, seed=config.design_seed)
    n_trials = design.n * config.seeds
    if n_trials > np.iinfo(np.int32).max:
        raise ValueError(f"{n_trials} trials: expected at most 2**31 - 1; sweep in parts")
    sweep = Sweep(
        config.out, study, design, config.seeds, config.root, 1, 1, config.halving, config.keep
    )
    check_halving(sweep)
    check_design(sweep)
    return sweep


def lay_out(config: Config, sweep: Any) -> tuple[Any, dict[str, Any]]:
    """Chunk size and trials per file; measures where asked to, and says what it measured."""
    import jax
    import numpy as np

    from snn_fusion_failure.sweeps.program import fastest, measure_widths

    parts = parse_shard(config.shard)[1] if config.shard else config.workers
    share = -(-sweep.n_trials // parts)
    noted: dict[str, Any] = {}
    text = config.chunk_size
    if text == "all":
        width = -(-(config.chunk_trials or share) // len(jax.devices()))
    elif text == "auto":
        # Up to 64 trials per device, from all over the sweep: the slowest of a batch sets its time.
        most = min(share, (config.chunk_trials or 64) * len(jax.devices()))
        trials = np.linspace(0, sweep.n_trials - 1, most).astype(int)
        seconds = measure_widths(sweep.study, sweep.columns(trials), trials, root=sweep.root)
        width = fastest(seconds)
        noted["measured_seconds_per_trial"] = {str(k): v for k, v in seconds.items()}
        shown = ", ".join(f"{k}: {1e3 * v:.3g} ms" for k, v in seconds.items())
        print(f"chunk size {width}; measured per trial {shown}", file=sys.stderr)
    elif text.isdigit() and int(text) > 0:
        width = int(text)
    else:
        raise ValueError(f"chunk size {text!r}: expected a number from 1 on, all, or auto")
    side_by_side = width * len(jax.devices())
    # Whole calls: a file that is no multiple of a call would be filled up with repeats.
    trials_per_file = (
        config.chunk_trials or -(-max(16, side_by_side) // side_by_side) * side_by_side
    )
    return dataclasses.replace(sweep, width=width, chunk_trials=trials_per_file), noted


def open_sweep(config: Config) -> Any:
    """Claim the folder, or go on with the sweep in it."""
    from snn_fusion_failure.sweeps import chunks, folder

    sweep = build(config)
    if config.overwrite:
        if config.shard or config.distributed:
            raise ValueError(
                "--overwrite with --shard or --distributed would delete the others' work"
            )
        folder.forget(config.out)
    noted: dict[str, Any] = {}
    if (config.out / "sweep.json").exists():
        folder.claim(sweep)  # refuses other settings before anything is measured
    else:
        sweep, noted = lay_out(config, sweep)
    sweep = folder.claim(sweep, **noted)
    if config.retry_failed:
        print(f"{chunks.retry_failed(sweep)} failed chunks will be run again", file=sys.stderr)
    return sweep


def run(config: Config, sweep: Any) -> list[str]:
    """Run what is missing; returns what went wrong."""
    from snn_fusion_failure.sweeps import launchers
    from snn_fusion_failure.sweeps.chunks import next_rung, run_shard
    from snn_fusion_failure.sweeps.folder import done_chunks

    errors: list[str] = []
    with progress() as bar:
        bar.disable = config.quiet
        tasks: dict[Any, Any] = {}

        def show(rung: Any, done: int, total: int, message: str) -> None:
            if message:
                errors.append(message)
            if config.quiet:
                return
            if rung.budget not in tasks:
                name = f"sweep {sweep.study.name}"
                if rung.budget is not None:
                    name += f" ({rung.budget} {sweep.study.budget_text})"
                tasks[rung.budget] = bar.add_task(name, total=total, status="")
            status = f"{len(errors)} chunks failed" if errors else ""
            bar.update(tasks[rung.budget], completed=done, status=status)

        rung = next_rung(sweep)
        show(rung, len(done_chunks(sweep, rung.budget)), rung.n_chunks(sweep), "")
        if config.launcher == "ray":
            return errors + launchers.launch_ray(
                sweep, config.workers, show, address=config.ray_address, gpus=config.gpus_per_worker
            )
        if config.launcher == "submitit":
            from snn_fusion_failure.sweeps.study import parse_pairs

            parameters = parse_pairs(config.slurm, "slurm")
            return errors + launchers.launch_submitit(
                sweep, config.workers, show, cluster=config.cluster, parameters=parameters
            )
        if config.workers > 1:
            return errors + launchers.launch_local(sweep, config.workers, show)
        shard, shards = parse_shard(config.shard) if config.shard else (0, 1)
        run_shard(sweep, shard=shard, shards=shards, on_chunk=show)
    return errors


def main(config: Config) -> dict[str, Any]:
    """Run a sweep, or what is left of it; returns the counts and the best setting."""
    import jax

    if config.distributed:
        if config.shard or config.workers > 1 or config.launcher != "local":
            raise ValueError("--distributed is one program; leave --shard and --workers out")
        if config.chunk_size == "auto":
            raise ValueError("--distributed: processes would measure apart; give --chunk-size N")
        jax.distributed.initialize(config.coordinator, config.processes, config.process)
    if config.shard:
        parse_shard(config.shard)
        if config.workers > 1 or config.launcher != "local":
            raise ValueError("--shard is one process; leave --workers and --launcher out")
    enable_compilation_cache()
    sweep = open_sweep(config)
    start = time.perf_counter()
    errors = run(config, sweep)
    for error in errors[:5]:
        print(f"warning: {error}", file=sys.stderr)
    if jax.process_index() > 0:
        return {"complete": True}
    return summary(sweep) | {"seconds": time.perf_counter() - start}


def summary(sweep: Any) -> dict[str, Any]:
    """Gather what is there into `results.nc`; counts and the best setting."""
    from snn_fusion_failure.sweeps.folder import FAILED, MISSING, NON_FINITE
    from snn_fusion_failure.sweeps.gather import gather, write_netcdf
    from snn_fusion_failure.sweeps.show import rank

    dataset = gather(sweep)
    write_netcdf(dataset, sweep.out / "results.nc")
    status = dataset["status"].values
    rows = rank(dataset)
    result = {
        "complete": bool(dataset.attrs["complete"]),
        "trials": int((status != MISSING).sum()),
        "of": sweep.n_trials,
        "non_finite": int((status == NON_FINITE).sum()),
        "failed": int((status == FAILED).sum()),
        "objective": dataset.attrs["objective"],
    }
    if rows:
        result |= {"best": rows[0]["mean"], **rows[0]["axes"]}
    return result | {"out": str(sweep.out)}


def show(config: Show) -> dict[str, Any]:
    """Print and draw a sweep, complete or not."""
    from snn_fusion_failure.sweeps.folder import held_sweep
    from snn_fusion_failure.sweeps.gather import gather
    from snn_fusion_failure.sweeps.show import draw, rank, table

    sweep = held_sweep(config.out)
    result = summary(sweep)
    dataset = gather(sweep)
    rows = rank(dataset)
    for number, message in json.loads(dataset.attrs["failures"]).items():
        print(f"chunk {number} failed: {message.splitlines()[0]}")
    print(table(dataset, rows, top=config.top))
    if config.figures and rows:
        for path in draw(dataset, config.out):
            print(path)
    return result


def cli(argv: Sequence[str] | None = None, prog: str | None = None) -> None:
    """Parse, run, print the result line; `show FOLDER` prints and draws a sweep."""
    given = list(sys.argv[1:] if argv is None else argv)
    if given[:1] == ["show"]:
        prog = f"{prog or 'sweep.py'} show"
        run_command(Show, show, description=Show.__doc__, fields=dict, argv=given[1:], prog=prog)
    else:
        run_command(Config, main, description=__doc__, fields=dict, argv=given, prog=prog)
