"""Options of `sweep`: what to sweep, how trials are dealt out, what starts the workers."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal


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
