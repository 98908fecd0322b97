"""Cost of one Bayesian-optimisation iteration: this package against BoTorch, at equal quality.

    taskset -c 0 python scripts/benchmarks/bench_bo.py --repeats 3 --out results

Needs the `bench` extra (torch, botorch). Both sides get the same data (n = 300 points, half of
them uniform, half around the best, as a search leaves them), the same kernel (Matern-5/2 with one
lengthscale per dimension), the same priors and logEI. Printed per case: CPU seconds of fit and
acquisition, the ratio, and the quality on both sides: the MAP objective that each fit reached
(same function), and logEI of each candidate under the same posterior. `warm` is what an iteration
of our loop costs (from the last fit, one point added); `cold` starts from the priors' mode. The
ratios count our acquisition at BoTorch's quality: more restarts than the searches use, and Newton
steps at the end; `search` is the ratio with the settings of the searches.

Prints the ratios; about 3 minutes on one core.
"""

from __future__ import annotations

import dataclasses
import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import provenance, run_command, write_json

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)


@dataclasses.dataclass(frozen=True)
class Config:
    """Cases to time."""

    dims: tuple[int, ...] = (22, 60)
    """Dimensions of the search space."""
    n: int = 300
    """Data points."""
    repeats: int = 2
    """Data sets per dimension."""
    seed: int = 0
    """Seed of the first data set."""
    n_restarts: int = 16
    """Ascents of the acquisition, ours, for the comparison at equal quality."""
    newton_steps: int = 8
    """Newton steps that finish the best of them."""
    out: Path | None = None
    """Folder of `bench_bo.json`; nothing is written without."""


def cpu(f: Callable[[], Any], best_of: int = 1) -> tuple[float, Any]:
    """Least CPU seconds of `f` and its last value."""
    times = []
    for _ in range(best_of):
        start = time.process_time()
        value = f()
        times.append(time.process_time() - start)
    return min(times), value


