"""`train_detector.py calibrate`: told failures to be taken at their word, kept with the run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from snn_fusion_failure.commands.detector_options import Calibrate
from snn_fusion_failure.commands.detector_runs import (
    build,
    cache_folder,
    check_settings,
    load_run,
    run_config,
    run_folder,
)
from snn_fusion_failure.runs import enable_compilation_cache, provenance, write_json

FILE = "calibration.json"
SPLIT, RATE = "val", 0.01
"""Of the calibration that `train` ends with."""
_SENSORS = ("camera", "lidar")


def calibrate(config: Calibrate) -> dict[str, Any]:
    """Calibrate a run; returns what the file in its folder holds."""
    enable_compilation_cache()
    from fusion.detection.learning.cache import open_cache

    run = config.run or run_folder(config)
    cache = open_cache(cache_folder(config))
    trained = run_config(run, config)
    if config.split == trained.split:
        raise ValueError(
            f"split={config.split!r}: expected frames that the training did not see; give another "
            "list"
        )
    setup = build(trained, cache)
    check_settings(run, setup)
    return write_calibration(
        run, setup, load_run(run, setup), cache, config.split, config.false_alarm_rate
    )


def write_calibration(
    run: Path, setup: Any, state: Any, cache: Any, split: str, rate: float
) -> dict[str, Any]:
    """Calibrate a trained state on a list and write `calibration.json`; returns its content."""
    from fusion.detection.learning.cache import read_example
    from fusion.detection.learning.failure_calibration import calibrate_told_failures

    names = cache.names(split)
    found, report = calibrate_told_failures(
        setup.config,
        state,
        len(names),
        lambda i: read_example(cache.examples(split), names[i]),
        kinds=setup.train.failure_kinds,
        false_alarm_rate=rate,
    )
    held: dict[str, Any] = {
        "split": split, "frames": report.frames, "false_alarm_rate": rate,
        "trained_steps": int(state.step),
    }  # fmt: skip
    for k, sensor in enumerate(_SENSORS):
        held |= {f"{name}_{sensor}": float(getattr(found, name)[k]) for name in found._fields}
    for name in report._fields[1:]:
        held |= {f"{name}_{s}": getattr(report, name)[k] for k, s in enumerate(_SENSORS)}
    write_json(run / FILE, held | {"provenance": provenance()})
    return held


def calibrate_if_possible(run: Path, setup: Any, state: Any, cache: Any) -> None:
    """What `train` ends with: calibrate on the validation list, or say why not."""
    from fusion.detection.sensors.platt import frames_needed

    if not (setup.config.gated and setup.config.gate_statistics):
        return
    n, least = len(cache.splits.get(SPLIT, ())), frames_needed(RATE)
    if n < least:
        print(
            f"told failures are not calibrated: {n} frames of {SPLIT!r}, {least} are needed for a "
            f"rate of false alarms of {RATE}; `calibrate` takes another list or rate"
        )
    elif setup.train.failure_share == 0:
        print("told failures are not calibrated: no sensor failed in this training")
    else:
        write_calibration(run, setup, state, cache, SPLIT, RATE)


def held_calibration(run: Path) -> dict[str, Any] | None:
    """What `calibration.json` of a run holds; None where there is none."""
    path = run / FILE
    if not path.is_file():
        return None
    held: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return {name: value for name, value in held.items() if name != "provenance"}


def as_calibration(held: dict[str, Any] | None) -> Any:
    """Its `Calibration`."""
    import numpy as np

    from fusion.detection.sensors.platt import Calibration

    if held is None:
        return None
    fields = ([held[f"{n}_{s}"] for s in _SENSORS] for n in Calibration._fields)
    return Calibration(*(np.asarray(field, np.float32) for field in fields))


def read_calibration(run: Path, state: Any) -> Any:
    """The `Calibration` that is kept with a run; None where there is none.

    Raises:
        ValueError: it is of another length of the training.
    """
    held = held_calibration(run)
    if held is not None and held["trained_steps"] != int(state.step):
        raise ValueError(
            f"{run / FILE}: made after {held['trained_steps']} steps, the run has "
            f"{int(state.step)}; run `calibrate` again"
        )
    return as_calibration(held)
