"""A mixture of normals about all failure regions, with a nominal and a wide part.

Beside line sampling it measures the regions a second time, gives the overlap of the specifications
and looks for regions that nobody knew of.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from failure.archive import Archive
from failure.estimates import GOOD, Estimate, mean_of_terms
from failure.worst_case import Region


def normal_draws(count: int, dim: int, *, key: Key[Array, ""]) -> Float[np.ndarray, "n d"]:
    """Normal samples `[n, d]` on the host; a longer draw begins with the shorter one."""
    words = np.asarray(jax.random.key_data(key)).astype(np.uint64).ravel()
    return np.random.Generator(np.random.Philox(words)).standard_normal((count, dim))


class Mixture(NamedTuple):
    """What the mixture of normals says.

    Attributes:
        specs: estimate of each specification.
        union: of failing any.
        overlap: probability of failing any over the sum of all.
    """

    specs: list[Estimate]
    union: Estimate
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

    def estimate(hit: np.ndarray) -> Estimate:
        if n < 2 or not hit.any():
            # Rule of three over what the nominal part stands for.
            upper = min(1.0, 3.0 / max(float(weights.sum()), 1.0))
            return Estimate(math.nan, 0.0, upper, n, 0, 0.0, "no failing sample")
        mean, lower, upper, effective = mean_of_terms(weights * hit)
        verdict = GOOD if effective >= 10.0 else f"only {effective:.1f} effective samples"
        return Estimate(mean, lower, upper, n, 0, effective, verdict)

    specs = [estimate(fails[:, k]) for k in range(n_specs)]
    union = estimate(np.asarray(fails.any(1)))
    total = sum(p.probability for p in specs if not math.isnan(p.probability))
    overlap = union.probability / total if total > 0.0 else 1.0
    return Mixture(specs, union, overlap)
