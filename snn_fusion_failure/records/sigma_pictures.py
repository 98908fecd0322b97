"""Pictures of the table at fixed probability: errors against cost, design points by transistor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from snn_fusion_failure.records.sigma_cases import SPECS, Case


class Cell(NamedTuple):
    """Runs of one method on one row."""

    case: Case
    method: str
    runs: list[dict[str, Any]]


def draw_errors(cells: Sequence[Cell], path: Path) -> None:
    """Estimate over truth against simulations, one panel per row."""
    import numpy as np

    from failure.plots import plot_errors

    panels: dict[str, dict[str, Any]] = {}
    for case, method, runs in cells:
        estimates = [math.nan if r["probability"] is None else r["probability"] for r in runs]
        panels.setdefault(case.row, {})[method] = (
            np.array([float(r["simulations"]) for r in runs]),
            np.array(estimates, np.float64) / case.truth,
            np.array([r["verdict"] == "good" for r in runs]),
        )
    save(plot_errors(panels), path)


def draw_design_points(cases: Sequence[Case], folder: Path) -> None:
    """The nearest failures of a circuit's specifications by transistor, each on its rarest row.

    Writes `table_4_sigma_CIRCUIT.png`.
    """
    from failure import circuits
    from failure.plots import plot_design_points

    rarest: dict[str, Case] = {}
    for case in cases:
        spec = case.row.split()[0]
        if spec in SPECS and (spec not in rarest or case.truth < rarest[spec].truth):
            rarest[spec] = case
    for name in dict.fromkeys(SPECS[spec][0] for spec in rarest):
        points = {c.row: c.points[0] for s, c in rarest.items() if SPECS[s][0] == name}
        names = circuits.get(name).parameter_names
        title = f"{name}: the most likely failure of each specification"
        save(plot_design_points(names, points, title=title), folder / f"table_4_sigma_{name}.png")


def save(figure: Any, path: Path) -> None:
    """Write a picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