def make_data(seed: int, n: int, dim: int) -> tuple[Any, Any]:
    """Inputs in the unit cube and outputs of a function with curvature and interaction."""
    import numpy as np

    rng = np.random.default_rng(seed)
    weight = rng.normal(size=dim) * np.exp(-np.arange(dim) / (dim / 6))

    def f(x: Any) -> Any:
        bend = np.sin(4.0 * x[:, 0]) + 2.0 * x[:, 1] * x[:, 2] - x[:, 3] ** 2
        return x @ weight + bend

    first = rng.uniform(-0.5, 0.5, (n // 2, dim))
    centre = first[np.argmax(f(first))]
    rest = np.clip(centre + 0.15 * rng.normal(size=(n - n // 2, dim)), -0.5, 0.5)
    x = np.concatenate([first, rest])
    return x, f(x)


def time_botorch(x: Any, y: Any) -> dict[str, Any]:
    """Fit, candidate and CPU seconds of BoTorch."""
    import torch
    from botorch.acquisition.analytic import LogExpectedImprovement
    from botorch.fit import fit_gpytorch_mll
    from botorch.models import SingleTaskGP
    from botorch.models.utils.gpytorch_modules import get_covar_module_with_dim_scaled_prior
    from botorch.optim import optimize_acqf
    from gpytorch.mlls import ExactMarginalLogLikelihood

    torch.set_num_threads(1)
    torch.manual_seed(0)
    tx, ty = torch.tensor(x + 0.5), torch.tensor(y)[:, None]
    ty = (ty - ty.mean()) / ty.std()
    kernel = get_covar_module_with_dim_scaled_prior(ard_num_dims=x.shape[1], use_rbf_kernel=False)
    model = SingleTaskGP(tx, ty, covar_module=kernel, outcome_transform=None)
    fit_s, _ = cpu(lambda: fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model)))
    bounds = torch.stack([torch.zeros(x.shape[1]), torch.ones(x.shape[1])]).double()
    acquisition = LogExpectedImprovement(model, best_f=ty.max())
    acq_s, (candidate, _) = cpu(
        lambda: optimize_acqf(acquisition, bounds, q=1, num_restarts=10, raw_samples=512)
    )
    return {
        "fit_s": fit_s,
        "acq_s": acq_s,
        "lengthscale": kernel.lengthscale.detach().numpy().reshape(-1),
        "noise": float(model.likelihood.noise.detach()),
        "mean": float(model.mean_module.constant.detach()),
        "candidate": candidate.numpy()[0] - 0.5,
    }


def compare(seed: int, config: Config, dim: int) -> dict[str, Any]:
    """One case: both sides on the same data."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from failure.models import acquisition, candidates, gp, gp_fit
    from failure.models.domains import box

    n = config.n
    x, y = make_data(seed, n, dim)
    other = time_botorch(x, y)
    with jax.enable_x64(True):
        gp_config, acq = gp.GPConfig(), acquisition.AcquisitionConfig()
        more = dataclasses.replace(acq, n_restarts=config.n_restarts)
        size = gp.padded_size(n)
        px = jnp.zeros((size, dim)).at[:n].set(x)

        def targets(count: int) -> Any:
            part = y[:count]
            scaled = (part - part.mean()) / part.std(ddof=1)
            return jnp.zeros((size,)).at[:count].set(scaled)

        before, after = jnp.asarray(n - 1, jnp.int32), jnp.asarray(n, jnp.int32)
        start, eye = gp_fit.initial_params(gp_config, dim), jnp.eye(dim + 1)
        yes, no = jnp.asarray(True), jnp.asarray(False)
        half = jnp.full((dim,), 0.5)
        domain = box(-half, half)

        @jax.jit
        def fit(y: Any, count: Any, params: Any, h: Any, fresh: Any) -> Any:
            return gp_fit.fit(gp_config, params, px, y, count, h, fresh)

        @partial(jax.jit, static_argnums=(3, 4))
        def suggest(params: Any, y: Any, key: Any, acq: Any, newton_steps: int) -> Any:
            posterior = gp.condition(gp_config, params, px, y, after)
            _, top = jax.lax.top_k(y, 4)
            raw = candidates.raw_points(domain, px[top], acq.n_raw, key=key)
            return candidates.propose(
                gp_config, acq, posterior, domain, jnp.max(y), raw, newton_steps=newton_steps
            )

        y_now, key = targets(n), jax.random.key(seed)

        def run_fit(*args: Any) -> Any:
            return jax.block_until_ready(fit(*args))

        def run_suggest(params: Any, *effort: Any) -> Any:
            return jax.block_until_ready(suggest(params, y_now, key, *effort))

        search, equal = (acq, 0), (more, config.newton_steps)

        last = run_fit(targets(n - 1), before, start, eye, yes)
        for effort in (search, equal):
            run_suggest(last.params, *effort)  # compiled; from here on only run time is counted
        cold_s, cold = cpu(lambda: run_fit(y_now, after, start, eye, yes), 3)
        warm_s, warm = cpu(lambda: run_fit(y_now, after, last.params, last.hessian_inverse, no), 3)
        search_s, _ = cpu(lambda: run_suggest(warm.params, *search), 3)
        acq_s, _ = cpu(lambda: run_suggest(warm.params, *equal), 3)
        theirs = gp.GPParams(
            jnp.log(other["lengthscale"]),
            jnp.log(jnp.maximum(other["noise"] - gp_config.min_noise, 1e-12)),
            jnp.asarray(other["mean"]),
        )
        map_theirs = float(gp_fit.map_objective(gp_config, theirs, px, y_now, after))
        # Acquisition quality: both candidates under the posterior of BoTorch's own fit.
        _, ours_value = run_suggest(theirs, *equal)
        _, search_value = run_suggest(theirs, *search)
        posterior = gp.condition(gp_config, theirs, px, y_now, after)
        mean, variance = gp.predict(gp_config, posterior, jnp.asarray(other["candidate"])[None])
        theirs_value = acquisition.log_ei(mean, jnp.sqrt(variance), jnp.max(y_now))
    total = other["fit_s"] + other["acq_s"]
    return {
        "dim": dim,
        "n": n,
        "seed": seed,
        "botorch_fit_s": other["fit_s"],
        "botorch_acq_s": other["acq_s"],
        "cold_fit_s": cold_s,
        "warm_fit_s": warm_s,
        "acq_s": acq_s,
        "ratio_cold": total / (cold_s + acq_s),
        "ratio_warm": total / (warm_s + acq_s),
        "ratio_acq": other["acq_s"] / acq_s,
        "search_acq_s": search_s,
        "ratio_search": total / (warm_s + search_s),
        "map_botorch": map_theirs,
        "map_cold": float(cold.value),
        "map_warm": float(warm.value),
        "log_ei_botorch": float(np.asarray(theirs_value)[0]),
        "log_ei_ours": float(ours_value[0]),
        "log_ei_search": float(search_value[0]),
        "warm_evals": int(warm.n_evals),
        "cold_evals": int(cold.n_evals),
    }


def main(config: Config) -> dict[str, Any]:
    """Run all cases; returns them with the medians."""
    cases = []
    for dim in config.dims:
        for repeat in range(config.repeats):
            case = compare(config.seed + repeat, config, dim)
            cases.append(case)
            print(
                f"d={dim} seed={case['seed']}: BoTorch {case['botorch_fit_s']:.2f} + "
                f"{case['botorch_acq_s']:.2f} s; ours warm {case['warm_fit_s']:.3f} + "
                f"{case['acq_s']:.3f} s ({case['ratio_warm']:.0f}x), cold "
                f"{case['cold_fit_s']:.3f} s ({case['ratio_cold']:.0f}x); MAP "
                f"{case['map_botorch']:.5f} / {case['map_warm']:.5f} / {case['map_cold']:.5f}; "
                f"logEI {case['log_ei_botorch']:.4f} / {case['log_ei_ours']:.4f}; as in a search "
                f"{case['log_ei_search']:.4f} ({case['ratio_search']:.0f}x)",
                flush=True,
            )
    summary: dict[str, Any] = {}
    for dim in config.dims:
        chosen = [case for case in cases if case["dim"] == dim]
        for name in ("ratio_warm", "ratio_cold", "ratio_search"):
            summary[f"{name}_d{dim}"] = statistics.median(case[name] for case in chosen)
    summary["worst_map_gap"] = min(
        min(case["map_warm"], case["map_cold"]) - case["map_botorch"] for case in cases
    )
    summary["worst_log_ei_gap"] = min(
        case["log_ei_ours"] - case["log_ei_botorch"] for case in cases
    )
    summary["worst_log_ei_gap_search"] = min(
        case["log_ei_search"] - case["log_ei_botorch"] for case in cases
    )
    result = {**provenance(), "summary": summary, "cases": cases}
    if config.out is not None:
        write_json(config.out / "bench_bo.json", result)
    return result


def fields(result: dict[str, Any]) -> dict[str, float]:
    """What the result line says."""
    return result["summary"]


if __name__ == "__main__":
    run_command(Config, main, description=__doc__, fields=fields)
