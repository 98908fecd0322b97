"""Importance sampling on a Gaussian process that is refined where the probability is undecided."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from failure.descents import Descent, by_gradients, by_values
from failure.estimates import GOOD, Estimate, check_threshold, mean_of_terms
from failure.models.emulator import Emulator
from failure.opposite import OPPOSITE, opposite_sides_fail
from failure.performances import Counted, Performance, Slopes

BAND = 2.0
"""Half width of the emulator's band in its own standard deviations."""


class AKResult(NamedTuple):
    """Result of `ak_sampling`.

    Attributes:
        estimate: its `n_simulations` is everything spent.
        point: `[D]`, about which the population was drawn.
        first_failure: evaluations up to the first failing one, NaN.
        n_gradients: evaluations with a gradient among all.
    """

    estimate: Estimate
    point: Float[np.ndarray, " D"]
    first_failure: float
    n_gradients: int


def ak_sampling(
    performance: Performance,
    threshold: float,
    dim: int,
    *,
    key: Key[Array, ""],
    slopes: Slopes | None = None,
    directions: int = 4,
    population: int = 4000,
    start: int = 8,
    batch: int = 2,
    factor: float = 2.0,
    most: int = 300,
) -> AKResult:
    r"""Failure probability by an emulator that is asked where it matters, until it is sure enough.

    From the design point :math:`u^*` a population :math:`x_i \sim N(u^*, I)` with weights
    :math:`w_i = \phi(x_i) / \phi(x_i - u^*)` is drawn once. The emulator's mean, deviation and
    noise give

    .. math:: \hat p_\pm = \frac1N \sum_i w_i\,
        \Phi\!\Big(\frac{\mu(x_i) \pm 2 s(x_i) - T}{\sigma}\Big)

    and the next simulation is the member of the population whose term differs most between the
    two. It stops when :math:`\hat p_+` and :math:`\hat p_-` lie within the square root of `factor`
    of the estimate, twice running. With gradients the emulator sees the leading directions of the
    gradients only, and what the others do is its noise; without, all parameters.

    The verdict is not "good" when the budget ends first, when simulations have come out far from
    what was predicted for them, when the design point was not reached, and when the side opposite
    to it fails as well.

    Args:
        performance: `x [n, D] -> y [n]`, larger is worse.
        threshold: failure is `y > threshold`.
        dim: D.
        key: random key.
        slopes: `x [n, D] -> (y [n], dy/dx [n, D])`; every simulation then comes with its gradient.
        directions: of the gradients, beside that of the design point.
        population: N.
        start: members simulated before the first fit.
        batch: simulations between two fits.
        factor: wanted half width of the interval, as a ratio.
        most: simulations at most.

    Returns:
        AKResult. Further regions are not looked for.

    Raises:
        ValueError: a threshold that is not finite, a factor not above 1.

    Source: Echard, Gayton and Lemaire (2011, 2013), AK-MCS and AK-IS. Deviation: weights enter the
    choice, and the stopping rule bounds the probability's error, not the least :math:`|\mu - T|/s`
    of the population, which spends simulations on members that do not count.
    """
    check_threshold(threshold)
    if not factor > 1.0:
        raise ValueError(f"factor={factor}: expected a ratio above 1")
    counted = Counted(performance, slopes)
    descent = Descent(counted, float(threshold), 0.5, math.inf)
    u, gradients, reached = _centre(descent, dim)
    if not reached:
        spent = counted.n_values + counted.n_gradients
        why = "the threshold is not reached from nominal; start from failures that a search found"
        nothing = Estimate(math.nan, 0.0, 1.0, spent, counted.n_invalid, 0.0, why)
        return AKResult(nothing, u, descent.first, counted.n_gradients)
    with jax.enable_x64(True):
        x = u + np.asarray(jax.random.normal(key, (population, dim)))
    weights = np.exp(0.5 * float(u @ u) - x @ u)
    asked = np.zeros(population, bool)
    surprises: list[float] = []

    def simulate(rows: np.ndarray) -> np.ndarray:
        asked[rows] = True
        if slopes is None:
            return counted(x[rows])
        y, g = counted.slopes(x[rows])
        gradients.extend(g[np.all(np.isfinite(g), axis=1)])
        return y

    simulate(np.arange(start))
    sure, mean, lower, upper, effective = 0, math.nan, 0.0, 1.0, 0.0
    while True:
        basis = np.eye(dim) if slopes is None else _basis(u, gradients, directions)
        emulator = Emulator(counted.samples()[0] @ basis, counted.samples()[1])
        terms, low, high, mu, sd = _terms(emulator, x @ basis, weights, threshold)
        mean, lower, upper, effective = mean_of_terms(terms)
        if mean > 0.0:
            # The interval holds what the emulator and what the population leave open.
            below, above = max(float(low.mean()), 1e-300) / mean, float(high.mean()) / mean
            lower, upper = lower * below, min(1.0, upper * above)
            root = math.sqrt(factor)
            sure = sure + 1 if below >= 1.0 / root and above <= root else 0
        spent = counted.n_values + counted.n_gradients
        if sure >= 2 or spent + batch > most:
            break
        score = np.where(asked, -1.0, high - low)
        rows = np.argsort(-score)[:batch]
        y = simulate(rows)
        total = np.sqrt(sd[rows] ** 2 + emulator.noise**2)
        surprises += (np.abs(y - mu[rows]) / total)[np.isfinite(y)].tolist()
    reasons = []
    if sure < 2:
        reasons.append(f"the emulator is not sure after {spent} simulations; raise most")
    late = np.array(surprises[-20:])
    if len(late) and float(np.sqrt(np.mean(late**2))) > 3.0:
        reasons.append(
            f"simulations come out {np.sqrt(np.mean(late**2)):.1f} deviations from what was "
            "predicted: the emulator is wrong about its error; use line_sampling"
        )
        lower, upper = 0.0, 1.0
    length = float(np.linalg.norm(u))
    if opposite_sides_fail(performance, threshold, u[None] / length, np.array([length]))[0]:
        reasons.append(OPPOSITE)
        upper = 1.0
    spent += 1
    if effective < 10.0:
        reasons.append(f"only {effective:.1f} effective members of the population")
        lower, upper = 0.0, 1.0
    samples = np.nan_to_num(counted.samples()[1], nan=-np.inf)
    failed = np.flatnonzero(samples > threshold)
    first = float(failed[0] + 1) if failed.size else math.nan
    estimate = Estimate(
        mean, lower, upper, spent, counted.n_invalid, effective, "; ".join(reasons) or GOOD
    )
    return AKResult(estimate, u, first, counted.n_gradients)


