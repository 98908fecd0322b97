"""How well the circuit solver agrees with ngspice, and how smooth and how robust it is.

    python scripts/studies/study_parity.py [--parts ldo_ngspice ldo_far ldo_grid ...]

Parts, each written to `results/study_circuit_parity.json` as soon as it is measured:

- `ldo_ngspice`: LDO regulator, level 1, against ngspice's own level 1 over normal samples: DC
  error, difference of the undershoot, rank correlation of every specification; the undershoot a
  second time with the same constant gate capacitances on both sides (EKV).
- `ldo_far`: the undershoot where failures are: normal samples moved to up to 6 sigma along the
  undershoot's slope, the solver of the searches (EKV) against ngspice with the same equations.
- `ldo_grid`: undershoot on the shipped grid against one with steps ten times shorter.
- `box`: share of samples of the parameter box that do not converge, both circuits.
- `dcdc_ngspice`: DC-DC converter against a transient of all transistors over all periods, and that
  transient against itself with another step.
- `dcdc_grid`: DC-DC specifications on the shipped grid against steps ten times shorter.
- `dcdc_far`: the DC-DC converter where failures are, normal samples moved to -6 to 6 sigma along
  the slope of each specification, and at other loads, against the same transient.
- `light_ngspice`: the converter at light load, the same points and other loads, against a transient
  of comparator, drivers and switches with an ideal controller.

About 10 CPU-minutes in all, most of it ngspice's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.converter_parity import (
    dcdc_far,
    dcdc_grid,
    dcdc_ngspice,
    light_ngspice,
    ranks,
    spread,
)
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    provenance,
    repository,
    run_command,
    write_json,
)

TARGETS = {
    "ldo_dc_relative_error": 1e-6,
    "ldo_undershoot_V": 2e-3,
    "ldo_rank_correlation": 0.99,
    "not_converged_share": 1e-3,
    "dcdc_rank_correlation": 0.9,
    "dcdc_grid_share_of_spread": 0.01,
}


@dataclass(frozen=True)
class Config:
    """Sizes of the study."""

    parts: tuple[str, ...] = (
        "ldo_ngspice", "ldo_far", "ldo_grid", "box", "dcdc_ngspice", "dcdc_grid", "dcdc_far",
        "light_ngspice",
    )  # fmt: skip
    ldo_samples: int = 200
    far_samples: int = 200
    dcdc_samples: int = 40
    far_dcdc_samples: int = 8
    """Of each specification, and at each other load."""
    grid_samples: int = 64
    box_samples: int = 4096
    max_step: float = 0.5e-9
    """Largest time step of ngspice for the DC-DC converter [s]."""
    workers: int = 2
    """ngspice processes at a time."""
    seed: int = 0
    out: Path = repository.RESULTS / "study_circuit_parity.json"


def ldo_ngspice(config: Config) -> dict[str, Any]:
    """LDO regulator against ngspice."""
    import numpy as np

    from failure.circuits.ldo.circuit import make_ldo

    x = np.random.default_rng(config.seed).normal(size=(config.ldo_samples, 60))
    result: dict[str, Any] = {"samples": len(x)}
    for model in ("level1", "ekv"):
        circuit = make_ldo(model)
        rows = x if model == "level1" else x[: len(x) // 4]
        ours, status = (np.asarray(a) for a in circuit.simulate(rows))
        theirs, failed = circuit.reference(rows, workers=config.workers)
        good = (status == 0) & (failed == 0)
        relative = np.abs(ours / theirs - 1.0)[good]
        apart = np.abs(ours - theirs)[good, 1]
        result[model] = {
            "compared": int(good.sum()),
            "not_converged": int((status != 0).sum()),
            "ngspice_failed": int((failed != 0).sum()),
            "dc_relative_error_max": float(relative[:, [0, 2]].max()),
            "undershoot_difference_max_V": float(apart.max()),
            "undershoot_difference_median_V": float(np.median(apart)),
            "rank_correlation": ranks(ours[good], theirs[good], circuit.spec_names),
        }
    return result


def ldo_far(config: Config) -> dict[str, Any]:
    """Undershoot of the LDO regulator against ngspice, out to 6 sigma along its slope."""
    import numpy as np

    from failure import circuits

    circuit = circuits.get("ldo")
    step = 0.1 * np.eye(circuit.n_dims)
    moved, _ = circuit.simulate(np.concatenate([step, -step]))
    up, down = np.asarray(moved)[:, 1].reshape(2, -1)
    axis = (up - down) / np.linalg.norm(up - down)
    x = np.random.default_rng(config.seed + 3).normal(size=(config.far_samples, len(axis)))
    reach = np.linspace(0.0, 6.0, len(x))
    x += (reach - x @ axis)[:, None] * axis
    ours, status = (np.asarray(a) for a in circuit.simulate(x))
    theirs, failed = circuit.reference(x, workers=config.workers, max_step=0.2e-9)
    good = (status == 0) & (failed == 0)
    apart = np.abs(ours - theirs)[good, 1]
    return {
        "samples": len(x),
        "compared": int(good.sum()),
        "not_converged": int((status != 0).sum()),
        "ngspice_failed": int((failed != 0).sum()),
        "undershoot_largest_V": float(theirs[good, 1].max()),
        "undershoot_difference_max_V": float(apart.max()),
        "undershoot_difference_median_V": float(np.median(apart)),
        "beyond_2_mV": int((apart > 2e-3).sum()),
    }


def ldo_grid(config: Config) -> dict[str, Any]:
    """Undershoot of the LDO regulator on the shipped grid and on a ten times finer one."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from failure.circuits.ldo import regulator

    fine = regulator.time_grid(10)
    rng = np.random.default_rng(config.seed + 1)
    x = {
        "gaussian": rng.normal(size=(60, config.grid_samples)),
        "box": rng.uniform(-3.0, 3.0, size=(60, config.grid_samples)),
    }
    result: dict[str, Any] = {"samples": config.grid_samples}
    with jax.enable_x64(True):
        shipped = jax.jit(regulator.solve_ldo)
        finer = jax.jit(lambda u: regulator.solve_ldo(u, time=fine))
        for name, u in x.items():
            (a, status), (b, _) = (map(np.asarray, f(jnp.asarray(u))) for f in (shipped, finer))
            good = status == 0
            a, b = a.T[good, 1:2], b.T[good, 1:2]
            result[name] = spread(a - b, b, ("undershoot",))["undershoot"]
            result[name]["beyond_2_mV"] = float(np.mean(np.abs(a - b) > 2e-3))
            result[name]["not_resolved"] = int(np.sum(~good))
    return result


