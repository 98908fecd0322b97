r"""`train_detector.py robustness`: average precision by failure and severity, and two summaries.

.. math::
    mRA = \frac{1}{|K|} \sum_k \frac{1}{S_k} \sum_s \frac{AP_{ks}}{AP_{clean}}, \qquad
    mCE = \frac{1}{|K|} \sum_k \frac{\sum_s (100 - AP_{ks})}{\sum_s (100 - AP^{base}_{ks})}

over kinds k and severities s; AP is 3D, moderate, R40.

Source: Kong et al. (2023), Robo3D; Hendrycks, Dietterich (2019) for the corruption error.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.commands.detector_calibration import as_calibration, held_calibration
from snn_fusion_failure.commands.detector_evaluation import evaluate
from snn_fusion_failure.commands.detector_options import Eval, Robustness
from snn_fusion_failure.commands.detector_runs import cache_folder, run_config, run_folder
from snn_fusion_failure.commands.detector_told import (
    print_told,
    read_told,
    score_told,
    told_fields,
)
from snn_fusion_failure.runs import provenance, to_jsonable, write_json

METRIC = "3d_moderate_r40"
Cells = Mapping[str, Mapping[str, float]]


def summarize_cells(clean: float, cells: Cells, baseline: Cells | None = None) -> dict[str, float]:
    """Mean, mRA and (against a baseline) mCE of average precisions by kind and severity.

    Args:
        clean: average precision without failure [%].
        cells: kind -> severity -> average precision [%].
        baseline: the same cells of the detector to compare with.

    Raises:
        ValueError: the baseline lacks a cell.
    """

    def mean(values: list[float]) -> float:
        return sum(values) / len(values)

    kinds = {kind: list(by_level.values()) for kind, by_level in cells.items()}
    found = {"mean": mean([mean(values) for values in kinds.values()])}
    if clean > 0:
        found["mra"] = mean([mean(values) / clean for values in kinds.values()])
    if baseline is not None:
        lacking = [k for k, v in cells.items() if set(v) - set(baseline.get(k, {}))]
        if lacking:
            raise ValueError(
                f"baseline: no {lacking[0]} at severities {', '.join(cells[lacking[0]])}: measure "
                "it with the same --kinds, --levels and --corrupted"
            )
        errors = [
            sum(100.0 - v for v in by_level.values())
            / max(sum(100.0 - baseline[kind][level] for level in by_level), 1e-9)
            for kind, by_level in cells.items()
        ]
        found["mce"] = mean(errors)
    return found


def _prepare(config: Robustness, folder: Path, out: Path) -> Path:
    """Cache of a corrupted folder, with anchor sizes and ground planes of the detector's own."""
    from fusion.detection.learning.cache import open_cache, prepare_cache

    made = out / f"cache_{folder.resolve().name}"
    if not (made / "cache.json").exists():
        like = open_cache(cache_folder(config))
        prepare_cache(
            folder.resolve(), made, config.size, splits=(config.split,), like=like, copies=True,
            any_size=True,
        )  # fmt: skip
    elif (before := open_cache(made).root.resolve()) != folder.resolve():
        raise ValueError(
            f"corrupted={folder}: {out} holds results of {before} under this name; give another "
            "--out, or name the folder otherwise"
        )
    return made


def check_names(corrupted: Sequence[Path]) -> None:
    """Refuse corrupted folders whose results would be mixed with others.

    Raises:
        ValueError: two folders of one name, or one that is called like a failure or `clean`.
    """
    from fusion.detection.learning.training import FAILURES

    taken = {"clean", *(f"{kind}_{level}" for kind in FAILURES for level in range(1, 6)), *FAILURES}
    for folder in corrupted:
        name = folder.resolve().name
        if name in taken:
            raise ValueError(
                f"corrupted={folder}: {name!r} is a failure of the suite, or given twice; name the "
                "folder otherwise"
            )
        taken.add(name)