def _centre(descent: Descent, dim: int) -> tuple[np.ndarray, list[np.ndarray], bool]:
    """The design point as steps from nominal reach it; gradients on the way; whether it is one."""
    origin = np.zeros(dim)
    y, g = descent.both(origin)
    descent.nominal = y
    if not (y < descent.threshold and np.any(g)):
        return origin, [], False
    steps = by_gradients if descent.counted.has_slopes else by_values
    u, y, g = steps(descent, origin, y, np.nan_to_num(g), 15)
    return u, [g], abs(y - descent.threshold) <= 0.1 * descent.scale()


def _basis(u: np.ndarray, gradients: list[np.ndarray], count: int) -> np.ndarray:
    """Direction of the design point and the leading ones of the gradients, orthonormal columns."""
    rows = np.stack(gradients)
    _, _, axes = np.linalg.svd(rows / np.abs(rows).max(), full_matrices=False)
    return np.linalg.qr(np.concatenate([u[:, None], axes[:count].T], axis=1))[0]


def _terms(
    emulator: Emulator, z: np.ndarray, weights: np.ndarray, threshold: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Weighted failure probability of every member, its band, the emulator's mean and deviation."""
    from scipy.special import ndtr

    mu, sd = emulator.predict(z)
    noise = emulator.noise
    middle = weights * ndtr((mu - threshold) / np.sqrt(sd**2 + noise**2))
    low = weights * ndtr((mu - BAND * sd - threshold) / noise)
    high = weights * ndtr((mu + BAND * sd - threshold) / noise)
    return middle, low, high, mu, sd
