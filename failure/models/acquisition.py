"""Where to simulate next: log expected improvement, confidence bound, pBO's weighted family.

The search maximises: a larger specification value is worse for the circuit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

ACQUISITIONS = ("log_ei", "lcb", "pbo")

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


@dataclass(frozen=True)
class AcquisitionConfig:
    """Which acquisition, and how hard to search for its maximum.

    A batch is filled by a family of weights (`pbo`), or point by point, each as if the earlier
    ones had come out as predicted.

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
        """Refuse unknown names and impossible sizes."""
        if self.name not in ACQUISITIONS:
            raise ValueError(f"name={self.name!r}: expected one of {', '.join(ACQUISITIONS)}")
        if self.batch_size < 1:
            raise ValueError(f"batch_size={self.batch_size}: expected at least 1 point")
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
