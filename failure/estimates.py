"""Failure probabilities that say when they are not to be trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

GOOD = "good"
"""The verdict of an estimate that passed all its checks."""


class Estimate(NamedTuple):
    """A failure probability.

    Attributes:
        probability: point estimate; NaN where nothing is known.
        lower: lower end of the 95 % interval.
        upper: upper end. An estimate with another verdict than "good" has an interval that is
            widened to what is certain, up to [0, 1].
        n_simulations: simulator calls it cost, those of the design points not included.
        n_invalid: calls without a finite output.
        n_effective: effective number of failing samples (failures for Monte Carlo; replicates
            for subset simulation).
        verdict: "good", or what stands against the estimate and what to do.

    Example:
        >>> Estimate(1e-3, 8e-4, 1.2e-3, 5000, 0, 210.0).verdict
        'good'
    """

    probability: float
    lower: float
    upper: float
    n_simulations: int
    n_invalid: int
    n_effective: float
    verdict: str = GOOD

    @property
    def known(self) -> bool:
        """Whether all checks were passed."""
        return self.verdict == GOOD


def check_threshold(threshold: float) -> None:
    """Refuse a threshold that nothing can exceed or fall short of.

    Raises:
        ValueError: it is not finite.
    """
    if not math.isfinite(threshold):
        raise ValueError(f"threshold={threshold}: expected a finite number")


def clopper_pearson(hits: int, n: int) -> tuple[float, float]:
    """Exact 95 % interval of a share.

    Source: Clopper and Pearson (1934).

    Example:
        >>> low, high = clopper_pearson(0, 1000)
        >>> low, round(high, 5)
        (0.0, 0.00368)
    """
    from scipy.stats import beta

    if n <= 0:
        return 0.0, 1.0
    lower = float(beta.ppf(0.025, hits, n - hits + 1)) if hits else 0.0
    upper = float(beta.ppf(0.975, hits + 1, n - hits)) if hits < n else 1.0
    return lower, upper


def log_normal_interval(mean: float, error: float, factor: float) -> tuple[float, float]:
    """Interval of a positive estimate with standard error `error`, symmetric in its logarithm."""
    spread = factor * math.sqrt(math.log1p((error / mean) ** 2))
    return mean * math.exp(-spread), min(1.0, mean * math.exp(spread))


def mean_of_terms(terms: np.ndarray) -> tuple[float, float, float, float]:
    r"""Mean of terms of at least 0 with its 95 % interval, and their effective number.

    .. math:: n_{eff} = \Big(\sum_i t_i\Big)^2 \Big/ \sum_i t_i^2

    Student's t with :math:`n_{eff} - 1` degrees of freedom, on the log-normal scale.

    Returns:
        `(mean, lower, upper, n_eff)`; zeros where all terms are zero.
    """
    from scipy.stats import t as student

    terms = np.asarray(terms, np.float64)
    mean = float(terms.mean())
    if mean <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    scaled = terms / terms.max()
    effective = float(scaled.sum() ** 2 / (scaled**2).sum())
    error = mean * float(scaled.std(ddof=1) / scaled.mean()) / math.sqrt(len(terms))
    factor = float(student.ppf(0.975, max(effective - 1.0, 1.0)))
    return mean, *log_normal_interval(mean, error, factor), effective


def add(parts: Sequence[Estimate]) -> Estimate:
    r"""Estimates of regions apart from one another as one: the sum, an upper bound of the union.

    .. math:: \hat p = \sum_k \hat p_k

    Half widths on the logarithmic scale add up as the standard errors of independent terms.

    Source: Ditlevsen (1979) for the bound, which overlaps of rare regions hardly lower.

    Example:
        >>> add([Estimate(1e-6, 5e-7, 2e-6, 9, 0, 9.0), Estimate(3e-6, 2e-6, 4e-6, 9, 0, 9.0)])[0]
        4e-06
    """
    p = np.array([e.probability for e in parts])
    total = float(np.nansum(p))
    logs = [math.log(max(e.upper, 1e-300) / max(e.probability, 1e-300)) for e in parts]
    error = math.sqrt(sum((q * w) ** 2 for q, w in zip(p, logs, strict=True)))
    reasons = [
        f"region {k + 1}: {e.verdict}" if len(parts) > 1 else e.verdict
        for k, e in enumerate(parts)
        if not e.known
    ]
    if len(reasons) > 2:
        reasons[1:] = [f"{len(reasons) - 1} further regions are in doubt, too"]
    if total > 0.0 and not reasons:
        lower, upper = log_normal_interval(total, error, 1.0)
        lower, upper = min(lower, total / 1.01), max(upper, min(1.0, 1.01 * total))
    else:
        lower = max((e.lower for e in parts), default=0.0)
        upper = min(1.0, sum(e.upper for e in parts))
    cost, invalid = sum(e.n_simulations for e in parts), sum(e.n_invalid for e in parts)
    effective = min((e.n_effective for e in parts), default=0.0)
    return Estimate(total, lower, upper, cost, invalid, effective, "; ".join(reasons) or GOOD)


def combine(first: Estimate, second: Estimate) -> Estimate:
    """Two independent estimates as one: the narrower one where they agree, both where not.

    They agree when the intervals overlap. If they do not, the interval spans both, and the
    verdict says so: one of them has missed a region, or is wrong about its own error.

    Example:
        >>> a = Estimate(1e-6, 5e-7, 2e-6, 1000, 0, 50.0)
        >>> b = Estimate(1e-8, 5e-9, 2e-8, 1000, 0, 50.0)
        >>> combine(a, b)[1:3], combine(a, b).known
        ((5e-09, 2e-06), False)
    """
    cost = first.n_simulations + second.n_simulations
    invalid = first.n_invalid + second.n_invalid
    known = [e for e in (first, second) if e.known]
    overlap = first.lower <= second.upper and second.lower <= first.upper
    if overlap and known:
        best = min(known, key=lambda e: math.log(e.upper / max(e.lower, 1e-300)))
        return best._replace(n_simulations=cost, n_invalid=invalid)
    larger = max(first, second, key=lambda e: np.nan_to_num(e.probability, nan=-1.0))
    reasons = [e.verdict for e in (first, second) if not e.known]
    if not overlap:
        reasons.insert(
            0,
            f"two estimates disagree, {first.probability:.2g} and {second.probability:.2g}: one "
            "has missed a region; look for further failures and start design points from them",
        )
    return larger._replace(
        lower=min(first.lower, second.lower),
        upper=max(first.upper, second.upper),
        n_simulations=cost,
        n_invalid=invalid,
        verdict="; ".join(reasons),
    )
