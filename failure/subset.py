"""Subset simulation: a ladder of easier thresholds, which says when a rung does not hold."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from failure.estimates import (
    GOOD,
    Estimate,
    check_threshold,
    clopper_pearson,
    log_normal_interval,
)
from failure.ladder import LEAST_SEEDS, Replicates, ladder_program
from failure.opposite import wide_scale
from failure.performances import Performance, check_rows, traceable


def _strangers(
    performance: Performance, threshold: float, dim: int, n: int, runs: Replicates, *, key: Array
) -> int:
    """Failing wide samples that lie beside all regions of the ladder; 0 for a few stray ones."""
    found = runs.hits >= LEAST_SEEDS
    if not found.any():
        return 0
    scale = wide_scale(float(np.median(runs.depth[found])))
    x = scale * jax.random.normal(key, (n, dim))
    y = np.asarray(jax.jit(performance)(x))
    check_rows(y, x)
    fails = np.asarray(x)[y > threshold]
    if len(fails) == 0:
        return 0
    norms = np.linalg.norm(runs.centre[found], axis=1, keepdims=True)
    axes = runs.centre[found] / np.maximum(norms, 1e-30)
    # A region is a half space about its mean; half its depth leaves room for its curvature.
    inside = fails @ axes.T >= 0.5 * runs.depth[found][None]
    outside = int(np.sum(~inside.any(1)))
    return outside if outside > max(1.0, 0.1 * len(fails)) else 0


def subset_simulation(
    performance: Performance,
    threshold: float,
    dim: int,
    *,
    key: Key[Array, ""],
    n: int = 1000,
    share: float = 0.1,
    replicates: int = 10,
    max_levels: int = 15,
    explore: int | None = None,
) -> Estimate:
    r"""Probability as a product of conditional ones on a ladder of easier thresholds.

    .. math:: p = \prod_j P(y > b_{j+1} \mid y > b_j), \qquad
        u' = \sqrt{1 - s^2}\, u + s\, \xi

    with the levels :math:`b_j` set so that each factor is about `share` and :math:`u'` the
    conditional moves of the Markov chains. The chains of one run are correlated in ways a formula
    for the error underestimates, so the interval comes from independent replicates (Student's t
    on the log-normal scale).

    The verdict is not "good", and the interval widened, when outputs tie and no rung can be set,
    when chains hardly move, when replicates disagree, when many outputs are invalid, and when wide
    samples fail beside all regions that the ladder has climbed.

    Args:
        performance: `x [m, dim] -> y [m]`, hashable, as functions are: its program is compiled
            once and kept. A numpy function is called back from it.
        threshold: failure is `y > threshold`.
        dim: number of parameters.
        key: random key.
        n: samples per level and replicate.
        share: conditional probability of a level.
        replicates: independent runs, at least 3.
        max_levels: ladder's length at most; `share ** max_levels` is the least probability seen.
        explore: wide samples (`opposite.wide_scale`) that look for regions beside the ladder; `n`
            without, 0 for none.

    Returns:
        Estimate.

    Raises:
        ValueError: a threshold that is not finite, fewer than 3 replicates, a share that is not in
            (0, 0.5], or `n * share` below 10; outputs that are not one per sample.

    Source: Au and Beck (2001); Papaioannou et al. (2015) for the moves. Deviation: replicates in
    the place of the analytic coefficient of variation.

    Example:
        >>> import jax
        >>> found = subset_simulation(lambda x: x[:, 0], 3.0, 4, key=jax.random.key(0), explore=0)
        >>> found.lower < 1.35e-3 < found.upper
        True
    """
    check_threshold(threshold)
    if replicates < 3:
        raise ValueError(f"replicates={replicates}: expected at least 3, for an interval")
    if not 0.0 < share <= 0.5:
        raise ValueError(f"share={share}: expected a number in (0, 0.5]")
    if n * share < 10:
        raise ValueError(f"n={n}, share={share}: expected n * share >= 10 chains; raise n")
    n_chains = round(n * share)
    length = max(2, round(n / n_chains))
    explore = n if explore is None else explore
    with jax.enable_x64(True):
        performance = traceable(performance, dim)
        run = ladder_program(performance, dim, n_chains, length, max_levels)
        key_runs, key_wide = jax.random.split(key)
        runs = run(jnp.asarray(float(threshold)), jax.random.split(key_runs, replicates))
        runs = jax.tree.map(np.asarray, runs)
        strangers = 0
        if explore:
            strangers = _strangers(performance, threshold, dim, explore, runs, key=key_wide)
    samples = n_chains * length
    total = replicates * samples + int(runs.level.sum()) * n_chains * (length - 1) + explore
    return _judge(runs, samples, n_chains, total, strangers, explore)


def _judge(
    runs: Replicates, samples: int, n_chains: int, total: int, strangers: int, explore: int
) -> Estimate:
    """Interval and verdict from the replicates."""
    from scipy.stats import t as student

    replicates = len(runs.log_p)
    p = np.exp(runs.log_p) * runs.hits / samples
    mean, invalid = float(p.mean()), int(runs.n_invalid.sum())
    effective = float(replicates)
    reasons = []
    if runs.level.max() == 0:
        # No rung was climbed: plain Monte Carlo, all replicates together.
        hits = int(runs.hits.sum())
        lower, upper = clopper_pearson(hits, replicates * samples)
        effective = float(hits)
    elif mean == 0.0:
        rung = float(np.exp(runs.log_p).max())
        lower, upper = 0.0, rung * clopper_pearson(0, n_chains)[1]
        reasons.append(
            f"no failure on the last rung (probability {rung:.1g}); raise max_levels or n"
        )
    else:
        error = float(p.std(ddof=1)) / math.sqrt(replicates)
        factor = float(student.ppf(0.975, replicates - 1))
        # A few replicates may look alike by luck; no ladder is better than independent samples.
        rungs = float(runs.level.mean()) * (samples / n_chains - 1.0) / (replicates * samples)
        ideal = mean * math.sqrt(rungs + 1.0 / float(runs.hits.sum()))
        measured = log_normal_interval(mean, error, factor)
        least = log_normal_interval(mean, ideal, 1.96)
        lower, upper = min(measured[0], least[0]), max(measured[1], least[1])
        positive = p[p > 0]
        ratio = float(positive.max() / positive.min())
        if len(positive) < replicates or ratio > 100.0:
            reasons.append(
                f"replicates disagree ({len(positive)} of {replicates} found failures, by factors "
                f"up to {ratio:.0f}); raise n"
            )
            lower, upper = min(lower, float(p.min())), max(upper, float(p.max()))
    if runs.stuck.any():
        at = float(np.exp(runs.log_p[runs.stuck]).max())
        reasons.append(
            f"outputs tie: {int(runs.stuck.sum())} of {replicates} ladders found fewer than "
            f"{LEAST_SEEDS} samples above a plateau (probability {at:.1g}); raise n, or give an "
            "output that varies"
        )
        if runs.level.max() > 0:
            lower = 0.0
            upper = max(upper, at * clopper_pearson(int(runs.hits.max()), n_chains)[1])
    if float(runs.taken.min()) < 0.05:
        reasons.append(
            f"chains hardly move (acceptance {float(runs.taken.min()):.2f}); raise n or look at "
            "the output's steps"
        )
        lower, upper = min(lower, float(p.min())), max(upper, float(p.max()))
    if invalid > 0.05 * total:
        reasons.append(f"{invalid} of {total} outputs are invalid: they count as no failure")
        upper = 1.0 if invalid > 0.5 * total else upper
        mean = float("nan") if invalid > 0.5 * total else mean
    if strangers:
        reasons.append(
            f"{strangers} of {explore} wide samples fail beside the regions of the ladder; start "
            "design_points from such failures and use importance_sampling"
        )
        upper = max(upper, clopper_pearson(0, replicates * samples)[1])
    if not reasons:
        return Estimate(mean, lower, upper, total, invalid, effective, GOOD)
    return Estimate(mean, lower, upper, total, invalid, effective, "; ".join(reasons))
