"""Files of a run of `find-failures` on a circuit: threshold, failures, pictures, worst point."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import write_json


def describe_point(circuit: Any, x: Any) -> str:
    """One failure point as a table: a row per transistor, a column per quantity, in sigma."""
    quantities = list(dict.fromkeys(q for _, q in circuit.parameter_names))
    transistors = list(dict.fromkeys(t for t, _ in circuit.parameter_names))
    values = dict(zip(circuit.parameter_names, x, strict=True))
    lines = ["transistor  " + "  ".join(f"{q:>10}" for q in quantities)]
    for name in transistors:
        cells = (values.get((name, q)) for q in quantities)
        lines.append(
            f"{name:<10}  "
            + "  ".join(f"{c:>+10.2f}" if c is not None else " " * 10 for c in cells)
        )
    return "\n".join(lines)


def threshold_for(circuit: Any, column: int, task: Any, out: Path) -> float:
    """The threshold of this task, computed once per folder, and again where it is damaged."""
    from failure.search.thresholds import reachable
    from failure.search.trees import set_aside

    path = out / "threshold.json"
    if path.exists():
        try:
            return float(json.loads(path.read_bytes())["threshold"])
        except (ValueError, KeyError, TypeError) as error:
            set_aside(path, f"{type(error).__name__}: {error}", "computed again")
    reach = reachable(circuit.run, column, task, sense=circuit.specs[column].sense)
    write_json(path, reach._asdict())
    return reach.threshold


def write_failures(
    out: Path, circuit: Any, column: int, seeds: Sequence[int], state: Any, threshold: float
) -> None:
    """`failures.csv`: a row per failing simulation, parameters in sigma.

    Args:
        out: run folder.
        circuit: Circuit.
        column: which specification.
        seeds: of the searches.
        state: history, `y` larger is worse.
        threshold: a failure is above it, in the sense of `y`.
    """
    import numpy as np

    spec = circuit.specs[column]
    sign = 1.0 if spec.sense == "max" else -1.0
    names = [f"{t}.{q}" for t, q in circuit.parameter_names]
    with (out / "failures.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["seed", "simulation", spec.name, *names])
        for row, index in np.argwhere(state.y > threshold):
            values = [f"{v:.6g}" for v in state.x[row, index]]
            writer.writerow([seeds[row], index + 1, sign * state.y[row, index], *values])


def verified(circuit: Any, column: int, state: Any, threshold: float) -> dict[str, int]:
    """How many failures were claimed, and how many the circuit's reference confirms."""
    import numpy as np

    sign = 1.0 if circuit.specs[column].sense == "max" else -1.0
    specs, status = circuit.reference(state.x[state.y > threshold])
    again = (np.asarray(status) == 0) & (sign * np.asarray(specs)[:, column] > threshold)
    return {"claimed": len(again), "confirmed": int(again.sum())}


def pictures(
    out: Path, circuit: Any, column: int, state: Any, threshold: float, *, label: str, n_init: int
) -> Any:
    """`trend.png` and `worst.png`; returns the worst point in sigma."""
    import numpy as np

    from failure import plots

    spec = circuit.specs[column]
    trend = plots.plot_trend(
        {label: state.y},
        threshold=threshold,
        n_init=n_init,
        label=f"{spec.name} [{spec.unit}]",
    )
    trend.savefig(out / "trend.png")
    point = state.x.reshape(-1, circuit.n_dims)[int(np.nanargmax(state.y))]
    worst = plots.plot_activity(circuit.parameter_names, point, title="worst point [sigma]")
    worst.savefig(out / "worst.png")
    return point
