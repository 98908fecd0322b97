"""Where to simulate next: log expected improvement, confidence bound, pBO's weighted family.

The search maximises: a larger specification value is worse for the circuit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from failure.models import gp
from failure.models.optimize import Domain, bfgs, polish, project, sample

ACQUISITIONS = ("log_ei", "lcb", "pbo")

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


@dataclass(frozen=True)
class AcquisitionConfig:
    """Which acquisition, and how hard to search for its maximum.

    `n_raw` random points are ranked, the best `n_restarts` are improved by at most
    `max_evals` evaluations each. Half of the raw points lie around the best inputs so far: in
    60 dimensions uniform points almost never start an ascent that ends well.

    Raises:
        ValueError: an unknown name, a batch that the acquisition cannot fill, a number out
            of range.

    Example:
        >>> AcquisitionConfig("pbo", batch_size=5).beta
        2.0
    """

    name: str = "log_ei"
    batch_size: int = 1
    beta: float = 2.0
    n_raw: int = 512
    n_restarts: int = 8
    max_evals: int = 60

    def __post_init__(self) -> None:
        """Refuse unknown names and a batch for acquisitions that have one maximum."""
        if self.name not in ACQUISITIONS:
            raise ValueError(f"name={self.name!r}: expected one of {', '.join(ACQUISITIONS)}")
        if self.batch_size < 1 or (self.batch_size > 1 and self.name != "pbo"):
            raise ValueError(
                f"batch_size={self.batch_size}: expected 1 with {self.name!r}; only 'pbo' has a "
                "family of acquisition functions to fill a batch"
            )
        if not (math.isfinite(self.beta) and self.beta >= 0.0):
            raise ValueError(f"beta={self.beta}: expected a number of at least 0")
        if self.max_evals < 1:
            raise ValueError(f"max_evals={self.max_evals}: expected at least 1")
        if not 1 <= self.n_restarts <= self.n_raw:
            raise ValueError(
                f"n_restarts={self.n_restarts}: expected 1 ... n_raw={self.n_raw}; lower it"
            )


def _tail_fraction(z: Array) -> Array:
    r"""The continued fraction `c` with :math:`\Phi(z) / \phi(z) = 1 / (|z| + c)`, for z <= -4.

    Laplace's fraction :math:`c = 1/(x + 2/(x + 3/(x + \dots)))`; 20 terms leave no error in
    float64 from x = 4 on.
    """
    x = -z
    c = jnp.zeros_like(x)
    for k in range(20, 0, -1):
        c = k / (x + c)
    return c


@jax.custom_jvp
def log_h(z: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Stable logarithm of the unit expected improvement.

    .. math::
        h(z) = \phi(z) + z \Phi(z) = \phi(z) \, \frac{c(z)}{|z| + c(z)} \quad (z < 0)

    directly for z > -4; below through the continued fraction `c` of the Mills ratio, in which
    the cancellation between the two terms is done on paper. Finite and with a useful slope where
    `h` underflows.

    Source: Ament et al. (2023), Equation 9. Deviation: the continued fraction in the place of
    `erfcx`.

    Example:
        >>> round(float(log_h(jnp.asarray(0.0))), 4)
        -0.9189
    """
    low = jnp.minimum(z, -4.0)
    c = _tail_fraction(low)
    tail = -0.5 * low * low - _HALF_LOG_2PI + jnp.log(c) - jnp.log(c - low)
    high = jnp.maximum(z, -4.0)
    phi = jnp.exp(-0.5 * high * high - _HALF_LOG_2PI)
    direct = jnp.log(phi + high * jax.scipy.stats.norm.cdf(high))
    return jnp.where(z > -4.0, direct, tail)


@log_h.defjvp
def _log_h_jvp(primals: tuple[Array,], tangents: tuple[Array,]) -> tuple[Array, Array]:
    (z,), (dz,) = primals, tangents
    value = log_h(z)
    # h' = Phi, so the slope is Phi / h, and 1 / c in the tail: no cancellation at any z.
    direct = jax.scipy.stats.norm.cdf(jnp.maximum(z, -4.0)) / jnp.exp(jnp.maximum(value, -20.0))
    tail = 1.0 / _tail_fraction(jnp.minimum(z, -4.0))
    return value, jnp.where(z > -4.0, direct, tail) * dz


def log_ei(
    mean: Float[Array, "..."], sd: Float[Array, "..."], best: Float[Array, ""]
) -> Float[Array, "..."]:
    r"""Log expected improvement over `best`: :math:`\log h((\mu - y^*) / \sigma) + \log\sigma`.

    Source: Ament et al. (2023), Equation 8.
    """
    return log_h((mean - best) / sd) + jnp.log(sd)


def confidence_bound(
    mean: Float[Array, "..."], sd: Float[Array, "..."], beta: float
) -> Float[Array, "..."]:
    r"""Optimistic bound :math:`\mu + \beta \sigma` (the LCB of a minimisation, sign turned).

    Source: Srinivas et al. (2010), Equation 6, with :math:`\beta = \sqrt{\beta_t}` held fixed.
    """
    return mean + beta * sd


def weighted(
    mean: Float[Array, "..."], sd: Float[Array, "..."], weight: Float[Array, "..."]
) -> Float[Array, "..."]:
    r"""One member of pBO's family: :math:`(1 - w) \mu + w \sigma`.

    Source: Hu, Li and Huang (2018), sign turned for maximisation.
    """
    return (1.0 - weight) * mean + weight * sd


def pbo_weights(batch_size: int) -> Float[Array, " q"]:
    """Weights spread evenly over [0, 1], ends included; one half for a batch of one.

    Example:
        >>> pbo_weights(3).tolist()
        [0.0, 0.5, 1.0]
    """
    if batch_size == 1:
        return jnp.asarray([0.5])
    return jnp.linspace(0.0, 1.0, batch_size)


def acquisition_value(
    config: AcquisitionConfig,
    mean: Float[Array, "..."],
    sd: Float[Array, "..."],
    best: Float[Array, ""],
    weight: Float[Array, "..."],
) -> Float[Array, "..."]:
    """The configured acquisition at a predicted mean and standard deviation."""
    if config.name == "log_ei":
        return log_ei(mean, sd, best)
    if config.name == "lcb":
        return confidence_bound(mean, sd, config.beta)
    return weighted(mean, sd, weight)


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
