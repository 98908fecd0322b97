"""The ladder of subset simulation: replicates as one compiled program."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from failure.performances import Performance, check_rows

LEAST_SEEDS = 10
"""Fewer samples than this above a rung cannot carry its chains."""


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


class Replicates(NamedTuple):
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
) -> Replicates:
    """One replicate."""
    n = n_chains * length

    def evaluate(u: Array) -> tuple[Array, Array]:
        y = performance(u)
        check_rows(y, u)
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
    return Replicates(end.log_p, hits, end.level, stuck, end.taken, end.n_invalid, centre, depth)


@lru_cache(maxsize=8)
def ladder_program(
    performance: Performance, dim: int, n_chains: int, length: int, max_levels: int
) -> Callable[[Array, Array], Replicates]:
    """All replicates as one compiled program, kept for further thresholds and keys."""

    @jax.jit
    def run(threshold: Array, keys: Array) -> Replicates:
        return jax.lax.map(
            lambda k: _one_run(performance, threshold, dim, n_chains, length, max_levels, k), keys
        )

    return run
