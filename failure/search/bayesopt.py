"""Search for failures: one ask/tell loop for every search space, many seeds side by side.

State lives on the host as numpy arrays with a leading seed axis; the numerical work is a few
jitted programs mapped over the seeds. Asking is deterministic in (config, history), so a run can
be killed at any point and goes on from its log.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from failure.models import acquisition, gp, gp_fit
from failure.models.optimize import Domain
from failure.search import baselines, turbo
from failure.search.history import (
    SearchState,
    Surrogate,
    TrainSpace,
    best_so_far,
    first_hit,
    init,
)
from failure.search.methods import METHODS, Method, SearchConfig
from failure.search.spaces import FullSpace, initial_design, random_embedding
from failure.search.subspace import train_subspace
from failure.search.task import task_domain, unit_scale
from failure.status import Status

__all__ = [
    "METHODS",
    "Method",
    "SearchConfig",
    "SearchState",
    "Surrogate",
    "TrainSpace",
    "ask",
    "best_so_far",
    "describe",
    "first_hit",
    "init",
    "tell",
]


# When the data outgrow one of these, a cold fit checks the warm one for a better optimum.
COLD_CHECKS = (96, 192, 320)

# Hyper-parameters are fitted to this many points at most: a fit is cubic in them, and few numbers
# per coordinate do not need a thousand. The posterior is always that of all points.
FIT_POINTS = 384

# Relative gain that ends a refit: far below one nat of log evidence in 300 data points.
FIT_FTOL = 1e-6


def _keys(config: SearchConfig, n: int) -> Any:
    """One key per seed for the iteration that follows `n` evaluations."""
    keys = [jax.random.fold_in(jax.random.key(seed), n) for seed in config.seeds]
    return jnp.stack(keys)


@lru_cache(maxsize=16)
def _programs(
    gp_config: gp.GPConfig, acq: acquisition.AcquisitionConfig
) -> dict[str, Callable[..., Any]]:
    """The jitted programs of the surrogate, mapped over seeds; methods and tasks share them."""

    def mapped(f: Callable[..., Any]) -> Any:
        return jax.jit(lambda *args: jax.lax.map(lambda a: f(*a), args))

    def fit(params: Any, x: Any, y: Any, n: Any, h: Any, fresh: Any) -> Any:
        return gp_fit.fit(gp_config, params, x, y, n, h, fresh, ftol=FIT_FTOL)

    def raw(domain: Domain, centres: Any, key: Any) -> Any:
        return acquisition.raw_points(domain, centres, acq.n_raw, key=key)

    return {
        "fit": mapped(fit),
        "condition": mapped(partial(gp.condition, gp_config)),
        "append": mapped(partial(gp.append, gp_config)),
        "raw": mapped(raw),
        "propose": mapped(partial(acquisition.propose, gp_config, acq)),
        "region": jax.jit(jax.vmap(turbo.trust_region)),
    }


@jax.jit
def _decode(space: Any, domain: Domain, u: Any) -> Any:
    """`u [S, q, d]` to `(x [S, q, D], clipped [S, q])`."""
    return jax.vmap(lambda s, block: jax.vmap(partial(s.decode, domain))(block))(space, u)


@jax.jit
def _encode(space: Any, x: Any) -> Any:
    return jax.vmap(lambda s, block: jax.vmap(s.encode)(block))(space, x)


def _stack(tree: Any, count: int) -> Any:
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * count), tree)


def _first_space(config: SearchConfig) -> Any:
    """The space that needs no data, or None."""
    kind = METHODS[config.method].space
    if kind == "full":
        return _stack(FullSpace(jnp.asarray(unit_scale(config.task))), len(config.seeds))
    if kind == "random":
        dim = config.embedding_dim or 1
        # 2**31 - 1: a stream of its own, away from the iterations'.
        keys = [jax.random.fold_in(jax.random.key(s), 2**31 - 1) for s in config.seeds]
        spaces = [random_embedding(config.task, dim, key=key) for key in keys]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *spaces)
    return None


def _initial(config: SearchConfig, state: SearchState) -> SearchState:
    """The initial design: uniform in the search space, or in x where that is not known yet."""
    keys = _keys(config, 0)
    space = _first_space(config)
    drawn_from: Any = space
    if space is None:
        drawn_from = _stack(FullSpace(jnp.asarray(unit_scale(config.task))), len(config.seeds))
    one = jax.tree.map(lambda leaf: leaf[0], drawn_from)
    u = jax.vmap(lambda key: initial_design(one, config.task, config.n_init, key=key))(keys)
    x, clipped = _decode(drawn_from, task_domain(config.task), u)
    pending = (np.asarray(x), np.asarray(u), np.asarray(clipped))
    return state._replace(pending=pending, space=space)


def _baseline(config: SearchConfig, state: SearchState) -> SearchState:
    """The next points of a method without a surrogate."""
    n_left = config.n_total - state.n
    blocks = []
    for row, seed in enumerate(config.seeds):
        rng = np.random.default_rng([seed, state.n])
        x, y = state.x[row], state.y[row]
        if config.method == "monte_carlo":
            blocks.append(baselines.monte_carlo(rng, config.task, n_left))
        elif config.method == "gradient_corner":
            blocks.append(baselines.gradient_corner(rng, config.task, x, y, n_left))
        elif state.n == 0:
            blocks.append(baselines.uniform(rng, config.task, config.n_init))
        else:
            blocks.append(baselines.ridge_corner(rng, config.task, x, y))
    x = np.stack(blocks)
    return state._replace(pending=(x, np.zeros((*x.shape[:2], 0)), np.zeros(x.shape[:2])))


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
        start = _stack(gp_fit.initial_params(config.gp, dim), seeds)
        eye = _stack(jnp.eye(dim + 1), seeds)
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


def _surrogate_ask(config: SearchConfig, state: SearchState) -> SearchState:
    """Fit or append, then maximise the acquisition for all seeds."""
    assert config.gp is not None and config.acquisition is not None  # set by `SearchConfig`
    programs = _programs(config.gp, config.acquisition)
    n, s = state.n, len(config.seeds)
    q = config.acquisition.batch_size
    size = gp.padded_size(n)
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
    domain = _stack(_unit_domain(config, state), s)
    if METHODS[config.method].trust_region:
        assert config.turbo is not None
        dim = state.u.shape[2]
        lengths = [turbo.region_length(config.turbo, row, config.n_init, dim) for row in state.y]
        domain = programs["region"](
            domain, centres[:, 0], jnp.asarray(lengths), surrogate.params.log_lengthscale
        )
    raw = programs["raw"](domain, centres, _keys(config, n))
    u, _ = programs["propose"](posterior, domain, best, raw)
    u = u[:, : config.n_total - n]
    new_x, clipped = _decode(state.space, task_domain(config.task), u)
    pending = (np.asarray(new_x), np.asarray(u), np.asarray(clipped))
    return state._replace(pending=pending, surrogate=surrogate, posterior=posterior)


def _unit_domain(config: SearchConfig, state: SearchState) -> Domain:
    space = jax.tree.map(lambda leaf: leaf[0], state.space)
    return space.domain(config.task)


def _learn_space(config: SearchConfig, state: SearchState, train: TrainSpace | None) -> SearchState:
    """Make the space from all evaluations so far; it re-describes the whole history."""
    if train is None and METHODS[config.method].space == "active":
        train = train_subspace
    elif train is None:
        from failure.reversed_space import train_space

        train = train_space
    keys = _keys(config, state.n)
    space = train(config, keys, state.x, state.y)
    u = _encode(space, jnp.asarray(state.x))
    return state._replace(
        space=space, space_at=state.n, u=np.asarray(u), surrogate=None, posterior=None
    )


def describe(
    config: SearchConfig, state: SearchState, asked: list[Any] | None = None
) -> SearchState:
    """Give a history of `x` and `y` its coordinates in the search space.

    Args:
        config: the search.
        state: with `x`; `space` is made where it needs no data.
        asked: unit coordinates of the evaluations after `space_at`, in blocks `[S, q, d]`;
            what was not asked in this space is encoded from `x`.
    """
    with jax.enable_x64(True):
        space = state.space if state.space is not None else _first_space(config)
        if space is None:
            return state
        parts = [np.asarray(block, np.float64) for block in asked or []]
        known = sum(part.shape[1] for part in parts)
        if known < state.n:
            head = _encode(space, jnp.asarray(state.x[:, : state.n - known]))
            parts.insert(0, np.asarray(head))
    return state._replace(space=space, u=np.concatenate(parts, 1))


def ask(
    config: SearchConfig, state: SearchState, *, train: TrainSpace | None = None
) -> tuple[np.ndarray, SearchState]:
    """The next points to simulate.

    Args:
        config: the search.
        state: history; points that are already asked are returned again.
        train: how a learned space is made; `failure.reversed_space.train_space` without, for
            `active_subspace` `failure.search.subspace.train_subspace`.

    Returns:
        `(x [S, q, D] in sigma, state)`.

    Raises:
        ValueError: the budget is spent.
    """
    if state.pending is not None:
        return state.pending[0], state
    if state.n >= config.n_total:
        raise ValueError(
            f"n_total={config.n_total}: expected more than the {state.n} simulations that are "
            "spent; raise n_total for a longer search"
        )
    method = METHODS[config.method]
    with jax.enable_x64(True):
        if method.space == "none":
            state = _baseline(config, state)
        elif state.n == 0:
            state = _initial(config, state)
        else:
            if method.learned:
                due = config.retrain_every and state.n - state.space_at >= config.retrain_every
                if state.space is None or due:
                    state = _learn_space(config, state, train)
            state = _surrogate_ask(config, state)
    assert state.pending is not None
    return state.pending[0], state


def tell(
    config: SearchConfig, state: SearchState, y: np.ndarray, status: np.ndarray | None = None
) -> SearchState:
    """Add the outputs of the points that were asked.

    Args:
        config: the search.
        state: with pending points `[S, q, D]`.
        y: `[S, q]`, larger is worse; a value that is not finite counts as invalid.
        status: `[S, q]`, see `failure.Status`, 0 where valid; all zero without.

    Returns:
        The history with these evaluations; nothing is pending.

    Raises:
        ValueError: nothing was asked, or the shape is another.
    """
    if state.pending is None:
        raise ValueError("tell without points that wait for an answer; call ask first")
    x, u, clipped = state.pending
    y = np.asarray(y, np.float64)
    if y.shape != x.shape[:2]:
        raise ValueError(f"y.shape={y.shape}: expected {x.shape[:2]}, one value per point")
    flags = np.zeros(y.shape, np.int64) if status is None else np.asarray(status, np.int64)
    flags = np.where((flags == 0) & ~np.isfinite(y), Status.NOT_FINITE_OUTPUT, flags)
    y = np.where(flags == 0, y, np.nan)
    old_u = state.u if state.n else np.zeros((*u.shape[:1], 0, u.shape[2]))
    return state._replace(
        x=np.concatenate([state.x, x], 1),
        u=np.concatenate([old_u, u], 1),
        y=np.concatenate([state.y, y], 1),
        status=np.concatenate([state.status, flags], 1),
        clipped=np.concatenate([state.clipped, clipped], 1),
        pending=None,
    )
