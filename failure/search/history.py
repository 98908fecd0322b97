"""The history of a search: evaluations, what waits for an answer, first failures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from failure.search.methods import SearchConfig


class Surrogate(NamedTuple):
    """Hyper-parameters of the last fit per seed, its curvature, and the count it was made at."""

    params: Any
    hessian_inverse: Any
    n_fit: int


class SearchState(NamedTuple):
    """History with a leading seed axis `S`; `n` evaluations are complete, the rest is asked.

    Attributes:
        x: `[S, n, D]` parameters in sigma.
        u: `[S, n, d]` unit coordinates of the search space (empty for baselines).
        y: `[S, n]` outputs; NaN where the simulator gave none.
        status: `[S, n]`; see `failure.Status`, 0 valid.
        clipped: `[S, n]` share of coordinates that restoration put outside the set.
        pending: `(x, u, clipped)` that wait for `tell`, or None.
        space: the search space, stacked over seeds; None until it is known.
        space_at: evaluations the space was made from.
        surrogate: of the last ask, or None.
        posterior: the conditioned GPs of the last ask; a cache that can be rebuilt.
    """

    x: np.ndarray
    u: np.ndarray
    y: np.ndarray
    status: np.ndarray
    clipped: np.ndarray
    pending: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    space: Any = None
    space_at: int = 0
    surrogate: Surrogate | None = None
    posterior: Any = None

    @property
    def n(self) -> int:
        """Complete evaluations per seed."""
        return self.y.shape[1]


TrainSpace = Callable[[SearchConfig, Any, np.ndarray, np.ndarray], Any]
"""`(config, keys [S], x [S, n, D], y [S, n]) -> space`, stacked over the seeds."""


def init(config: SearchConfig) -> SearchState:
    """An empty history.

    Returns:
        SearchState without evaluations, one row per seed.
    """
    s, dim = len(config.seeds), config.task.dim
    empty = np.zeros((s, 0))
    return SearchState(
        np.zeros((s, 0, dim)), np.zeros((s, 0, 0)), empty, empty.astype(np.int64), empty
    )


def best_so_far(y: np.ndarray) -> np.ndarray:
    """Running worst case `[S, n]`; -inf before the first valid evaluation.

    Returns:
        `[S, n]`, never falling along the evaluations.

    Example:
        >>> best_so_far(np.array([[1.0, 3.0, 2.0]])).tolist()
        [[1.0, 3.0, 3.0]]
    """
    return np.maximum.accumulate(np.where(np.isfinite(y), y, -np.inf), axis=1)


def first_hit(y: np.ndarray, threshold: float) -> np.ndarray:
    """Simulations up to and with the first failure (`y > threshold`) per seed, NaN for none.

    Returns:
        `[S]` counts as floats.

    Raises:
        ValueError: the threshold is NaN, which nothing exceeds.

    Example:
        >>> first_hit(np.array([[0.0, 2.0, 3.0], [0.0, 0.0, 1.0]]), 1.5).tolist()
        [2.0, nan]
        >>> first_hit(np.empty((2, 0)), 1.5).tolist()  # nothing simulated yet
        [nan, nan]
    """
    if np.isnan(threshold):
        raise ValueError(f"threshold={threshold}: expected a number")
    # A column behind all, which always counts: there may be no simulation yet.
    failed = np.concatenate([y > threshold, np.ones((len(y), 1), bool)], axis=1)
    first = failed.argmax(1)
    return np.where(first < y.shape[1], first + 1.0, np.nan)


def seed_keys(config: SearchConfig, n: int) -> Any:
    """One key per seed for the iteration that follows `n` evaluations."""
    keys = [jax.random.fold_in(jax.random.key(seed), n) for seed in config.seeds]
    return jnp.stack(keys)


def stack(tree: Any, count: int) -> Any:
    """The same tree for every seed."""
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * count), tree)
