"""Active features of a specification, and which transistors they are.

    python scripts/studies/study_active.py --circuit ldo [--runs runs/table_4_1]

Trains a Rev-ARGate on simulated samples of every specification: on those of the Monte Carlo
searches below `--runs` (made by `study_failures.py`), or on fresh uniform samples of the box. Lists
how many features hold half and nine tenths of the fusion weight, the transistors behind them (by
the Jacobian of the inverse network), and the source's check: a small network on the active features
alone against one on all of them, on samples that neither has seen. Writes
`results/study_active.json` and one bar chart per specification to `--out`. About 1 CPU-minute each.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.rows import recorded
from snn_fusion_failure.runs import (
    enable_compilation_cache,
    print_result,
    provenance,
    repository,
    run_command,
    write_json,
)

SOURCE = {"ldo": (22, 60), "dcdc": (18, 44)}
"""Active features of the source, of how many."""


@dataclass(frozen=True)
class Config:
    """What to train on."""

    circuit: str = "ldo"
    specs: tuple[str, ...] = ()
    """Specifications; all without."""
    runs: Path | None = None
    """Folder of finished searches; fresh samples without."""
    samples: int = 2000
    """Samples at most."""
    steps: int = 600
    """Training steps of the Rev-ARGate."""
    seed: int = 0
    out: Path = Path("runs/study_active")
    """Folder of the pictures."""
    record: Path = repository.RESULTS / "study_active.json"
    """File of the numbers; rows of other circuits and specifications stay."""


def held_samples(folder: Path, limit: int) -> tuple[Any, Any]:
    """Samples and outputs (larger is worse) of a finished search."""
    import numpy as np

    lines = (folder / "evaluations.jsonl").read_text(encoding="utf-8").splitlines()
    records = [json.loads(line) for line in lines]
    x = np.concatenate([np.asarray(r["x"], np.float64) for r in records], 1)
    y = np.concatenate([np.asarray(r["y"], np.float64) for r in records], 1)
    x, y = x.reshape(-1, x.shape[-1]), y.reshape(-1)
    good = np.isfinite(y)
    return x[good][:limit], y[good][:limit]


def study(config: Config, circuit: Any, column: int) -> dict[str, Any]:
    """One specification."""
    import dataclasses

    import jax
    import jax.numpy as jnp
    import numpy as np

    from failure import active, feature_ranking, plots, rev_argate, revnet

    spec = circuit.specs[column]
    if config.runs is not None:
        folder = config.runs / circuit.name / spec.name / "box" / "monte_carlo"
        x, y = held_samples(folder, config.samples)
    else:
        rng = np.random.default_rng(config.seed)
        lo, hi = circuit.bounds
        x = rng.uniform(lo, hi, size=(config.samples, circuit.n_dims))
        specs, status = circuit.simulate(x)
        good = np.asarray(status) == 0
        x, y = x[good], np.asarray(specs)[good, column]
    scale = circuit.box / 3.0**0.5
    data = jnp.asarray(x / scale, jnp.float32)
    target = jnp.asarray((y - y.mean()) / y.std(), jnp.float32)
    cut = len(x) // 5
    settings = dataclasses.replace(rev_argate.RevArgateConfig(), steps=config.steps)
    key, check = jax.random.split(jax.random.key(config.seed))
    fit = jax.jit(rev_argate.fit, static_argnums=0)
    params, _ = fit(
        settings, rev_argate.RevArgateTrainParams(), data[:-cut], target[:-cut],
        jnp.ones((len(x) - cut,)), key=key,
    )  # fmt: skip
    error = rev_argate.predict(settings, params, data[-cut:]) - target[-cut:]
    found = active.activity(settings, params, data)
    nine = int(feature_ranking.active_features(jnp.asarray(found.weights)[None], 0.9)[1])
    z = revnet.forward(params.network, data)
    on_active, on_all = feature_ranking.check_active(
        z, target, found.order, found.n_active, key=check
    )
    shares = active.by_transistor(circuit.parameter_names, found.parameters)
    picture = config.out / f"active_{circuit.name}_{spec.name}.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    plots.plot_shares(shares, title=f"{circuit.name}: {spec.name}").savefig(picture)
    features = [
        {
            "feature": int(k),
            "weight": float(found.weights[k]),
            "transistors": dict(
                list(active.by_transistor(circuit.parameter_names, found.sensitivity[k]).items())[
                    :5
                ]
            ),
        }
        for k in found.order[: found.n_active]
    ]
    return {
        "circuit": circuit.name,
        "spec": spec.name,
        "samples": len(x),
        "n_features": circuit.n_dims,
        "n_active_half": found.n_active,
        "n_active_nine_tenths": nine,
        "source": SOURCE.get(circuit.name),
        "held_out_rmse": float(jnp.sqrt(jnp.mean(error**2))),
        "rmse_active_only": on_active,
        "rmse_all": on_all,
        "transistors": shares,
        "features": features,
    }


def main(config: Config) -> dict[str, Any]:
    """Study the specifications of one circuit; returns their rows."""
    from failure import circuits

    enable_compilation_cache()
    circuit = circuits.get(config.circuit)
    names = config.specs or circuit.spec_names
    path = config.record
    held = recorded(path)
    rows = []
    for column in [circuit.spec_index(name) for name in names]:
        row = {**study(config, circuit, column), **provenance()}
        rows.append(row)
        same = (row["circuit"], row["spec"])
        held = [r for r in held if (r["circuit"], r["spec"]) != same] + [row]
        write_json(path, {"study": "active", "rows": held})
        print_result(
            spec=row["spec"],
            active=f"{row['n_active_half']}/{row['n_features']}",
            rmse_active=row["rmse_active_only"],
            rmse_all=row["rmse_all"],
            first=next(iter(row["transistors"])),
        )
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
