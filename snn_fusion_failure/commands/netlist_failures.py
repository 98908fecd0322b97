"""Find the rare failures of a netlist of your own: worst-case distances, DPPM and yield.

    sff find-failures --netlist opamp.cir --vary "dvt1:2m" "rl:1%" --measure "gain>=60" --out DIR

Every `--vary NAME:SIGMA` is a `.param` of the netlist that is normal about its value, with an
absolute (2m) or a relative (1%) sigma; every `--measure` a limit on what `.meas` or `print` gives.
The tool starts the simulator itself, `--workers` at a time, and writes to DIR: `report.html`,
`specs.csv`, `parameters.csv`, `corners.csv`, `samples.csv`, `result.json`, the deck of each worst
case (`worst_*.cir`), and in `kept/` deck and log of runs that missed a measure (`odd_*`) or failed
(`fail_*`). Finished runs are in `DIR/cache`: `--resume` pays for nothing twice, with a larger
`--n-total` too.
"""

from __future__ import annotations

import dataclasses
import logging
import shutil
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import (
    WorkFailedError,
    apply_changes,
    open_run,
    print_result,
    progress,
    provenance,
    write_json,
)

BUDGETS = {"quick": 300, "paper": 1000}
"""Preset -> simulations of samples (each in all corners)."""

NOT_SETTINGS = (
    "out", "resume", "overwrite", "workers", "timeout", "retries", "n_total", "preset", "start",
)  # fmt: skip
"""Options that may change when a run goes on: they do not change what is simulated."""


@dataclasses.dataclass(frozen=True)
class NetlistConfig:
    """What varies, what must hold, and what may be spent on it."""

    netlist: Path
    """The netlist."""
    vary: tuple[str, ...]
    """NAME:SIGMA of every varied .param; SIGMA absolute (2m) or relative (1%)."""
    measure: tuple[str, ...]
    """Limits: NAME<=NUMBER, NAME>=NUMBER or LOW<=NAME<=HIGH."""
    correlate: tuple[str, ...] = ()
    """NAME,NAME:RHO for a group, or FILE.csv with a matrix under a line of names."""
    corners: tuple[str, ...] = ()
    """NAME:PARAM=VALUE,... with temp=CELSIUS, lib=SECTION; a bare NAME is the netlist itself."""
    pvt: tuple[str, ...] = ()
    """Lists that multiply the corners: temp=-40,27,125 or vdd=1.62,1.98."""
    command: str = "ngspice -b -n {deck}"
    """How one deck is simulated."""
    workers: int = 2
    """Simulations at a time."""
    timeout: float = 60.0
    """Limit of one simulation [s]."""
    retries: int = 0
    """Further attempts at a simulation that gave nothing."""
    invalid: str = "fail"
    """A missing or infinite measure: fail (a failure), ignore (nothing), stop (the end)."""
    start: Path | None = None
    """CSV of earlier samples: a column per varied parameter; columns of measures save their run."""
    preset: str = "paper"
    """quick (300 samples) or paper (1000)."""
    n_total: int | None = None
    """Samples in all, instead of the preset's."""
    seed: int = 0
    set: tuple[str, ...] = ()
    """Constants to change: analysis.NAME=VALUE."""
    out: Path = Path("runs/netlist_failures")
    """Run folder."""
    resume: bool = False
    """Go on with the run in `out`, also with a larger budget."""
    overwrite: bool = False
    """Forget the run in `out`."""


def settings_of(config: NetlistConfig) -> dict[str, Any]:
    """What identifies a run: the options that change its numbers, the text of the netlist."""
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in NOT_SETTINGS}
    settings["netlist"] = config.netlist.name
    settings["netlist_text"] = config.netlist.read_text(encoding="utf-8", errors="replace")
    return settings


def prepare(config: NetlistConfig) -> Any:
    """The simulator of the options, everything checked."""
    from failure.simulators.corners import pvt_corners
    from failure.simulators.deck import read_deck
    from failure.simulators.measures import one_sided, parse_limit
    from failure.simulators.netlist_simulator import NetlistSimulator
    from failure.simulators.variation import parse_variation

    return NetlistSimulator(
        read_deck(config.netlist),
        parse_variation(config.vary, config.correlate),
        [side for text in config.measure for side in one_sided(parse_limit(text))],
        pvt_corners(config.corners, config.pvt),
        command=config.command,
        workers=config.workers,
        timeout=config.timeout,
        retries=config.retries,
        invalid=config.invalid,
        cache=config.out / "cache",
        keep=config.out / "kept",
    )


def main(config: NetlistConfig) -> dict[str, Any]:
    """Run the analysis; returns the result that is also written."""
    import jax

    from failure.simulators import SimulatorError
    from failure.yield_analysis import AnalysisConfig, analyse
    from snn_fusion_failure.records import netlist_files, netlist_report

    if config.preset not in BUDGETS:
        raise ValueError(f"preset={config.preset!r}: expected one of {', '.join(BUDGETS)}")
    total = BUDGETS[config.preset] if config.n_total is None else config.n_total
    analysis = apply_changes({"analysis": AnalysisConfig(total)}, config.set)["analysis"]
    simulator = prepare(config)
    if config.overwrite:
        for name in ("cache", "kept"):
            shutil.rmtree(config.out / name, ignore_errors=True)
    open_run(config.out, settings_of(config), resume=config.resume, overwrite=config.overwrite)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    dim = len(simulator.variation.names)
    with progress() as bar:
        job = bar.add_task(config.netlist.stem, total=total, status="nominal circuit")

        def evaluate(x: Any) -> Any:
            g, _ = simulator(x)
            failed = int((g > 0.0).any(axis=1).sum())
            bar.update(job, advance=len(x), status=f"{failed} of the last {len(x)} failed")
            return g

        try:
            _ = simulator.nominal
            known = netlist_files.read_start(config.start, simulator) if config.start else None
            found = analyse(analysis, evaluate, dim, start=known, key=jax.random.key(config.seed))
        except SimulatorError as error:
            raise WorkFailedError(str(error)) from error
    result = netlist_files.write(config.out, simulator, found)
    result.update({"settings": settings_of(config), "n_total": total, **provenance()})
    write_json(config.out / "result.json", result)
    netlist_report.write(config.out / "report.html", config.netlist.name, simulator, result)
    for line in netlist_files.summary(result):
        print(line)
    print_result(
        worst_distance=result["worst_distance"],
        dppm=result["yield"]["dppm"],
        simulations=found.archive.spent,
        started=simulator.simulations,
        verdict=result["yield"]["verdict"].replace(" ", "_"),
    )
    return result
