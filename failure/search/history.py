"""What defines a search, and its history: methods, settings, evaluations, first failures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from failure.models import acquisition, gp
from failure.search import turbo
from failure.search.spaces import Space, Task, task_domain

__all__ = [
    "METHODS",
    "Method",
    "SearchConfig",
    "SearchState",
    "Surrogate",
    "TrainSpace",
    "best_so_far",
    "first_hit",
    "init",
]


@dataclass(frozen=True)
class Method:
    """A named combination: search space, acquisition, batch, trust region; or a baseline."""

    space: str
    acquisition: str = "log_ei"
    batch_size: int = 1
    kernel: str = "matern52"
    trust_region: bool = False
    label: str = ""


METHODS: dict[str, Method] = {
    "monte_carlo": Method("none", label="Monte Carlo"),
    "ridge_corner": Method("none", label="ridge + worst corner"),
    "gradient_corner": Method("none", label="gradient + corner"),
    "pbo": Method("full", "pbo", 5, label="pBO"),
    "hdbo": Method("random", label="HDBO"),
    "full": Method("full", label="full-space GP"),
    "full_linear": Method("full", kernel="linear", label="full-space linear kernel"),
    "turbo": Method("full", trust_region=True, label="TuRBO"),
    "rev_argate_zeros": Method("zeros", label="Rev-ARGate zeros"),
    "rev_argate_bnn": Method("bnn", label="Rev-ARGate BNN"),
}


@dataclass(frozen=True)
class SearchConfig:
    """What defines a search: task, method, seeds and budget (50 + 250, as in the source).

    `refit_every` counts evaluations between fits of the hyper-parameters once there are more
    than `2 n_init` of them; in between points are appended to the factorisation.
    `retrain_every` counts evaluations between trainings of a Rev-ARGate (0: once, on the initial
    ones); all of them count towards the budget. `rev_argate` is its RevArgateConfig, or None.
    """

    task: Task
    method: str = "full"
    seeds: tuple[int, ...] = (0,)
    n_init: int = 50
    n_total: int = 300
    embedding_dim: int | None = None
    retrain_every: int = 50
    refit_every: int = 2
    gp: gp.GPConfig = field(default_factory=gp.GPConfig)
    acquisition: acquisition.AcquisitionConfig = field(
        default_factory=acquisition.AcquisitionConfig
    )
    turbo: turbo.TurboConfig = field(default_factory=turbo.TurboConfig)
    rev_argate: Any = None

    def __post_init__(self) -> None:
        """Refuse unknown methods and impossible budgets; complete the method's choices."""
        if self.method not in METHODS:
            raise ValueError(f"unknown method {self.method!r}; known methods: {', '.join(METHODS)}")
        if not 2 <= self.n_init <= self.n_total:
            raise ValueError(
                f"n_init={self.n_init}, n_total={self.n_total}: expected 2 <= n_init <= n_total"
            )
        if len(self.seeds) == 0 or len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f"seeds={self.seeds}: expected at least one, all different")
        if self.refit_every < 1:
            raise ValueError(f"refit_every={self.refit_every}: expected at least 1")
        task_domain(self.task)
        method = METHODS[self.method]
        dim = self.embedding_dim
        if method.space in ("random", "zeros", "bnn"):
            dim = dim or max(1, round(0.37 * self.task.dim))
            if not 1 <= dim <= self.task.dim:
                raise ValueError(f"embedding_dim={dim}: expected 1 ... {self.task.dim}")
        else:
            dim = None
        # Frozen: the resolved choices replace the given ones once, here.
        object.__setattr__(self, "embedding_dim", dim)
        object.__setattr__(self, "gp", replace(self.gp, kernel=method.kernel))
        object.__setattr__(
            self,
            "acquisition",
            replace(self.acquisition, name=method.acquisition, batch_size=method.batch_size),
        )


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
        status: `[S, n]`; 0 valid.
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


TrainSpace = Callable[[SearchConfig, Any, np.ndarray, np.ndarray], Space]


def init(config: SearchConfig) -> SearchState:
    """An empty history."""
    s, dim = len(config.seeds), config.task.dim
    empty = np.zeros((s, 0))
    return SearchState(
        np.zeros((s, 0, dim)), np.zeros((s, 0, 0)), empty, empty.astype(np.int64), empty
    )


def best_so_far(y: np.ndarray) -> np.ndarray:
    """Running worst case `[S, n]`; -inf before the first valid evaluation."""
    return np.maximum.accumulate(np.where(np.isfinite(y), y, -np.inf), axis=1)


def first_hit(y: np.ndarray, threshold: float) -> np.ndarray:
    """Simulations up to and with the first failure (`y > threshold`) per seed, NaN for none.

    Example:
        >>> first_hit(np.array([[0.0, 2.0, 3.0], [0.0, 0.0, 1.0]]), 1.5).tolist()
        [2.0, nan]
    """
    failed = y > threshold
    return np.where(failed.any(1), failed.argmax(1) + 1.0, np.nan)
