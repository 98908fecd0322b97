"""How likely a failure is: Monte Carlo, subset simulation, importance sampling around failures.

Parameters are independent standard normal (units of sigma); a sample fails when its output is
above the threshold. Outputs that are not finite are invalid: they count as no failure, and their
number is reported.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from failure.design_points import Performance, design_points, merge_points

__all__ = [
    "Estimate",
    "design_points",
    "importance_sampling",
    "merge_points",
    "monte_carlo",
    "subset_simulation",
]


class Estimate(NamedTuple):
    """A failure probability.

    Attributes:
        probability: point estimate.
        lower: lower end of the 95 % interval.
        upper: upper end.
        n_simulations: simulator calls it cost, those of the design points not included.
        n_invalid: calls without a finite output.
        n_effective: effective number of failing samples (failures for Monte Carlo; replicates
            for subset simulation).
    """

    probability: float
    lower: float
    upper: float
    n_simulations: int
    n_invalid: int
    n_effective: float


def _log_normal_interval(mean: float, error: float, factor: float) -> tuple[float, float]:
    """Interval of a positive estimate with standard error `error`, symmetric in its logarithm."""
    spread = factor * math.sqrt(math.log1p((error / mean) ** 2))
    return mean * math.exp(-spread), min(1.0, mean * math.exp(spread))


def monte_carlo(
    key: Key[Array, ""],
    performance: Performance,
    threshold: float,
    dim: int,
    *,
    n: int = 10_000,
    batch: int = 10_000,
) -> Estimate:
    """Share of failures among `n` draws, with the exact binomial interval.

    Args:
        key: random key.
        performance: `x [m, dim] -> y [m]`.
        threshold: failure is `y > threshold`.
        dim: number of parameters.
        n: draws.
        batch: draws per call of `performance`.

    Source: Clopper and Pearson (1934) for the interval.
    """
    from scipy.stats import beta

    hits = invalid = 0
    with jax.enable_x64(True):
        for start in range(0, n, batch):
            size = min(batch, n - start)
            x = jax.random.normal(jax.random.fold_in(key, start), (size, dim))
            y = np.asarray(performance(x))
            hits += int(np.sum(y > threshold))
            invalid += int(np.sum(~np.isfinite(y)))
    lower = float(beta.ppf(0.025, hits, n - hits + 1)) if hits else 0.0
    upper = float(beta.ppf(0.975, hits + 1, n - hits)) if hits < n else 1.0
    return Estimate(hits / n, lower, upper, n, invalid, float(hits))


class _Level(NamedTuple):
    u: Array
    y: Array
    log_p: Array
    level: Array
    scale: Array
    n_invalid: Array
    key: Array


def _one_subset_run(
    performance: Performance,
    threshold: Array,
    dim: int,
    n: int,
    share: float,
    max_levels: int,
    key: Array,
) -> tuple[Array, Array, Array]:
    """One replicate: `(log probability, simulations, invalid outputs)`."""
    n_chains = round(n * share)
    length = n // n_chains

    def evaluate(u: Array) -> tuple[Array, Array]:
        y = performance(u)
        bad = ~jnp.isfinite(y)
        return jnp.where(bad, -jnp.inf, y), jnp.sum(bad)

    def climb(s: _Level) -> _Level:
        key, sub = jax.random.split(s.key)
        top, index = jax.lax.top_k(s.y, n_chains)
        bar = top[-1]
        correlation = jnp.sqrt(1.0 - jnp.minimum(s.scale, 1.0) ** 2)

        def move(carry: tuple[Array, Array], step_key: Array) -> tuple[Any, Any]:
            u, y = carry
            noise = jax.random.normal(step_key, u.shape, u.dtype)
            trial = correlation * u + jnp.minimum(s.scale, 1.0) * noise
            y_trial, bad = evaluate(trial)
            take = y_trial >= bar
            u = jnp.where(take[:, None], trial, u)
            y = jnp.where(take, y_trial, y)
            return (u, y), (u, y, jnp.mean(take.astype(u.dtype)), bad)

        start = (s.u[index], top)
        _, (us, ys, taken, bad) = jax.lax.scan(move, start, jax.random.split(sub, length - 1))
        u = jnp.concatenate([start[0], us.reshape(-1, dim)])
        y = jnp.concatenate([start[1], ys.reshape(-1)])
        # Aim at the acceptance rate that Papaioannou et al. recommend.
        scale = s.scale * jnp.exp(jnp.mean(taken) - 0.44)
        return _Level(
            u, y, s.log_p + math.log(n_chains / n), s.level + 1, scale,
            s.n_invalid + jnp.sum(bad), key,
        )  # fmt: skip

    def going(s: _Level) -> Array:
        bar = jax.lax.top_k(s.y, n_chains)[0][-1]
        return (bar <= threshold) & (s.level < max_levels)

    key, sub = jax.random.split(key)
    u = jax.random.normal(sub, (n_chains * length, dim))
    y, bad = evaluate(u)
    zero = jnp.zeros((), u.dtype)
    end = jax.lax.while_loop(going, climb, _Level(u, y, zero, jnp.int32(0), zero + 0.6, bad, key))
    final = jnp.mean((end.y > threshold).astype(u.dtype))
    simulations = n_chains * length + end.level * n_chains * (length - 1)
    return end.log_p + jnp.log(final), simulations, end.n_invalid


@lru_cache(maxsize=8)
def _subset_program(
    performance: Performance, dim: int, n: int, share: float, max_levels: int
) -> Callable[[Array, Array], tuple[Array, Array, Array]]:
    """All replicates as one compiled program, kept for further thresholds and keys."""

    @jax.jit
    def run(threshold: Array, keys: Array) -> tuple[Array, Array, Array]:
        return jax.lax.map(
            lambda k: _one_subset_run(performance, threshold, dim, n, share, max_levels, k), keys
        )

    return run


def subset_simulation(
    key: Key[Array, ""],
    performance: Performance,
    threshold: float,
    dim: int,
    *,
    n: int = 1000,
    share: float = 0.1,
    replicates: int = 10,
    max_levels: int = 15,
) -> Estimate:
    r"""Probability as a product of conditional ones on a ladder of easier thresholds.

    .. math:: p = \prod_j P(y > b_{j+1} \mid y > b_j), \qquad
        u' = \sqrt{1 - s^2}\, u + s\, \xi

    with the levels :math:`b_j` set so that each factor is `share` and :math:`u'` the conditional
    moves of the Markov chains. The chains of one run are correlated in ways a formula for the
    error underestimates, so the interval comes from independent replicates (Student's t on the
    log-normal scale).

    Args:
        key: random key.
        performance: `x [m, dim] -> y [m]`, jittable (wrap others in `jax.pure_callback`) and
            hashable, as functions are: its program is compiled once and kept.
        threshold: failure is `y > threshold`.
        dim: number of parameters.
        n: samples per level and replicate.
        share: conditional probability of a level.
        replicates: independent runs, at least 3.
        max_levels: ladder's length at most; `share ** max_levels` is the least probability seen.

    Raises:
        ValueError: fewer than 3 replicates, or `n * share` below 10.

    Source: Au and Beck (2001); Papaioannou et al. (2015) for the moves. Deviation: replicates in
    the place of the analytic coefficient of variation.
    """
    from scipy.stats import t as student

    if replicates < 3:
        raise ValueError(f"replicates={replicates}: an interval needs at least 3")
    if n * share < 10:
        raise ValueError(f"n={n}, share={share}: expected n * share >= 10 chains; raise n")
    with jax.enable_x64(True):
        run = _subset_program(performance, dim, n, share, max_levels)
        log_p, simulations, invalid = run(jnp.asarray(threshold), jax.random.split(key, replicates))
        p = np.exp(np.asarray(log_p))
    total, bad = int(np.asarray(simulations).sum()), int(np.asarray(invalid).sum())
    mean = float(p.mean())
    if mean == 0.0:
        # Nothing failed on the last rung: the ladder's own resolution bounds the answer.
        return Estimate(0.0, 0.0, share**max_levels, total, bad, 0.0)
    error = float(p.std(ddof=1)) / math.sqrt(replicates)
    factor = float(student.ppf(0.975, replicates - 1))
    lower, upper = _log_normal_interval(mean, error, factor)
    return Estimate(mean, lower, upper, total, bad, float(replicates))


def importance_sampling(
    key: Key[Array, ""],
    performance: Performance,
    threshold: float,
    points: Float[np.ndarray, "k d"],
    *,
    n: int = 4000,
    defensive: float = 0.1,
) -> Estimate:
    r"""Sample from normals moved to the failure regions, and weight each sample back.

    .. math:: q = \alpha N(0, I) + \tfrac{1 - \alpha}{K} \sum_k N(\mu_k, I), \qquad
        \hat p = \frac1n \sum_i \frac{\phi(u_i)}{q(u_i)} 1[y(u_i) > T]

    The nominal part bounds every weight by :math:`1 / \alpha`. Regions that no point stands for
    are missed: the interval is that of the regions given.

    Args:
        key: random key.
        performance: `x [m, D] -> y [m]`.
        threshold: failure is `y > threshold`.
        points: the shifts :math:`\mu_k`, best the most likely point of each region
            (`design_points`).
        n: samples.
        defensive: :math:`\alpha`.

    Raises:
        ValueError: no point, or one that is not finite.

    Source: Hesterberg (1995) for the defensive mixture; Kahn and Harris (1951).
    """
    centres = np.asarray(points, np.float64)
    if centres.ndim != 2 or len(centres) == 0 or not np.all(np.isfinite(centres)):
        raise ValueError(
            f"points of shape {centres.shape}: expected at least one finite failure point [k, D]"
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
    term = weight * (y > threshold)
    invalid = int(np.sum(~np.isfinite(y)))
    mean = float(term.mean())
    if mean == 0.0:
        return Estimate(0.0, 0.0, 1.0, n, invalid, 0.0)
    error = float(term.std(ddof=1)) / math.sqrt(n)
    lower, upper = _log_normal_interval(mean, error, 1.96)
    effective = float(term.sum() ** 2 / (term**2).sum())
    return Estimate(mean, lower, upper, n, invalid, effective)
