"""The named methods, and what a search is: task, method, seeds, budget."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from failure.models.acquisition import AcquisitionConfig
from failure.models.kernels import GPConfig
from failure.search.task import Task
from failure.search.turbo import TurboConfig


@dataclass(frozen=True)
class Method:
    """A named combination: search space, acquisition, batch, trust region; or a baseline."""

    space: str
    acquisition: str = "log_ei"
    batch_size: int = 1
    kernel: str = "matern52"
    trust_region: bool = False
    label: str = ""

    @property
    def surrogate(self) -> bool:
        """Whether there is a Gaussian process at all."""
        return self.space != "none"

    @property
    def reduced(self) -> bool:
        """Whether the search space has fewer dimensions than the task."""
        return self.space in ("random", "zeros", "bnn", "active", "level")

    @property
    def learned(self) -> bool:
        """Whether the search space is made from evaluations."""
        return self.space in ("zeros", "bnn", "active", "level")

    @property
    def needs_gradient(self) -> bool:
        """Whether the search space cannot be made from values alone."""
        return self.space == "level"


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
    "active_subspace": Method("active", label="active subspace"),
    "level_sets": Method("level", label="level sets"),
}
"""Name -> method; what `SearchConfig.method` takes."""

BY_VALUES = tuple(name for name, method in METHODS.items() if not method.needs_gradient)
"""Methods for any simulator."""


@dataclass(frozen=True)
class SearchConfig:
    """What defines a search: task, method, seeds and budget (50 + 250, as in the source).

    A field that is None takes the method's own choice, which then stands in the field. A given
    value is used; where it contradicts the method, or the method has no use for it, it is refused.

    Attributes:
        task: where to look.
        method: a key of `METHODS`.
        seeds: one search each, side by side.
        n_init: evaluations of the initial design.
        n_total: evaluations in all.
        embedding_dim: dimensions of a reduced space.
        retrain_every: evaluations between trainings of a learned space (0: once, on the initial
            ones); all of them count towards the budget.
        refit_every: evaluations between fits of the hyper-parameters once there are more than
            `2 n_init`; in between points are appended to the factorisation. Without a number 2,
            and from 384 points on one in 128 of them.
        gp: surrogate.
        acquisition: acquisition function and batch.
        turbo: trust region of `turbo`.
        rev_argate: RevArgateConfig of the Rev-ARGate methods.
        rev_argate_training: RevArgateTrainParams of the Rev-ARGate methods.

    Raises:
        ValueError: an unknown method, an impossible budget, a value that the method cannot use.

    Example:
        >>> config = SearchConfig(Task("box", 3.0, 60), "full", gp=GPConfig(kernel="rbf"))
        >>> config.gp.kernel, config.acquisition.name
        ('rbf', 'log_ei')
    """

    task: Task
    method: str = "full"
    seeds: tuple[int, ...] = (0,)
    n_init: int = 50
    n_total: int = 300
    embedding_dim: int | None = None
    retrain_every: int | None = None
    refit_every: int | None = None
    gp: GPConfig | None = None
    acquisition: AcquisitionConfig | None = None
    turbo: TurboConfig | None = None
    rev_argate: Any = None
    rev_argate_training: Any = None

    def __post_init__(self) -> None:
        """Refuse what cannot be; complete the method's choices."""
        if self.method not in METHODS:
            raise ValueError(
                f"method={self.method!r}: expected one of the known methods: {', '.join(METHODS)}"
            )
        if not 2 <= self.n_init <= self.n_total:
            raise ValueError(
                f"n_init={self.n_init}, n_total={self.n_total}: expected 2 <= n_init <= n_total"
            )
        if len(self.seeds) == 0 or len(set(self.seeds)) != len(self.seeds):
            raise ValueError(f"seeds={self.seeds}: expected at least one, all different")
        method = METHODS[self.method]
        self._refuse_unused(method)
        if self.rev_argate_training is not None:
            self.rev_argate_training.check()
        if method.surrogate:
            self._complete_surrogate(method)
        if method.reduced:
            self._complete_space(method)

    def _set(self, name: str, value: Any) -> None:
        # Frozen: the resolved choices replace the missing ones once, here.
        object.__setattr__(self, name, value)

    def _refuse_unused(self, method: Method) -> None:
        """A given value that the method never reads is a mistake, not a wish."""
        used = {
            "gp": method.surrogate,
            "acquisition": method.surrogate,
            "refit_every": method.surrogate,
            "turbo": method.trust_region,
            "embedding_dim": method.reduced,
            "retrain_every": method.learned,
            "rev_argate": method.space in ("zeros", "bnn"),
            "rev_argate_training": method.space in ("zeros", "bnn"),
        }
        for name, reads in used.items():
            value = getattr(self, name)
            if value is not None and not reads:
                raise ValueError(
                    f"{name}={value!r}: expected nothing with method {self.method!r}, which has "
                    "no use for it; leave it out or choose another method"
                )

    def _complete_surrogate(self, method: Method) -> None:
        if self.gp is None:
            self._set("gp", GPConfig(kernel=method.kernel))
        elif method.kernel != "matern52" and self.gp.kernel != method.kernel:
            raise ValueError(
                f"gp.kernel={self.gp.kernel!r}: expected {method.kernel!r} with method "
                f"{self.method!r}; use method 'full' for other kernels"
            )
        if self.acquisition is None:
            own = AcquisitionConfig(name=method.acquisition, batch_size=method.batch_size)
            self._set("acquisition", own)
        elif method.acquisition != "log_ei" and self.acquisition.name != method.acquisition:
            raise ValueError(
                f"acquisition.name={self.acquisition.name!r}: expected {method.acquisition!r} "
                f"with method {self.method!r}; use method 'full' for other acquisitions"
            )
        if self.refit_every is not None and self.refit_every < 1:
            raise ValueError(f"refit_every={self.refit_every}: expected at least 1")
        if method.trust_region and self.turbo is None:
            self._set("turbo", TurboConfig())

    def _complete_space(self, method: Method) -> None:
        dim, most = self.embedding_dim, self.task.dim
        if dim is None:
            # 22 of 60 in the source; of gradients four directions carry nearly all.
            own = {"active": min(4, most), "level": min(2, most)}
            dim = own.get(method.space, max(1, round(0.37 * most)))
            self._set("embedding_dim", dim)
        if not 1 <= dim <= most:
            raise ValueError(f"embedding_dim={dim}: expected 1 ... {most}")
        if method.learned and self.retrain_every is None:
            self._set("retrain_every", {"active": 10, "level": 3}.get(method.space, 50))
        elif method.learned and self.retrain_every is not None and self.retrain_every < 0:
            raise ValueError(
                f"retrain_every={self.retrain_every}: expected at least 0 (0: train once)"
            )
