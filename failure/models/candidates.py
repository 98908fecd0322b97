"""Maximising an acquisition: candidate starts and multi-start ascent, every start a lane."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from failure.models import gp
from failure.models.acquisition import AcquisitionConfig, acquisition_value, pbo_weights
from failure.models.domains import Domain, project, sample
from failure.models.optimize import bfgs, polish


def raw_points(
    domain: Domain, centres: Float[Array, "c d"], n_raw: int, *, key: Key[Array, ""]
) -> Float[Array, "r d"]:
    """Candidate starts: uniform points, and the best inputs with some coordinates drawn afresh.

    Args:
        domain: where to look.
        centres: the best inputs so far.
        n_raw: how many; half of them around the centres.
        key: random key.

    Returns:
        The points, inside the domain.

    Source: the coordinate mask (twenty drawn afresh on average) is that of TuRBO's candidates,
    Eriksson et al. (2019), Section 3.1.
    """
    key_fresh, key_mask, key_reach = jax.random.split(key, 3)
    fresh = sample(domain, n_raw, key=key_fresh)
    n_local = n_raw // 2
    centre = jnp.tile(centres, (-(-n_local // centres.shape[0]), 1))[:n_local]
    chosen = jax.random.bernoulli(key_mask, min(1.0, 20.0 / fresh.shape[1]), centre.shape)
    reach = jax.random.uniform(key_reach, (n_local, 1), fresh.dtype)
    moved = jnp.where(chosen, centre + reach * (fresh[:n_local] - centre), centre)
    return jnp.concatenate([jax.vmap(project, (None, 0))(domain, moved), fresh[n_local:]])


def propose(
    gp_config: gp.GPConfig,
    config: AcquisitionConfig,
    posterior: gp.Posterior,
    domain: Domain,
    best: Float[Array, ""],
    raw: Float[Array, "r d"],
    *,
    newton_steps: int = 0,
) -> tuple[Float[Array, "q d"], Float[Array, " q"]]:
    """Maximise the acquisition by multi-start ascent; one program, every start a lane.

    Args:
        gp_config: the surrogate's configuration.
        config: acquisition and effort.
        posterior: the conditioned GP.
        domain: where to look.
        best: best (standardised) output so far.
        raw: candidate starts, from `raw_points`.
        newton_steps: Newton steps that finish the three best ascents of each maximum. A search
            does without: the last tenth of a percent of the improvement does not move its points.

    Returns:
        `(points [q, d], acquisition values [q])`.
    """
    weights = pbo_weights(config.batch_size).astype(posterior.x.dtype)

    def value(x: Array, weight: Array) -> Array:
        mean, variance = gp.predict(gp_config, posterior, x)
        return acquisition_value(config, mean, jnp.sqrt(variance), best, weight)

    mean, variance = gp.predict(gp_config, posterior, raw)
    sd = jnp.sqrt(variance)
    scores = jax.vmap(lambda w: acquisition_value(config, mean, sd, best, w))(weights)
    _, top = jax.lax.top_k(scores, config.n_restarts)
    starts = raw[top.reshape(-1)]
    lane_weights = jnp.repeat(weights, config.n_restarts)

    # Coordinates that hardly matter (long lengthscales) need long steps to reach their bounds.
    scale2 = jnp.exp(2.0 * (posterior.params.log_lengthscale))
    metric = jnp.diag(jnp.clip(scale2 / jnp.min(scale2), 1.0, 100.0))

    def ascend(start: Array, weight: Array) -> tuple[Array, Array]:
        def loss(x: Array) -> Array:
            return -value(x[None], weight)[0]

        end = bfgs(
            lambda x: (*jax.value_and_grad(loss)(x), ()),
            start,
            domain,
            hessian_inverse=metric,
            fresh=jnp.asarray(True),
            max_evals=config.max_evals,
            gtol=1e-6,
            ftol=1e-7,
        )
        return end.x, -end.value

    points, values = jax.vmap(ascend)(starts, lane_weights)
    points = points.reshape(config.batch_size, config.n_restarts, -1)
    values = values.reshape(config.batch_size, config.n_restarts)
    values = jnp.where(jnp.isfinite(values), values, -jnp.inf)
    if newton_steps > 0:

        def finish(start: Array, weight: Array) -> tuple[Array, Array]:
            x, end = polish(lambda x: -value(x[None], weight)[0], start, domain, steps=newton_steps)
            return x, -end

        _, best_lanes = jax.lax.top_k(values, min(3, config.n_restarts))
        points = jnp.take_along_axis(points, best_lanes[:, :, None], axis=1)
        points, values = jax.vmap(jax.vmap(finish, (0, None)))(points, weights)
    winner = jnp.argmax(values, 1)
    rows = jnp.arange(config.batch_size)
    return points[rows, winner], values[rows, winner]