def check_results(out: Path, run: Path, options: Eval) -> None:
    """Note what the results in `out` are of, or compare with what is noted there.

    Raises:
        ValueError: they were measured with other options or of another training.
    """
    steps = [int(p.name) for p in (run / "checkpoints").glob("*") if p.name.isdigit()]
    trained = json.loads((run / "config.json").read_text(encoding="utf-8"))["settings"]
    given = {
        "data": options.data.resolve(), "split": options.split, "seed": options.seed,
        "overlap": options.overlap, "trained": trained, "trained_steps": max(steps, default=0),
        "calibration": held_calibration(run),
    }  # fmt: skip
    now, path = to_jsonable(given), out / "measured.json"
    if path.exists():
        # Results of before there were calibrations have none.
        before = {"calibration": None} | json.loads(path.read_text(encoding="utf-8"))
        for name, value in now.items():
            if before.get(name, value) != value:
                raise ValueError(
                    f"{out} was measured with {name}={before[name]}, not {value}: give another "
                    "--out, or delete the folder to measure anew"
                )
    write_json(path, now)


def robustness(config: Robustness) -> dict[str, Any]:
    """Evaluate what is missing, print the table, write `robustness.json`; returns its content."""
    from fusion.detection.learning.training import FAILURES

    kinds = FAILURES if config.kinds is None else config.kinds
    if not kinds and not config.corrupted:
        raise ValueError("kinds=(): expected failures, or --corrupted folders")
    unknown = [kind for kind in kinds if kind not in FAILURES]
    if unknown:
        raise ValueError(f"kinds={unknown[0]!r}: expected of {', '.join(FAILURES)}")
    if not config.levels or not all(1 <= level <= 5 for level in config.levels):
        raise ValueError(f"levels={config.levels}: expected severities from 1 to 5")
    held = None
    if config.baseline is not None:
        held = json.loads(config.baseline.read_text(encoding="utf-8"))["cells"]
    check_names(config.corrupted)
    run = config.run or run_folder(config)
    out = config.out or run / f"robustness_{config.split}"
    plain = Eval(
        config.data, config.model, config.size, config.cache, split=config.split, seed=config.seed,
        run=run, overlap=config.overlap, pictures=0,
    )  # fmt: skip

    model = run_config(run, plain).model
    check_results(out, run, plain)

    def measure(name: str, options: Eval) -> float:
        path = out / name / "result.json"
        if not path.exists():
            evaluate(dataclasses.replace(options, out=path.parent))
        found = json.loads(path.read_text(encoding="utf-8"))
        return float(found[METRIC])

    clean = measure("clean", plain)
    cells: dict[str, dict[str, float]] = {}
    for kind in kinds:
        for level in config.levels:
            failing = dataclasses.replace(plain, failure=kind, severity=level / 5)
            value = measure(f"{kind}_{level}", failing)
            cells.setdefault(kind, {})[str(level)] = value
    for folder in config.corrupted:
        made = dataclasses.replace(plain, data=folder, cache=_prepare(config, folder, out))
        name = folder.resolve().name
        cells[name] = {"all": measure(name, made)}
    print(f"{'AP 3D moderate R40 [%]':<28}" + "".join(f"{level:>8}" for level in config.levels))
    print(f"{'clean':<28}{clean:8.2f}")
    for kind, by_level in cells.items():
        print(f"{kind:<28}" + "".join(f"{value:8.2f}" for value in by_level.values()))
    found = {"model": model, "clean": clean} | summarize_cells(clean, cells, held)
    record: dict[str, Any] = {"cells": cells, "provenance": provenance()}
    told = read_told(out, kinds, config.levels)
    if told is not None:
        calibration = held_calibration(run)
        record["told"] = scored = score_told(told, as_calibration(calibration))
        print_told(scored, config.levels)
        if calibration is None:
            print("probabilities as the network tells them: run `calibrate` for calibrated ones")
        elif calibration["split"] == config.split:
            print(
                f"calibrated on these frames: another list than {config.split!r} is a fairer test"
            )
        found |= told_fields(scored)
    write_json(out / "robustness.json", found | record)
    return found
