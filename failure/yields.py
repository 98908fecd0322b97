"""Failure probabilities of several specifications and the yield over all, with what is not known.

Each failure region (`failure.worst_case`) is measured by line sampling; a mixture of normals about
all regions, with a nominal and a wide part, measures them a second time, gives the overlap of the
specifications and looks for regions that nobody knew of.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from failure.worst_case import Archive, Region


class SpecYield(NamedTuple):
    """A failure probability with a 95 % interval, or what is known in its place.

    Attributes:
        probability: point estimate; NaN where no failure was seen.
        lower: lower end.
        upper: upper end; without a failure the bound that the nominal samples give.
        n: lines or samples behind it.
        verdict: "good", or what stands against it.
    """

    probability: float
    lower: float
    upper: float
    n: int
    verdict: str


def normal_draws(count: int, dim: int, *, key: Key[Array, ""]) -> Float[np.ndarray, "n d"]:
    """Normal samples `[n, d]` on the host; a longer draw begins with the shorter one."""
    words = np.asarray(jax.random.key_data(key)).astype(np.uint64).ravel()
    return np.random.Generator(np.random.Philox(words)).standard_normal((count, dim))


def interval(terms: Float[np.ndarray, "n"]) -> tuple[float, float, float, str]:
    """Mean of positive terms, log-normal 95 % interval, verdict."""
    from scipy.stats import t as student

    n, mean = len(terms), float(terms.sum()) / max(len(terms), 1)
    if n < 2 or mean <= 0.0:
        return float("nan"), 0.0, 1.0, "no failing sample"
    error = float(terms.std(ddof=1)) / math.sqrt(n)
    effective = float(terms.sum() ** 2 / (terms**2).sum())
    factor = float(student.ppf(0.975, max(min(n - 1, effective), 1.0)))
    # Never below half a percent: that is what the secants of the lines may be off.
    spread = max(math.sqrt(math.log1p((error / mean) ** 2)), 2.5e-3)
    verdict = "good" if effective >= 10.0 else f"only {effective:.1f} effective samples"
    width = math.exp(factor * spread)
    return mean, mean / width, min(mean * width, 1.0), verdict


def line_sampling(
    archive: Archive,
    region: Region,
    lines: int,
    *,
    reach: float = 8.0,
    key: Key[Array, ""],
) -> tuple[SpecYield, Float[np.ndarray, "n"]]:
    r"""Probability of one region by lines parallel to its worst-case direction a.

    .. math:: p = \frac1n \sum_i \Phi(-t_i), \qquad g(v_i + t_i a) = 0

    with :math:`v_i` normal in the plane across a. Two simulations per line: one at the worst-case
    distance, one where the slope says the limit is; a third where these disagree.

    Args:
        archive: evaluates.
        region: its point and slope.
        lines: n.
        reach: a line without a failure up to here plus 2 counts as 0 [sigma].
        key: random key.

    Returns:
        (estimate, :math:`\Phi(-t_i)` of every line).

    Source: Koutsourelakis, Pradlwarter and Schueller (2004).
    """
    from scipy.special import ndtr

    a = region.point / max(region.distance, 1e-300)
    v = normal_draws(lines, len(a), key=key)
    v = v - (v @ a)[:, None] * a
    rate = max(float(region.slope @ a), 1e-12)

    def at(t: np.ndarray, rows: np.ndarray) -> np.ndarray:
        g = archive(v[rows] + t[:, None] * a, "line")[:, region.spec]
        return np.nan_to_num(g, nan=-1.0)

    every = np.arange(lines)
    most = reach + 2.0
    t0 = np.full(lines, region.distance)
    g0 = at(t0, every)
    t1 = np.clip(t0 - g0 / rate, -most, most)
    same = np.abs(t1 - t0) < 1e-3
    t1 = np.where(same, t0 + 0.1, t1)
    g1 = at(t1, every)
    t2 = _secant(t0, g0, t1, g1, rate, most)
    rows = np.flatnonzero((np.abs(t2 - t1) > 0.25) & (np.abs(t2) < most))
    if rows.size and rows.size <= archive.left:
        g2 = at(t2[rows], rows)
        near = np.abs(g1[rows]) < np.abs(g0[rows])
        ta, ga = np.where(near, t1[rows], t0[rows]), np.where(near, g1[rows], g0[rows])
        t2[rows] = _secant(ta, ga, t2[rows], g2, rate, most)
    terms = np.where(t2 >= most, 0.0, ndtr(-t2))
    mean, lower, upper, verdict = interval(terms)
    if not region.converged:
        verdict = "its worst-case point is not verified"
    return SpecYield(mean, lower, upper, lines, verdict), terms


def _secant(
    t0: np.ndarray, g0: np.ndarray, t1: np.ndarray, g1: np.ndarray, rate: float, most: float
) -> np.ndarray:
    """Where the line through two values meets 0; by the region's slope where it does not rise."""
    slope = (g1 - g0) / np.where(t1 == t0, 1.0, t1 - t0)
    slope = np.where(slope > 0.05 * rate, slope, rate)
    return np.clip(t1 - g1 / slope, -most, most)


