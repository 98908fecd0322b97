"""The Gaussian process of a search: fitted, grown point by point, maximised, for all seeds."""

from __future__ import annotations

import dataclasses
from bisect import bisect_left
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from failure.models import acquisition, candidates, gp, gp_fit
from failure.models.domains import Domain
from failure.search import turbo
from failure.search.history import SearchState, Surrogate, stack
from failure.search.methods import METHODS, SearchConfig

# When the data outgrow one of these, a cold fit checks the warm one for a better optimum.
COLD_CHECKS = (96, 192, 320)

# Hyper-parameters are fitted to this many points at most: a fit is cubic in them, and few numbers
# per coordinate do not need a thousand. The posterior is always that of all points.
FIT_POINTS = 384

# Relative gain that ends a refit: far below one nat of log evidence in 300 data points.
FIT_FTOL = 1e-6


@lru_cache(maxsize=16)
def _programs(
    gp_config: gp.GPConfig, acq: acquisition.AcquisitionConfig
) -> dict[str, Callable[..., Any]]:
    """The jitted programs of the surrogate, mapped over seeds; methods and tasks share them."""

    # A batch is filled here, point by point; pBO's family fills its own.
    one = acq if acq.name == "pbo" else dataclasses.replace(acq, batch_size=1)

    def mapped(f: Callable[..., Any]) -> Any:
        return jax.jit(lambda *args: jax.lax.map(lambda a: f(*a), args))

    def fit(params: Any, x: Any, y: Any, n: Any, h: Any, fresh: Any) -> Any:
        return gp_fit.fit(gp_config, params, x, y, n, h, fresh, ftol=FIT_FTOL)

    def raw(domain: Domain, centres: Any, key: Any) -> Any:
        return candidates.raw_points(domain, centres, acq.n_raw, key=key)

    return {
        "fit": mapped(fit),
        "condition": mapped(partial(gp.condition, gp_config)),
        "append": mapped(partial(gp.append, gp_config)),
        "raw": mapped(raw),
        "propose": mapped(partial(candidates.propose, gp_config, one)),
        "mean": mapped(lambda posterior, u: gp.predict(gp_config, posterior, u[None])[0][0]),
        "region": jax.jit(jax.vmap(turbo.trust_region)),
    }


