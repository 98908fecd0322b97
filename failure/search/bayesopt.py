"""Search for failures: one ask/tell loop for every search space, many seeds side by side.

State lives on the host as numpy arrays with a leading seed axis; the numerical work is a few
jitted programs mapped over the seeds. Asking is deterministic in (config, history), so a run can
be killed at any point and goes on from its log.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from failure.models.domains import Domain
from failure.search import baselines, surrogates
from failure.search.history import (
    SearchState,
    Surrogate,
    TrainSpace,
    best_so_far,
    first_hit,
    init,
    seed_keys,
    stack,
)
from failure.search.methods import METHODS, Method, SearchConfig
from failure.search.spaces import FullSpace, decode, encode, initial_design, random_embedding
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


def _first_space(config: SearchConfig) -> Any:
    """The space that needs no data, or None."""
    kind = METHODS[config.method].space
    if kind == "full":
        return stack(FullSpace(jnp.asarray(unit_scale(config.task))), len(config.seeds))
    if kind == "random":
        dim = config.embedding_dim or 1
        # 2**31 - 1: a stream of its own, away from the iterations'.
        keys = [jax.random.fold_in(jax.random.key(s), 2**31 - 1) for s in config.seeds]
        spaces = [random_embedding(config.task, dim, key=key) for key in keys]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *spaces)
    return None


def _initial(config: SearchConfig, state: SearchState) -> SearchState:
    """The initial design: uniform in the search space, or in x where that is not known yet."""
    keys = seed_keys(config, 0)
    space = _first_space(config)
    drawn_from: Any = space
    if space is None:
        drawn_from = stack(FullSpace(jnp.asarray(unit_scale(config.task))), len(config.seeds))
    one = jax.tree.map(lambda leaf: leaf[0], drawn_from)
    u = jax.vmap(lambda key: initial_design(one, config.task, config.n_init, key=key))(keys)
    x, clipped = decode(drawn_from, task_domain(config.task), u)
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


def _surrogate_ask(
    config: SearchConfig, state: SearchState, busy: np.ndarray | None = None
) -> SearchState:
    """Fit or append, then maximise the acquisition for all seeds."""
    waiting = 0 if busy is None else busy.shape[1]
    u, surrogate, posterior = surrogates.propose(
        config, state, _unit_domain(config, state), seed_keys(config, state.n + waiting), busy=busy
    )
    new_x, clipped = decode(state.space, task_domain(config.task), u)
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
    keys = seed_keys(config, state.n)
    space = train(config, keys, state.x, state.y)
    u = encode(space, jnp.asarray(state.x))
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
            head = encode(space, jnp.asarray(state.x[:, : state.n - known]))
            parts.insert(0, np.asarray(head))
    return state._replace(space=space, u=np.concatenate(parts, 1))


def ask(
    config: SearchConfig,
    state: SearchState,
    *,
    train: TrainSpace | None = None,
    busy: np.ndarray | None = None,
) -> tuple[np.ndarray, SearchState]:
    """The next points to simulate.

    Args:
        config: the search.
        state: history; points that are already asked are returned again.
        train: how a learned space is made; `failure.reversed_space.train_space` without, for
            `active_subspace` `failure.search.subspace.train_subspace`.
        busy: `[S, b, d]`, unit coordinates of points that are being simulated elsewhere.

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
    if method.needs_gradient and train is None:
        raise ValueError(
            f"train=None: expected level_set_space.level_sets_of_gradient(...) with method "
            f"{config.method!r}, which learns from the simulator's gradients"
        )
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
            state = _surrogate_ask(config, state, busy)
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