class Mixture(NamedTuple):
    """What the mixture of normals says.

    Attributes:
        specs: estimate of each specification.
        union: of failing any.
        overlap: probability of failing any over the sum of all.
    """

    specs: list[SpecYield]
    union: SpecYield
    overlap: float


def mixture_sampling(
    archive: Archive,
    regions: Sequence[Region],
    n: int,
    n_specs: int,
    *,
    wide: float = 0.1,
    nominal: float = 0.1,
    key: Key[Array, ""],
) -> Mixture:
    r"""Importance sampling from normals about all regions, of all specifications at once.

    .. math:: q = \alpha N(0, I) + \gamma N(0, s^2 I) + \tfrac{1 - \alpha - \gamma}{R} \sum_r
        N(u_r, I), \qquad \hat p_k = \tfrac1n \sum_i \tfrac{\phi(x_i)}{q(x_i)} 1[g_k(x_i) > 0]

    Args:
        archive: evaluates.
        regions: known ones; without any the wide and the nominal part alone look for failures.
        n: samples.
        n_specs: number of specifications.
        wide: share :math:`\gamma` of the wide part, s such that its radius is that of the regions.
        nominal: share :math:`\alpha`.
        key: random key.

    Source: Hesterberg (1995) for the defensive mixture.
    """
    dim = archive.x.shape[1]
    centres = np.array([r.point for r in regions]).reshape(len(regions), dim)
    radius = float(np.median(np.linalg.norm(centres, axis=1))) if len(centres) else 4.0
    s = float(np.clip(radius / math.sqrt(dim), 1.2, 3.0))
    rest = 1.0 - nominal - wide
    if len(centres):
        shares = np.array([nominal, wide, *[rest / len(centres)] * len(centres)])
    else:
        shares = np.array([0.3, 0.7])
    # The first coordinate picks the part, so that more samples keep the earlier ones.
    draws = normal_draws(n, dim + 1, key=key)
    from scipy.special import ndtr

    pick = np.searchsorted(np.cumsum(shares), ndtr(draws[:, 0]) * (1.0 - 1e-12))
    shift = np.concatenate([np.zeros((2, dim)), centres])[pick]
    scale = np.where(pick == 1, s, 1.0)[:, None]
    x = shift + scale * draws[:, 1:]
    g = archive(x, "mixture")
    log_phi = -0.5 * np.sum(x**2, 1)
    parts = [np.log(shares[0]) + log_phi]
    parts.append(np.log(shares[1]) + log_phi / s**2 - dim * math.log(s))
    for share, centre in zip(shares[2:], centres, strict=True):
        parts.append(np.log(share) - 0.5 * np.sum((x - centre) ** 2, 1))
    log_q = np.logaddexp.reduce(np.array(parts), axis=0)
    weights = np.exp(log_phi - log_q)
    fails = g > 0.0

    def estimate(hit: np.ndarray) -> SpecYield:
        mean, lower, upper, verdict = interval(weights * hit)
        if math.isnan(mean):
            # Rule of three over what the nominal part stands for.
            upper = min(1.0, 3.0 / max(float(weights.sum()), 1.0))
        return SpecYield(mean, lower, upper, n, verdict)

    specs = [estimate(fails[:, k]) for k in range(n_specs)]
    union = estimate(np.asarray(fails.any(1)))
    total = sum(p.probability for p in specs if not math.isnan(p.probability))
    overlap = union.probability / total if total > 0.0 else 1.0
    return Mixture(specs, union, overlap)