def _targets(state: SearchState, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Standardised outputs, padded to `size`, and the best valid one per seed.

    An invalid evaluation gets the mean of the valid ones: the surrogate then knows that the place
    has been tried, and neither seeks nor shuns it.
    """
    y = np.zeros((state.y.shape[0], size))
    best = np.zeros(state.y.shape[0])
    for row, values in enumerate(state.y):
        good = np.isfinite(values)
        if not good.any():
            continue
        mean = values[good].mean()
        sd = values[good].std(ddof=1) if good.sum() > 1 else 0.0
        sd = sd if sd > 1e-12 * abs(mean) else 1.0
        y[row, : state.n] = np.where(good, (values - mean) / sd, 0.0)
        best[row] = y[row, : state.n][good].max()
    return y, best


def fit_rows(y: np.ndarray) -> np.ndarray:
    """Rows of each seed that hyper-parameters are fitted to, `[S, min(n, FIT_POINTS)]`.

    The better half are the largest outputs, around which the search goes on; the others are
    spread evenly over the history. Invalid outputs come last.
    """
    n = y.shape[1]
    if n <= FIT_POINTS:
        return np.tile(np.arange(n), (len(y), 1))
    order = np.argsort(-np.where(np.isfinite(y), y, -np.inf), axis=1, kind="stable")
    top = FIT_POINTS // 2
    rest = np.sort(order[:, top:], axis=1)
    even = np.linspace(0, n - top - 1, FIT_POINTS - top).round().astype(int)
    return np.sort(np.concatenate([order[:, :top], rest[:, even]], axis=1), axis=1)


def _fit(config: SearchConfig, state: SearchState, x: Any, y: Any) -> Surrogate:
    """Fit hyper-parameters: from the last ones where there are any, else from the priors' mode."""
    assert config.gp is not None and config.acquisition is not None  # set by `SearchConfig`
    fit = _programs(config.gp, config.acquisition)["fit"]
    seeds, dim = len(config.seeds), x.shape[2]
    old = state.surrogate
    count = jnp.full((seeds,), min(state.n, FIT_POINTS), jnp.int32)
    if state.n > FIT_POINTS:
        rows = jnp.asarray(fit_rows(state.y))
        x = jnp.take_along_axis(x, rows[:, :, None], axis=1)
        y = jnp.take_along_axis(y, rows, axis=1)
    result = None
    if old is None or bisect_left(COLD_CHECKS, old.n_fit) != bisect_left(COLD_CHECKS, state.n):
        start = stack(gp_fit.initial_params(config.gp, dim), seeds)
        eye = stack(jnp.eye(dim + 1), seeds)
        result = fit(start, x, y, count, eye, jnp.ones((seeds,), bool))
    if old is not None:
        cold_start = jnp.zeros((seeds,), bool)
        warm = fit(old.params, x, y, count, old.hessian_inverse, cold_start)
        if result is None:
            result = warm
        else:
            better = warm.value >= result.value

            def pick(a: Any, b: Any) -> Any:
                return jnp.where(better.reshape((-1,) + (1,) * (a.ndim - 1)), a, b)

            result = jax.tree.map(pick, warm, result)
    assert result is not None
    return Surrogate(result.params, result.hessian_inverse, state.n)


def propose(
    config: SearchConfig,
    state: SearchState,
    unit: Domain,
    keys: Any,
    *,
    busy: np.ndarray | None = None,
) -> tuple[Any, Surrogate, Any]:
    """Fit or append, then maximise the acquisition for all seeds.

    A batch is made point by point: each earlier point of it, and each point that is being
    simulated, counts as if it had come out as predicted, so that the next one goes elsewhere.

    Args:
        config: the search.
        state: its history.
        unit: feasible set of the unit coordinates.
        keys: one per seed.
        busy: `[S, b, d]`, points that are being simulated.

    Returns:
        `(u [S, q, d], surrogate, posterior)`.

    Source: Ginsbourger, Le Riche and Carraro (2010), the kriging believer.
    """
    assert config.gp is not None and config.acquisition is not None  # set by `SearchConfig`
    programs = _programs(config.gp, config.acquisition)
    n, s = state.n, len(config.seeds)
    q = config.acquisition.batch_size
    one_by_one = config.acquisition.name != "pbo"
    waiting = 0 if busy is None else busy.shape[1]
    size = gp.padded_size(n + waiting + (q - 1 if one_by_one else 0))
    y_host, best_host = _targets(state, size)
    x_host = np.zeros((s, size, state.u.shape[2]))
    x_host[:, :n] = state.u
    x, y, best = jnp.asarray(x_host), jnp.asarray(y_host), jnp.asarray(best_host)
    surrogate = state.surrogate
    every = config.refit_every or max(2, n // 128)
    step = 1 if n <= 2 * config.n_init else every
    posterior = state.posterior
    if surrogate is None or n - surrogate.n_fit >= step:
        surrogate = _fit(config, state, x, y)
        posterior = None
    if posterior is None or posterior.x.shape[1] != size or q > 1:
        # Conditioned as it was at the fit, then grown point by point: the same numbers whether
        # the run was interrupted in between or not.
        at_fit = jnp.full((s,), surrogate.n_fit, jnp.int32)
        posterior = programs["condition"](surrogate.params, x, y, at_fit)
        grown = surrogate.n_fit
    else:
        grown = int(posterior.n[0])
    for row in range(grown, n):
        posterior = programs["append"](posterior, x[:, row], y)
    order = np.argsort(-np.where(np.isfinite(state.y), state.y, -np.inf), axis=1)[:, :4]
    centres = jnp.asarray(np.take_along_axis(state.u, order[:, :, None], axis=1))
    domain = stack(unit, s)
    if METHODS[config.method].trust_region:
        assert config.turbo is not None
        dim = state.u.shape[2]
        lengths = [turbo.region_length(config.turbo, row, config.n_init, dim) for row in state.y]
        domain = programs["region"](
            domain, centres[:, 0], jnp.asarray(lengths), surrogate.params.log_lengthscale
        )
    raw = programs["raw"](domain, centres, keys)
    believed = posterior
    for k in range(waiting):
        assert busy is not None
        believed, y, best = _believe(programs, believed, jnp.asarray(busy[:, k]), y, best)
    u, _ = programs["propose"](believed, domain, best, raw)
    if not one_by_one:
        return u[:, : config.n_total - n], surrogate, posterior
    batch = [u[:, 0]]
    for _ in range(1, min(q, config.n_total - n - waiting)):
        believed, y, best = _believe(programs, believed, batch[-1], y, best)
        u, _ = programs["propose"](believed, domain, best, raw)
        batch.append(u[:, 0])
    return jnp.stack(batch, axis=1), surrogate, posterior


def _believe(programs: Any, posterior: Any, u: Any, y: Any, best: Any) -> tuple[Any, Any, Any]:
    """The posterior as if `u [S, d]` had come out as predicted."""
    mean = programs["mean"](posterior, u)
    y = y.at[:, int(posterior.n[0])].set(mean)
    return programs["append"](posterior, u, y), y, jnp.maximum(best, mean)
