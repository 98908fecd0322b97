"""Subset simulation: a ladder of easier thresholds, which says when a rung does not hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

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
from failure.performances import Performance, traceable

LEAST_SEEDS = 10
"""Fewer samples than this above a rung cannot carry its chains."""

WIDE = 2.5
"""Standard deviation of the wide samples that look for regions beside the ladder [sigma]."""


class _Level(NamedTuple):
    u: Array
    y: Array
    log_p: Array
    level: Array
    scale: Array
    taken: Array
    bar: Array
    seeds: Array
    n_invalid: Array
    key: Array


class _Run(NamedTuple):
    """What one replicate reports, arrays with a leading replicate axis after the map.

    Attributes:
        log_p: logarithm of the probability of the last rung.
        hits: failing samples on it.
        level: rungs climbed.
        stuck: the next rung had too few samples above it.
        taken: mean acceptance on the last rung; 1 where none was climbed.
        n_invalid: outputs that were not finite.
        centre: `[D]`, mean of the failing samples.
        depth: 5 % quantile of the failing samples along that mean.
    """

    log_p: Array
    hits: Array
    level: Array
    stuck: Array
    taken: Array
    n_invalid: Array
    centre: Array
    depth: Array


def _rung(y: Array, threshold: Array, n_chains: int) -> tuple[Array, Array]:
    """The next threshold and how many samples reach it; above a plateau where values tie.

    The threshold is the `n_chains`-th largest value. Where so many values equal it that its share
    would say nothing, the next larger value is taken, unless the plateau fails already.
    """
    bar = jax.lax.top_k(y, n_chains)[0][-1]
    count = jnp.sum(y >= bar)
    above = jnp.where(y > bar, y, jnp.inf)
    tied = (count > 3 * n_chains // 2) & (bar <= threshold)
    return (
        jnp.where(tied, jnp.min(above), bar),
        jnp.where(tied, jnp.sum(y > bar), count),
    )


def _one_run(
    performance: Performance,
    threshold: Array,
    dim: int,
    n_chains: int,
    length: int,
    max_levels: int,
    key: Array,
) -> _Run:
    """One replicate."""
    n = n_chains * length

    def evaluate(u: Array) -> tuple[Array, Array]:
        y = performance(u)
        bad = ~jnp.isfinite(y)
        return jnp.where(bad, -jnp.inf, y), jnp.sum(bad)

    def climb(s: _Level) -> _Level:
        key, sub, pick = jax.random.split(s.key, 3)
        # Seeds drawn from all samples that reach the rung; repeated where there are too few.
        ticket = jax.random.uniform(pick, s.y.shape, s.u.dtype)
        _, index = jax.lax.top_k(jnp.where(s.y >= s.bar, ticket, -1.0), n_chains)
        index = index[jnp.arange(n_chains) % jnp.minimum(s.seeds, n_chains)]
        step = jnp.minimum(s.scale, 1.0)
        correlation = jnp.sqrt(1.0 - step**2)

        def move(carry: tuple[Array, Array], step_key: Array) -> tuple[Any, Any]:
            u, y = carry
            trial = correlation * u + step * jax.random.normal(step_key, u.shape, u.dtype)
            y_trial, bad = evaluate(trial)
            take = y_trial >= s.bar
            u = jnp.where(take[:, None], trial, u)
            y = jnp.where(take, y_trial, y)
            return (u, y), (u, y, jnp.mean(take.astype(u.dtype)), bad)

        start = (s.u[index], s.y[index])
        _, (us, ys, taken, bad) = jax.lax.scan(move, start, jax.random.split(sub, length - 1))
        u = jnp.concatenate([start[0], us.reshape(-1, dim)])
        y = jnp.concatenate([start[1], ys.reshape(-1)])
        # Aim at the acceptance rate that Papaioannou et al. recommend.
        scale = s.scale * jnp.exp(jnp.mean(taken) - 0.44)
        log_p = s.log_p + jnp.log(s.seeds.astype(u.dtype) / n)
        bar, seeds = _rung(y, threshold, n_chains)
        return _Level(
            u, y, log_p, s.level + 1, scale, jnp.mean(taken), bar, seeds,
            s.n_invalid + jnp.sum(bad), key,
        )  # fmt: skip

    def going(s: _Level) -> Array:
        return (s.bar <= threshold) & (s.seeds >= LEAST_SEEDS) & (s.level < max_levels)

    key, sub = jax.random.split(key)
    u = jax.random.normal(sub, (n, dim))
    y, bad = evaluate(u)
    zero = jnp.zeros((), u.dtype)
    bar, seeds = _rung(y, threshold, n_chains)
    first = _Level(u, y, zero, jnp.int32(0), zero + 0.6, zero + 1.0, bar, seeds, bad, key)
    end = jax.lax.while_loop(going, climb, first)
    fails = (end.y > threshold).astype(u.dtype)
    hits = jnp.sum(fails)
    centre = (fails @ end.u) / jnp.maximum(hits, 1.0)
    along = end.u @ centre / jnp.maximum(jnp.linalg.norm(centre), 1e-30)
    depth = jnp.nanquantile(jnp.where(fails > 0, along, jnp.nan), 0.05)
    # Without a sample above a plateau there is no next rung at all.
    stuck = (end.seeds < LEAST_SEEDS) & ((end.bar <= threshold) | (end.seeds == 0))
    return _Run(end.log_p, hits, end.level, stuck, end.taken, end.n_invalid, centre, depth)


@lru_cache(maxsize=8)
def _program(
    performance: Performance, dim: int, n_chains: int, length: int, max_levels: int
) -> Callable[[Array, Array], _Run]:
    """All replicates as one compiled program, kept for further thresholds and keys."""

    @jax.jit
    def run(threshold: Array, keys: Array) -> _Run:
        return jax.lax.map(
            lambda k: _one_run(performance, threshold, dim, n_chains, length, max_levels, k), keys
        )

    return run


def _strangers(
    performance: Performance, threshold: float, dim: int, n: int, runs: _Run, *, key: Array
) -> int:
    """Failing wide samples that lie beside all regions of the ladder; 0 for a few stray ones."""
    x = WIDE * jax.random.normal(key, (n, dim))
    y = np.asarray(jax.jit(performance)(x))
    fails = np.asarray(x)[y > threshold]
    found = runs.hits >= LEAST_SEEDS
    if len(fails) == 0 or not found.any():
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
        explore: samples of standard deviation 2.5 that look for regions beside the ladder; `n`
            without, 0 for none.

    Returns:
        Estimate.

    Raises:
        ValueError: a threshold that is not finite, fewer than 3 replicates, a share that is not in
            (0, 0.5], or `n * share` below 10.

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
        run = _program(performance, dim, n_chains, length, max_levels)
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
    runs: _Run, samples: int, n_chains: int, total: int, strangers: int, explore: int
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
