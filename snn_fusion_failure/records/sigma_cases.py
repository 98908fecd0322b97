"""Rows of the table at fixed probability: what is simulated, at which threshold, and the truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from snn_fusion_failure.runs import write_json

SPECS = {
    "iq": ("ldo", "quiescent_current"),
    "undershoot": ("ldo", "undershoot"),
    "load_regulation": ("ldo", "load_regulation"),
    "overshoot": ("dcdc", "overshoot"),
    "output_accuracy": ("dcdc", "output_accuracy"),
}
"""Name in the table -> circuit and specification."""

USUAL_DIM = 60
"""Parameters of a problem whose row does not name their number."""

LINES = 400
"""Lines behind the probability at a measured threshold."""


class Case(NamedTuple):
    """A row: what is simulated, its threshold, the truth."""

    row: str
    performance: Callable[[Any], Any]
    slopes: Callable[[Any], Any] | None
    threshold: float
    dim: int
    truth: float
    points: Any
    batched: Callable[[Any], Any]
    truth_interval: tuple[float, float] | None = None
    """95 % interval of a truth that was measured; None where it is known exactly."""

    @property
    def measured(self) -> dict[str, Any]:
        """`truth_interval` for a row of record, nothing where the truth is exact."""
        return {} if self.truth_interval is None else {"truth_interval": [*self.truth_interval]}


def problem_case(name: str, p: float, dim: int) -> Case:
    """A problem of known probability."""
    import jax

    from failure.performances import slopes_by_jax
    from failure.problems import make_problem

    problem = make_problem(name, p, dim)
    with jax.enable_x64(True):
        program = jax.jit(problem.performance)
    size = "" if dim == USUAL_DIM else f" D={dim}"
    return Case(
        f"{name}{size} P={p:.0e}", program, slopes_by_jax(problem.performance), problem.threshold,
        dim, problem.probability, problem.points, problem.performance,
    )  # fmt: skip


def circuit_case(name: str, p: float, folder: Path) -> Case:
    """A specification at the threshold of a wanted probability."""
    import numpy as np

    from failure import circuits
    from failure.circuits.outputs import performance_of, slopes_of

    circuit_name, spec = SPECS[name]
    circuit = circuits.get(circuit_name)
    performance, slopes = performance_of(circuit, spec), slopes_of(circuit, spec)
    target = cached(
        folder / f"threshold_{name}_{p:.0e}.json",
        lambda: measured_threshold(performance, slopes, circuit.n_dims, p),
    )
    return Case(
        f"{name} P={p:.0e}", performance, slopes, target["threshold"], circuit.n_dims,
        target["probability"], np.asarray(target["point"])[None], performance,
        tuple(target["interval"]),
    )  # fmt: skip


def cached(path: Path, make: Callable[[], Any]) -> Any:
    """A JSON value that is computed once."""
    if not path.exists():
        write_json(path, make())
    return json.loads(path.read_text(encoding="utf-8"))


def measured_threshold(performance: Any, slopes: Any, dim: int, p: float) -> dict[str, Any]:
    """The threshold whose probability is p, to a few percent; the probability there, measured."""
    import jax
    import numpy as np
    from scipy.stats import norm

    from failure.hlrf import find_design_point
    from failure.lines import line_sampling
    from failure.rare_events import importance_sampling

    y, g = slopes(np.zeros((1, dim)))
    threshold = float(y[0]) + float(norm.isf(p)) * float(np.linalg.norm(g[0]))
    for _ in range(4):
        design = find_design_point(performance, threshold, dim, slopes=slopes)
        found = line_sampling(
            performance,
            threshold,
            design,
            key=jax.random.key(7),
            min_lines=30,
            max_lines=30,
            scan=0,
        )
        gap = float(norm.isf(p) - norm.isf(found.probability))
        if abs(gap) < 0.01:
            break
        threshold += gap * float(np.linalg.norm(design.gradient))
    design = find_design_point(performance, threshold, dim, slopes=slopes)
    exact = line_sampling(
        performance, threshold, design, key=jax.random.key(8), min_lines=LINES, max_lines=LINES,
        scan=0,
    )  # fmt: skip
    check = importance_sampling(
        performance, threshold, design.point[None], key=jax.random.key(9), n=1500, scan=0
    )
    return {
        "threshold": threshold, "probability": exact.probability,
        "interval": [exact.lower, exact.upper], "point": design.point, "beta": design.beta,
        "check": check.probability, "check_interval": [check.lower, check.upper],
        "verdict": exact.verdict,
    }  # fmt: skip
