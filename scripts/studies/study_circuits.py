"""Where failures begin: the reachable range of every specification and a threshold at 90 % of it.

    python scripts/studies/study_circuits.py --circuit ldo

For every specification a multi-start gradient ascent finds the largest value that the parameter
box (+-3 sigma) and the ball (|u| <= radius) can reach; the threshold lies at 90 % of the way from
the nominal value to it. Plain Monte Carlo then says how likely a failure is under the Gaussian and
under the uniform distribution. Writes `results/study_circuits.json`. About 5 CPU-minutes.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import (
    enable_compilation_cache,
    provenance,
    run_command,
    write_json,
)


@dataclass(frozen=True)
class Config:
    """Options of the study."""

    circuit: str = "ldo"
    starts: int = 24
    """Random starts of the ascent; half of them from the best Monte Carlo samples."""
    steps: int = 25
    """Ascent steps of each start."""
    radius: float = 6.0
    """Radius of the ball [sigma]."""
    share: float = 0.9
    """Threshold between the nominal value (0) and the largest reachable one (1)."""
    samples: int = 40_000
    """Monte Carlo samples of each distribution."""
    seed: int = 0
    out: Path = Path("results/study_circuits.json")


def ascend(
    gradient: Callable[[Any], tuple[Any, Any, Any]], x: Any, project: Callable[[Any], Any],
    steps: int, length: float,
) -> tuple[Any, Any]:  # fmt: skip
    """Projected ascent with normalised steps that shrink where they do not help.

    Returns the best points `[n, d]` and their values `[n]`.
    """
    import numpy as np

    n = len(x)
    step = np.full(n, length)
    best, held, slope = project(x), np.full(n, -np.inf), None
    trial = best
    for _ in range(steps):
        value, status, grad = gradient(trial)
        better = (status == 0) & np.isfinite(grad).all(axis=1) & (value > held)
        held = np.where(better, value, held)
        best = np.where(better[:, None], trial, best)
        slope = grad if slope is None else np.where(better[:, None], grad, slope)
        step = np.where(better, 1.2 * step, 0.4 * step)
        norm = np.linalg.norm(slope, axis=1, keepdims=True)
        trial = project(best + step[:, None] * slope / np.maximum(norm, 1e-300))
    return best, held


def main(config: Config) -> dict[str, Any]:
    """Run the study of one circuit and return its part of the record."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from failure import circuits

    circuit = circuits.get(config.circuit)
    rng = np.random.default_rng(config.seed)
    d, box = circuit.n_dims, circuit.box
    draws = {
        "gaussian": rng.normal(size=(config.samples, d)),
        "uniform": rng.uniform(-box, box, size=(config.samples, d)),
    }
    clouds = {}
    for name, x in draws.items():
        parts = [circuit.simulate(part) for part in x.reshape(-1, min(2000, config.samples), d)]
        clouds[name] = tuple(np.concatenate([np.asarray(p[k]) for p in parts]) for k in (0, 1))

    @jax.jit
    def vjp(x: Any, weight: Any) -> tuple[Any, Any, Any]:
        specs, pull, status = jax.vjp(circuit.run, x, has_aux=True)
        return specs, status, pull(weight)[0]

    def in_box(x: Any) -> Any:
        return np.clip(x, -box, box)

    def in_ball(x: Any) -> Any:
        norm = np.linalg.norm(x, axis=1, keepdims=True)
        return x * np.minimum(1.0, config.radius / np.maximum(norm, 1e-300))

    rows = []
    for k, spec in enumerate(circuit.specs):

        def gradient(x: Any, k: int = k) -> tuple[Any, Any, Any]:
            weight = np.zeros((len(x), len(circuit.specs)))
            weight[:, k] = 1.0
            with jax.enable_x64(True):
                specs, status, grad = vjp(jnp.asarray(x), jnp.asarray(weight))
            return np.asarray(specs)[:, k], np.asarray(status), np.asarray(grad)

        specs, status = clouds["uniform"]
        order = np.argsort(np.where(status == 0, specs[:, k], -np.inf))[::-1]
        top = draws["uniform"][order[: config.starts // 2]]
        fresh = rng.normal(size=(config.starts - len(top), d))
        start = np.concatenate([top, fresh])
        record: dict[str, Any] = {
            "spec": spec.name,
            "unit": spec.unit,
            "nominal": float(circuit.nominal[k]),
        }
        for region, project, length in (
            ("box", in_box, 0.15 * box * d**0.5),
            ("ball", in_ball, 0.25 * config.radius),
        ):
            best, value = ascend(gradient, start, project, config.steps, length)
            top_k = int(np.argmax(value))
            reach = float(value[top_k])
            threshold = record["nominal"] + config.share * (reach - record["nominal"])
            entry: dict[str, Any] = {
                "reachable": reach,
                "threshold": threshold,
                "starts_within_2_percent": int(
                    np.sum(value > reach - 0.02 * (reach - record["nominal"]))
                ),
                "norm_of_best": float(np.linalg.norm(best[top_k])),
                "best": [round(float(v), 6) for v in best[top_k]],
            }
            for name, (values, state) in clouds.items():
                good = state == 0
                count = int(np.sum(values[good, k] > threshold))
                entry[f"failures_{name}"] = count
                entry[f"probability_{name}"] = count / int(good.sum())
            record[region] = entry
        for name, (values, state) in clouds.items():
            good = values[state == 0, k]
            record[name] = {
                "mean": float(good.mean()),
                "sd": float(good.std()),
                "q999": float(np.quantile(good, 0.999)),
                "max": float(good.max()),
            }
        rows.append(record)
    return {
        "circuit": circuit.name,
        "n_dims": d,
        "radius": config.radius,
        "share": config.share,
        "samples": config.samples,
        "not_converged": {n: int(np.sum(s != 0)) for n, (_, s) in clouds.items()},
        "rows": rows,
    }


def record(config: Config) -> dict[str, Any]:
    """Put what `main` finds beside the circuits on record; returns what the result line says."""
    enable_compilation_cache()
    part = main(config)
    held: dict[str, Any] = {}
    if config.out.exists():
        held = json.loads(config.out.read_text(encoding="utf-8"))["circuits"]
    held[part["circuit"]] = {**part, **provenance()}
    write_json(config.out, {"study": "circuits", "circuits": held})
    return {"circuit": part["circuit"], **{r["spec"]: r["box"]["threshold"] for r in part["rows"]}}


if __name__ == "__main__":
    run_command(Config, record, description=__doc__, fields=dict)