def box(config: Config) -> dict[str, Any]:
    """Share of samples of the parameter box that do not converge."""
    import numpy as np

    from failure import circuits

    result: dict[str, Any] = {"samples": config.box_samples}
    for name in ("ldo", "dcdc"):
        circuit = circuits.get(name)
        rng = np.random.default_rng(config.seed + 2)
        lo, hi = circuit.bounds
        x = rng.uniform(lo, hi, size=(config.box_samples, circuit.n_dims))
        _, status = circuit.simulate(x)
        count = int(np.sum(np.asarray(status) != 0))
        result[name] = {"not_converged": count, "share": count / len(x)}
    return result


PARTS: dict[str, Callable[[Config], dict[str, Any]]] = {
    "ldo_ngspice": ldo_ngspice,
    "ldo_far": ldo_far,
    "ldo_grid": ldo_grid,
    "box": box,
    "dcdc_ngspice": dcdc_ngspice,
    "dcdc_grid": dcdc_grid,
    "dcdc_far": dcdc_far,
    "light_ngspice": light_ngspice,
}


def main(config: Config) -> dict[str, Any]:
    """Measure the parts; returns everything that is on record."""
    import json

    unknown = [p for p in config.parts if p not in PARTS]
    if unknown:
        raise ValueError(f"parts={unknown[0]!r}: expected some of {', '.join(PARTS)}; choose")
    enable_compilation_cache()
    held: dict[str, Any] = {}
    if config.out.exists():
        held = json.loads(config.out.read_text(encoding="utf-8"))["parts"]
    for name in config.parts:
        held[name] = {**PARTS[name](config), **provenance()}
        write_json(config.out, {"study": "circuit_parity", "targets": TARGETS, "parts": held})
    return held


def summary(held: dict[str, Any]) -> dict[str, float]:
    """The numbers that have a target."""
    found: dict[str, float] = {}
    if "ldo_ngspice" in held:
        part = held["ldo_ngspice"]["level1"]
        found["dc_error"] = part["dc_relative_error_max"]
        found["undershoot_mV"] = 1e3 * part["undershoot_difference_max_V"]
        found["ldo_rank"] = min(part["rank_correlation"].values())
    if "ldo_far" in held:
        found["far_undershoot_mV"] = 1e3 * held["ldo_far"]["undershoot_difference_max_V"]
    if "box" in held:
        found["not_converged"] = held["box"]["ldo"]["share"]
    if "dcdc_ngspice" in held:
        found["dcdc_rank"] = min(held["dcdc_ngspice"]["rank_correlation"].values())
    if "dcdc_far" in held:
        part = held["dcdc_far"]["6_sigma"]["difference"]
        found["far_dcdc_mV"] = 1e3 * max(p["max"] for p in part.values())
    if "light_ngspice" in held:
        part = held["light_ngspice"]["6_sigma"]["difference"]
        found["light_mV"] = 1e3 * max(p["max"] for p in part.values())
    if "dcdc_grid" in held:
        part = held["dcdc_grid"]["steps_divided_by_1"]["difference"]
        found["dcdc_grid_share"] = max(p["max_share"] for p in part.values())
    return found


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=summary)
