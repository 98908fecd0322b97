"""A tour in a few minutes: each part of the project does its main job once, at small size.

    make demo

Four robots with the S4 network learn for 20 trials to find a target and are tested; ARGate-L learns
from HAR windows with eight of nine sensors failing (from simulated windows when the HAR data is not
at hand, and says so). Leaves pictures and numbers under `runs/demo`. About four minutes on two CPU
cores, half of it compiling.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from scripts import _run


@dataclasses.dataclass(frozen=True)
class Config:
    """Run the demo."""

    data_dir: Path | None = None
    """Folder of the real data sets; $FUSION_DATA_DIR is searched next."""
    out: Path = Path("runs/demo")
    """Where the pictures and numbers go; an earlier demo there is replaced."""


def spiking_robots(config: Config) -> dict[str, Any]:
    """S4 learns Scenario 1 in 20 trials; trajectories before and after."""
    from scripts import train_snn

    found = train_snn.main(
        train_snn.TrainSnn(
            scenario=1, network="S4", preset="quick", out=config.out / "robots_S4", overwrite=True
        )
    )
    means = {name: value["mean"] for name, value in found["metrics"].items()}
    return {k: means[k] for k in ("sr_learning", "sr_testing", "path_ratio") if k in means}


def sensor_fusion(config: Config) -> dict[str, Any]:
    """ARGate-L and the baseline on the same corrupted windows."""
    from fusion.data import load
    from scripts import train_argate

    dataset = "har"
    try:
        load("har", config.data_dir)
    except FileNotFoundError:
        print("   HAR data not found (set FUSION_DATA_DIR): simulated windows instead", flush=True)
        dataset = "simulated"
    results = {}
    for model in ("baseline", "argate_l"):
        results[model] = train_argate.main(
            train_argate.Config(
                dataset=dataset,
                model=model,
                preset="quick",
                data_dir=config.data_dir,
                out=config.out / f"fusion_{model}",
                overwrite=True,
            )
        )
    return {
        "dataset": dataset,
        "baseline": results["baseline"]["accuracy"],
        "argate_l": results["argate_l"]["accuracy"],
    }


def main(config: Config) -> dict[str, Any]:
    """Run every part and print one line for each."""
    _run.enable_compilation_cache()
    print("== spiking robots: S4 learns to reach a target", flush=True)
    robots = spiking_robots(config)
    print("== sensor fusion: train with most sensors failing", flush=True)
    fusion = sensor_fusion(config)
    _run.write_json(
        config.out / "result.json", {"robots": robots, "fusion": fusion} | _run.provenance()
    )
    print(f"pictures and numbers in {config.out}")
    _run.print_result(**robots, **fusion)
    return {"robots": robots, "fusion": fusion}


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, description=__doc__))
    except (ValueError, FileNotFoundError) as error:
        _run.fail(str(error))
