"""Searches for the first failure at a fixed probability, in the ball of 1.1 design distances."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from snn_fusion_failure.records.rows import summarize

REACH = 1.1
"""Radius of the ball over the distance of the nearest failure."""


class Setting(NamedTuple):
    """A search of the table: method of `failure.search`, initial design, gradients or not."""

    method: str
    n_init: int
    gradient: bool = False


SEARCHES: dict[str, Setting] = {
    "full": Setting("full", 10),
    "full_50": Setting("full", 50),
    "turbo_50": Setting("turbo", 50),
    "active_subspace": Setting("active_subspace", 10),
    "active_subspace_50": Setting("active_subspace", 50),
    "active_subspace+gradient": Setting("active_subspace", 10, gradient=True),
    "level_sets+gradient": Setting("level_sets", 10, gradient=True),
    "hdbo": Setting("hdbo", 10),
    "pbo": Setting("pbo", 10),
    "full_linear": Setting("full_linear", 10),
    "rev_argate_zeros_50": Setting("rev_argate_zeros", 50),
    "rev_argate_bnn_50": Setting("rev_argate_bnn", 50),
    "ridge_corner": Setting("ridge_corner", 10),
    "ridge_corner_50": Setting("ridge_corner", 50),
    "gradient_corner": Setting("gradient_corner", 10),
}
"""Name in the table -> setting."""


def monte_carlo_rows(row: str, truth: float, threshold: float) -> list[dict[str, Any]]:
    r"""What plain Monte Carlo needs, in expectation: :math:`1/P`, and for a factor 2 about 8/P.

    A share of k failures has a relative error of :math:`1/\sqrt k`; its 95 % interval ends at a
    factor 2 from :math:`k = (1.96 / \ln 2)^2 = 8.0` on.
    """
    base = {"row": row, "model": "monte_carlo (expected)", "truth": truth, "threshold": threshold}
    return [
        {**base, "metric": metric, "unit": "simulations", "n": 1, "mean": count / truth}
        for metric, count in (
            ("first_failure", 1.0),
            ("sims_factor2", (1.96 / math.log(2.0)) ** 2),
        )
    ]


def search_runs(
    name: str,
    performance: Callable[[Any], Any],
    slopes: Callable[[Any], Any] | None,
    threshold: float,
    points: np.ndarray,
    *,
    seeds: int,
    most: int,
) -> list[dict[str, Any]]:
    """First failure of every seed, all side by side; ends when all have one.

    Args:
        name: key of `SEARCHES`.
        performance: `x [n, D] -> y [n]`.
        slopes: `x [n, D] -> (y [n], dy/dx [n, D])`, which searches with gradients need.
        threshold: failure is above it.
        points: `[k, D]`, true design points.
        seeds: searches.
        most: simulations of each at most.
    """
    import jax

    from failure.search import bayesopt
    from failure.search.history import first_hit
    from failure.search.level_set_space import level_sets_of_gradient
    from failure.search.methods import SearchConfig
    from failure.search.subspace import subspace_of_gradient
    from failure.search.task import Task

    setting = SEARCHES[name]
    if setting.gradient and slopes is None:
        raise ValueError(f"name={name!r}: expected slopes, the search uses gradients")
    dim = points.shape[1]
    radius = REACH * float(np.linalg.norm(points, axis=1).min())
    retrain = 5 if setting.method == "active_subspace" else None
    config = SearchConfig(
        Task("ball", radius, dim), setting.method, seeds=tuple(range(seeds)),
        n_init=setting.n_init, n_total=most, retrain_every=retrain,
    )  # fmt: skip
    train = None
    if setting.gradient and slopes is not None:
        learner = subspace_of_gradient
        if setting.method == "level_sets":
            learner = level_sets_of_gradient
        train = learner(lambda x: np.nan_to_num(np.asarray(slopes(x)[1])))
    state = bayesopt.init(config)
    with jax.enable_x64(True):
        while state.n < most and np.isnan(first_hit(state.y, threshold)).any():
            x, state = bayesopt.ask(config, state, train=train)
            y = np.asarray(performance(x.reshape(-1, dim))).reshape(x.shape[:2])
            state = bayesopt.tell(config, state, y)
    found = []
    for seed, first in enumerate(first_hit(state.y, threshold)):
        cosine = math.nan
        if not math.isnan(first):
            point = state.x[seed, int(first) - 1]
            lengths = np.linalg.norm(points, axis=1) * np.linalg.norm(point)
            cosine = float(np.max(points @ point / lengths))
        found.append({"first_failure": float(first), "cosine": cosine})
    return found


def rows_of_search(
    row: str, name: str, truth: float, threshold: float, runs: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Rows of record: the share that found a failure, when, and how near to the design point."""
    base = {"row": row, "model": name, "truth": truth, "threshold": threshold}

    def finite(key: str) -> list[float]:
        values = (float("nan") if r[key] is None else float(r[key]) for r in runs)
        return [v for v in values if math.isfinite(v)]

    first = finite("first_failure")
    rows: list[dict[str, Any]] = [
        {**base, "metric": "success_rate", "unit": "1", "n": len(runs),
         "mean": len(first) / len(runs)},
    ]  # fmt: skip
    if first:
        rows.append({**base, "metric": "first_failure", "unit": "simulations", **summarize(first)})
        rows.append(
            {**base, "metric": "design_point_cosine", "unit": "1", **summarize(finite("cosine"))}
        )
        if SEARCHES[name].gradient:
            dear = [3.0 * v for v in first]
            rows.append(
                {**base, "metric": "first_failure_price3", "unit": "simulations",
                 **summarize(dear)}
            )  # fmt: skip
    return rows
