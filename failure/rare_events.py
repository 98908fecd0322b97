"""How likely a failure is: Monte Carlo, subset simulation, importance and line sampling.

Parameters are independent standard normal (units of sigma); a sample fails when its output is
above the threshold. Outputs that are not finite are invalid: they count as no failure, and their
number is reported. Every estimate carries a verdict; one that is not "good" says what stands
against it and has an interval widened to what is certain.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from failure.estimates import (
    GOOD,
    Estimate,
    check_threshold,
    clopper_pearson,
    combine,
    mean_of_terms,
)
from failure.form import design_points, merge_points
from failure.hlrf import DesignPoint, find_design_point
from failure.lines import line_sampling
from failure.opposite import check_scan, opposite_sides_fail, strangers_found, wide_strangers
from failure.performances import Performance, check_rows
from failure.subset import subset_simulation

ALIKE = 0.9
"""Points with a larger cosine stand for one region."""

__all__ = [
    "DesignPoint",
    "Estimate",
    "combine",
    "design_points",
    "find_design_point",
    "importance_sampling",
    "line_sampling",
    "merge_points",
    "monte_carlo",
    "subset_simulation",
]


def monte_carlo(
    performance: Performance,
    threshold: float,
    dim: int,
    *,
    key: Key[Array, ""],
    n: int = 10_000,
    batch: int = 10_000,
) -> Estimate:
    """Share of failures among `n` draws, with the exact binomial interval.

    Args:
        performance: `x [m, dim] -> y [m]`.
        threshold: failure is `y > threshold`.
        dim: number of parameters.
        key: random key.
        n: draws.
        batch: draws per call of `performance`.

    Returns:
        Estimate.

    Raises:
        ValueError: a threshold that is not finite; outputs that are not one per draw.

    Source: Clopper and Pearson (1934) for the interval.

    Example:
        >>> import jax
        >>> found = monte_carlo(lambda x: x[:, 0], 2.0, 3, key=jax.random.key(0))
        >>> found.lower < 0.02275 < found.upper
        True
    """
    check_threshold(threshold)
    hits = invalid = 0
    with jax.enable_x64(True):
        for start in range(0, n, batch):
            size = min(batch, n - start)
            x = jax.random.normal(jax.random.fold_in(key, start), (size, dim))
            y = np.asarray(performance(x))
            check_rows(y, x)
            hits += int(np.sum(y > threshold))
            invalid += int(np.sum(~np.isfinite(y)))
    lower, upper = clopper_pearson(hits, n)
    verdict = GOOD
    if invalid:
        # Invalid samples might fail: the upper end leaves room for them.
        upper = clopper_pearson(hits + invalid, n)[1]
    if invalid > 0.05 * n:
        verdict = f"{invalid} of {n} outputs are invalid: they count as no failure"
    p = hits / n if invalid <= 0.5 * n else math.nan
    return Estimate(p, lower, upper, n, invalid, float(hits), verdict)


def importance_sampling(
    performance: Performance,
    threshold: float,
    points: Float[np.ndarray, "k d"],
    *,
    key: Key[Array, ""],
    n: int = 4000,
    defensive: float = 0.1,
    scan: int = 100,
) -> Estimate:
    r"""Sample from normals moved to the failure regions, and weight each sample back.

    .. math:: q = \alpha N(0, I) + \tfrac{1 - \alpha}{K} \sum_k N(\mu_k, I), \qquad
        \hat p = \frac1n \sum_i \frac{\phi(u_i)}{q(u_i)} 1[y(u_i) > T]

    The nominal part bounds every weight by :math:`1 / \alpha`. Regions that no point stands for
    are missed: the interval is that of the regions given. One more simulation for each point looks
    at the opposite side, and `scan` wide samples look beside all of them; where they fail, the
    verdict says so and the upper end is what the nominal draws alone say. With fewer than 10
    effective samples the interval is withheld: its lower end is 0, its upper end the same.

    Args:
        performance: `x [m, D] -> y [m]`.
        threshold: failure is `y > threshold`.
        points: the shifts :math:`\mu_k`, best the most likely point of each region
            (`design_points`).
        key: random key.
        n: samples.
        defensive: :math:`\alpha`.
        scan: wide samples that look for other regions; 0 trusts that the points stand for all.

    Returns:
        Estimate.

    Raises:
        ValueError: no point, or one that is not finite; a threshold that is not finite; a
            nominal share that is not in (0, 1); a scan below 0; outputs that are not one per
            sample.

    Source: Hesterberg (1995) for the defensive mixture; Kahn and Harris (1951).

    Example:
        >>> import jax
        >>> found = importance_sampling(
        ...     lambda x: x[:, 0], 4.0, np.array([[4.0, 0.0]]), key=jax.random.key(0)
        ... )
        >>> found.lower < 3.167e-5 < found.upper, found.verdict
        (True, 'good')
    """
    check_threshold(threshold)
    check_scan(scan)
    if not 0.0 < defensive < 1.0:
        raise ValueError(f"defensive={defensive}: expected a share in (0, 1)")
    centres = np.asarray(points, np.float64)
    if centres.ndim != 2 or len(centres) == 0 or not np.all(np.isfinite(centres)):
        raise ValueError(
            f"points.shape={centres.shape}: expected at least one finite failure point [k, D]"
        )
    k, dim = centres.shape
    with jax.enable_x64(True):
        key_pick, key_noise = jax.random.split(key)
        shifts = jnp.concatenate([jnp.zeros((1, dim)), jnp.asarray(centres)])
        log_share = jnp.log(jnp.asarray([defensive] + [(1.0 - defensive) / k] * k))
        pick = jax.random.categorical(key_pick, log_share, shape=(n,))
        u = shifts[pick] + jax.random.normal(key_noise, (n, dim))
        log_ratio = u @ shifts.T - 0.5 * jnp.sum(shifts**2, 1)[None] + log_share[None]
        weight = np.asarray(jnp.exp(-jax.scipy.special.logsumexp(log_ratio, axis=1)))
        y = np.asarray(performance(u))
    check_rows(y, u)
    failed = y > threshold
    term = weight * failed
    invalid = int(np.sum(~np.isfinite(y)))
    mean, lower, upper, effective = mean_of_terms(term)
    # Exact for any regions: the nominal draws, as plain Monte Carlo.
    nominal = np.asarray(pick) == 0
    certain = clopper_pearson(int(np.sum(failed & nominal)), int(nominal.sum()))[1]
    reasons = []
    if effective < 10.0:
        reasons.append(f"only {effective:.1f} effective samples; raise n or find nearer points")
        lower, upper = 0.0, max(upper, certain)
    if invalid > 0.05 * n:
        # The share counts only where a failure could be: near the points almost everywhere.
        reasons.append(f"{invalid} of {n} outputs are invalid: they count as no failure")
        upper = max(upper, float(np.mean(weight * (failed | ~np.isfinite(y)))))
    further, spent = _further_regions(performance, float(threshold), centres, scan, key)
    if further:
        upper = max(upper, certain)
    verdict = "; ".join([*reasons, *further]) or GOOD
    return Estimate(mean, lower, upper, n + spent, invalid, effective, verdict)


def _further_regions(
    performance: Performance, threshold: float, points: np.ndarray, scan: int, key: Key[Array, ""]
) -> tuple[list[str], int]:
    """What speaks for regions that no point stands for: mirror images and wide samples that fail.

    A mirror image is looked at half a sigma farther out, and counts where it is none of the points.
    The simulations are returned beside the reasons.
    """
    lengths = np.maximum(np.linalg.norm(points, axis=1), 1e-300)
    axes = points / lengths[:, None]
    failing = opposite_sides_fail(performance, threshold, axes, lengths)
    mirrored = int(np.sum(failing & ~np.any(axes @ axes.T < -ALIKE, axis=1)))
    found = []
    if mirrored:
        found.append(
            f"{mirrored} of {len(points)} points fail on the opposite side as well, where none of "
            "them stands: add design points of that side"
        )
    key = jax.random.fold_in(key, 1)
    seen = wide_strangers(performance, threshold, axes, lengths, scan, key=key)
    if seen.strange:
        found.append(strangers_found(seen.strange, scan))
    return found, len(points) + seen.n_simulations
