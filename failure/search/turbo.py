"""Trust region of TuRBO: its size and centre as a function of the outputs seen so far."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from failure.models.domains import Domain


@dataclass(frozen=True)
class TurboConfig:
    """Lengths in unit coordinates and tolerances; the values of the source."""

    length_init: float = 0.8
    length_min: float = 0.5**7
    length_max: float = 1.6
    success_tolerance: int = 3
    failure_tolerance: int | None = None

    def __post_init__(self) -> None:
        """Refuse lengths that are out of order and tolerances below one."""
        if not 0.0 < self.length_min <= self.length_init <= self.length_max:
            raise ValueError(
                f"length_init={self.length_init}: expected 0 < length_min={self.length_min} <= "
                f"length_init <= length_max={self.length_max}"
            )
        for name in ("success_tolerance", "failure_tolerance"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name}={value}: expected at least 1")


def region_length(config: TurboConfig, y: np.ndarray, n_init: int, dim: int) -> float:
    """Length of the trust region after the evaluations `y [n]`, replayed from the start.

    Three improvements in a row double it, `max(4, d)` disappointments in a row halve it; below
    the least length it starts again. Replaying makes the region part of the history: nothing has
    to be stored to resume.

    Args:
        config: lengths and tolerances.
        y: outputs in the order of evaluation; invalid ones are NaN and count as disappointments.
        n_init: how many of them are the initial design.
        dim: number of coordinates.

    Source: Eriksson et al. (2019), Section 2 and Appendix. Deviation: at a restart the length is
    reset and the data are kept (300 evaluations in 60 dimensions never get there).

    Example:
        >>> region_length(TurboConfig(), np.array([0.0, 1.0, 2.0, 3.0]), 1, 60)
        1.6
    """
    patience = config.failure_tolerance or max(4, dim)
    length, successes, failures = config.length_init, 0, 0
    first = y[:n_init][np.isfinite(y[:n_init])]
    best = first.max() if first.size else -math.inf
    for value in y[n_init:]:
        # The least gain that counts, as in the source's code, is 0.1 % of the incumbent.
        if value > best + 1e-3 * abs(best) or (not math.isfinite(best) and value > best):
            successes, failures = successes + 1, 0
        else:
            successes, failures = 0, failures + 1
        if value > best:
            best = value
        if successes >= config.success_tolerance:
            length, successes = min(2.0 * length, config.length_max), 0
        elif failures >= patience:
            length, failures = 0.5 * length, 0
        if length < config.length_min:
            length, successes, failures = config.length_init, 0, 0
    return length


def trust_region(
    domain: Domain,
    centre: Float[Array, " d"],
    length: Float[Array, ""],
    log_lengthscale: Float[Array, " d"],
) -> Domain:
    r"""A box around `centre` whose sides follow the lengthscales, volume `length ** d`.

    .. math:: L_k = L\, \ell_k / \big(\textstyle\prod_j \ell_j\big)^{1/d}

    Source: Eriksson et al. (2019), Section 2.
    """
    side = length * jnp.exp(log_lengthscale - jnp.mean(log_lengthscale))
    lower = jnp.clip(centre - side / 2.0, domain.lower, domain.upper)
    upper = jnp.clip(centre + side / 2.0, domain.lower, domain.upper)
    return Domain(lower, upper, domain.radius)
