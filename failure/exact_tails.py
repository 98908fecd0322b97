"""Probabilities in closed form or by one quadrature, for the problems whose answer is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np


def orthonormal(dim: int, count: int) -> np.ndarray:
    """Orthonormal directions that load all parameters, `[count, D]`."""
    draws = np.random.default_rng(dim).normal(size=(dim, count))
    return np.linalg.qr(draws)[0].T


def beta_of(p: float) -> float:
    """Distance of the half space of this probability."""
    from scipy.stats import norm

    return float(norm.isf(p))


def tail(t: Any) -> Any:
    """Probability of the half space at this distance."""
    from scipy.stats import norm

    return norm.sf(t)


def quadratic_tail(t: float, bend: float, count: int) -> float:
    """P(z + bend chi2_count > t) for independent standard normal z."""
    from scipy import integrate
    from scipy.stats import chi2

    # In the normal's own coordinate the integrand of chi2_1 is smooth at 0.
    if count == 1:
        f = lambda v: 2.0 * float(tail(t - bend * v * v)) * math.exp(-0.5 * v * v)  # noqa: E731
        peak = math.sqrt(max(0.0, (t - 0.5 / bend) / bend)) if bend > 0 else 0.0
        whole = integrate.quad(f, 0.0, 40.0, points=[peak, 3.0], epsabs=0.0, epsrel=1e-9, limit=400)
        return float(whole[0] / math.sqrt(2.0 * math.pi))
    f = lambda s: float(tail(t - bend * s) * chi2.pdf(s, count))  # noqa: E731
    return float(
        integrate.quad(f, 0.0, 400.0, points=[10.0, 60.0], epsabs=0.0, epsrel=1e-9, limit=400)[0]
    )


def threshold_of(probability: Callable[[float], float], p: float) -> float:
    """The threshold with this probability."""
    from scipy.optimize import brentq

    return float(brentq(lambda t: math.log(probability(t) / p), 0.5, 40.0, xtol=1e-12))
