"""One feature learned from gradients: how much of an output it explains, against other models.

    python scripts/studies/study_level_sets.py [--problems curved_manifold shell --specs undershoot]

From `--samples` uniform samples of the box of 3 sigma with their gradients: the share of the
variance of new samples' outputs that is explained (R2) by

- `level_sets`: a Gaussian process on one feature of `failure.level_sets` (reversible network);
- `active_subspace`: the same on the leading eigenvector of the gradients' outer products;
- `full`: a Gaussian process in all parameters, values only;
- `ridge`: a plane by ridge regression, values only;
- `rev_argate`: a Gaussian process on the leading feature of a Rev-ARGate trained on values.

Problems are those of `failure.problems` in `--dim` parameters. Writes
`results/study_level_sets.json`; about 2 CPU-minutes, most of it compiling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.records.sigma_cases import SPECS
from snn_fusion_failure.runs import enable_compilation_cache, repository, run_command


@dataclass(frozen=True)
class Config:
    """What to learn from."""

    problems: tuple[str, ...] = ("linear", "bent", "curved_manifold", "shell")
    specs: tuple[str, ...] = ()
    """Specifications: iq, undershoot, load_regulation, overshoot, output_accuracy."""
    models: tuple[str, ...] = ("level_sets", "active_subspace", "full", "ridge", "rev_argate")
    dim: int = 60
    samples: int = 100
    test_samples: int = 1000
    steps: int = 600
    """Steps of training of both reversible networks."""
    seeds: int = 3
    record: Path = repository.RESULTS / "study_level_sets.json"


def subject(config: Config, name: str) -> tuple[Callable[..., Any], Callable[..., Any], int]:
    """Values, values with gradients, number of parameters."""
    if name in SPECS:
        from failure import circuits
        from failure.circuits.outputs import performance_of, slopes_of

        circuit = circuits.get(SPECS[name][0])
        spec = SPECS[name][1]
        return performance_of(circuit, spec), slopes_of(circuit, spec), circuit.n_dims
    from failure.performances import slopes_by_jax
    from failure.problems import make_problem

    problem = make_problem(name, 1e-6, config.dim)
    return problem.performance, slopes_by_jax(problem.performance), config.dim


def by_feature(feature: Callable[[Any], Any], x: Any, y: Any, new: Any) -> Any:
    """Prediction by a Gaussian process on one feature."""
    from failure.models.emulator import Emulator

    z, at = feature(x), feature(new)
    centre, spread = z.mean(0), z.std(0)
    return Emulator((z - centre) / spread, y).predict((at - centre) / spread)[0]


def predicted(config: Config, model: str, seed: int, data: tuple[Any, ...]) -> Any:
    """Outputs of new samples by one model."""
    import dataclasses

    import jax
    import jax.numpy as jnp
    import numpy as np

    from failure import level_sets, rev_argate, revnet
    from failure.models.emulator import Emulator
    from failure.search.subspace import active_basis

    x, y, g, new = data
    key = jax.random.key(seed)
    if model == "level_sets":
        found, _ = level_sets.fit(
            x, g, key=key, config=level_sets.LevelSetConfig(steps=config.steps)
        )

        def level(x: Any) -> Any:
            with jax.enable_x64(True):
                return np.asarray(level_sets.features(found, jnp.asarray(x)))[:, :1]

        return by_feature(level, x, y, new)
    if model == "active_subspace":
        basis = active_basis(g, 1)
        return by_feature(lambda x: x @ basis, x, y, new)
    if model == "full":
        return Emulator(x, y).predict(new)[0]
    if model == "ridge":
        shift = y.mean()
        slope = np.linalg.solve(x.T @ x + np.eye(x.shape[1]), x.T @ (y - shift))
        return shift + new @ slope
    settings = dataclasses.replace(rev_argate.RevArgateConfig(), steps=config.steps)
    scale = 3.0**0.5
    rows = jnp.asarray(x / scale, jnp.float32)
    target = jnp.asarray((y - y.mean()) / y.std(), jnp.float32)
    params, _ = jax.jit(rev_argate.fit, static_argnums=0)(
        settings, rev_argate.RevArgateTrainParams(), rows, target, jnp.ones(len(x)), key=key
    )
    weights = np.asarray(rev_argate.fusion_weights(settings, params, rows)).mean(0)
    first = int(np.argmax(weights))

    def leading(x: Any) -> Any:
        z = revnet.forward(params.network, jnp.asarray(x / scale, jnp.float32))
        return np.asarray(z, np.float64)[:, first : first + 1]

    return by_feature(leading, x, y, new)


def main(config: Config) -> dict[str, Any]:
    """Learn and score; returns the rows."""
    import numpy as np

    known = ("level_sets", "active_subspace", "full", "ridge", "rev_argate")
    for model in config.models:
        if model not in known:
            raise ValueError(f"models={model!r}: expected some of {', '.join(known)}")
    if config.samples < 10 or config.seeds < 1:
        raise ValueError(
            f"samples={config.samples}, seeds={config.seeds}: expected at least 10 and 1"
        )
    enable_compilation_cache()
    rows: list[dict[str, Any]] = []
    for name in (*config.problems, *config.specs):
        values, slopes, dim = subject(config, name)
        scores: dict[str, list[float]] = {model: [] for model in config.models}
        for seed in range(config.seeds):
            rng = np.random.default_rng(seed)
            x = rng.uniform(-3.0, 3.0, size=(config.samples, dim))
            new = rng.uniform(-3.0, 3.0, size=(config.test_samples, dim))
            y, g = (np.asarray(a, np.float64) for a in slopes(x))
            truth = np.asarray(values(new), np.float64)
            good = np.isfinite(y) & np.all(np.isfinite(g), axis=1)
            held = np.isfinite(truth)
            data = (x[good], y[good], g[good], new[held])
            for model in config.models:
                rest = truth[held] - predicted(config, model, seed, data)
                scores[model].append(float(1.0 - np.mean(rest**2) / truth[held].var()))
        for model, found in scores.items():
            rows.append(
                {"row": f"{name} n={config.samples}", "model": model, "metric": "r2", "unit": "1",
                 **summarize(found)}
            )  # fmt: skip
        title = "One feature learned from gradients"
        record_table(config.record, "level_sets", title, rows, preset="paper")
    return {"rows": rows}


def result(found: dict[str, Any]) -> dict[str, Any]:
    """The result line: mean R2 by model."""
    by: dict[str, list[float]] = {}
    for row in found["rows"]:
        by.setdefault(row["model"], []).append(row["mean"])
    return {model: sum(values) / len(values) for model, values in by.items()}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=result)
