"""How well a detector tells failures, from the files that `eval` wrote cell by cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

SENSORS = ("camera", "lidar")


def read_told(
    out: Path, kinds: Sequence[str], levels: Sequence[int]
) -> dict[tuple[str, int], Any] | None:
    """Told probabilities `[n, 2]` of each kind and level, `("", 0)` without failure.

    Returns:
        None where the detector tells nothing.
    """
    import numpy as np

    names = {("", 0): "clean"} | {(k, level): f"{k}_{level}" for k in kinds for level in levels}
    paths = {cell: out / name / "failed.txt" for cell, name in names.items()}
    if not all(path.exists() for path in paths.values()):
        return None
    return {cell: np.loadtxt(path, ndmin=2) for cell, path in paths.items()}


def score_told(told: Mapping[tuple[str, int], Any], calibration: Any = None) -> dict[str, Any]:
    r"""Order and truth of told failures.

    Args:
        told: as from `read_told`.
        calibration: that they were told with; None for none.

    Returns:
        `auroc`: kind -> level -> the chance that the failing sensor's probability is higher than in
        a clean frame. Where kinds of both sensors were measured, of each sensor the `brier` score
        and the expected calibration `error` over readings of which a third is clean and in a third
        each sensor fails, all kinds and levels alike; `brier_before` of the probabilities without
        calibration, where its slope is not 0. With one, the share of clean frames
        (`false_alarms`) and of failing ones (`called`) above the threshold.
    """
    import numpy as np

    from fusion.evaluate import auroc
    from fusion.predictive_scores import outcome_brier, outcome_calibration_error

    clean = told["", 0]
    found: dict[str, Any] = {"auroc": {}}
    groups = {s: [cell for cell in told if cell[0].startswith(s)] for s in SENSORS}
    for k, sensor in enumerate(SENSORS):
        for kind, level in groups[sensor]:
            of_kind = found["auroc"].setdefault(kind, {})
            of_kind[str(level)] = auroc(told[kind, level][:, k], clean[:, k])
    whole = all(groups.values())
    parts = [clean] + [told[cell] for cells in groups.values() for cell in cells]
    shares = [1.0] + [1.0 / len(cells) for cells in groups.values() for _ in cells]
    fails = [""] + [s for s, cells in groups.items() for _ in cells]
    weights = np.repeat(shares, [len(part) for part in parts])
    for k, sensor in enumerate(SENSORS):
        p = np.concatenate(parts)[:, k]
        truth = np.repeat([name == sensor for name in fails], [len(part) for part in parts])
        scores: dict[str, float] = {}
        if whole:
            scores["brier"] = outcome_brier(p, truth, weights)
            scores["error"] = outcome_calibration_error(p, truth, weights)
        if calibration is not None:
            if whole and float(calibration.slope[k]) > 0:
                scores["brier_before"] = outcome_brier(_as_told(p, calibration, k), truth, weights)
            above = p > float(calibration.threshold[k])
            scores["false_alarms"] = float(above[: len(clean)].mean())
            if truth.any():
                scores["called"] = float(np.average(above[truth], weights=weights[truth]))
        found[sensor] = scores
    return found


def _as_told(p: Any, calibration: Any, sensor: int) -> Any:
    """Probabilities before a calibration."""
    import numpy as np
    from scipy.special import expit, logit

    slope, offset = float(calibration.slope[sensor]), float(calibration.offset[sensor])
    return expit((logit(np.clip(p, 1e-9, 1.0 - 1e-9)) - offset) / slope)


def print_told(scored: Mapping[str, Any], levels: Sequence[int]) -> None:
    """The table of the told failures."""
    print(f"\n{'AUROC of told failures':<28}" + "".join(f"{level:>8}" for level in levels))
    for kind, by_level in scored["auroc"].items():
        print(f"{kind:<28}" + "".join(f"{value:8.3f}" for value in by_level.values()))
    names = [name for name in scored["camera"] if name in scored["lidar"]]
    if names:
        print(f"\n{'told probabilities':<28}" + "".join(f"{s:>8}" for s in SENSORS))
        for name in names:
            line = "".join(f"{scored[s][name]:8.4f}" for s in SENSORS)
            print(f"{name.replace('_', ' '):<28}" + line)


def told_fields(scored: Mapping[str, Any]) -> dict[str, float]:
    """What goes into the result line: the mean AUROC, Brier scores."""
    cells = [v for by_level in scored["auroc"].values() for v in by_level.values()]
    fields = {"failed_auroc": sum(cells) / len(cells)} if cells else {}
    names = ("brier", "error", "false_alarms")
    return fields | {
        f"{name}_{s}": scored[s][name] for s in SENSORS for name in names if name in scored[s]
    }
