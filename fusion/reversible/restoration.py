"""A failed sensor's window out of what the other sensors' trunks hold.

The trunk's output of a working sensor is a window in other coordinates. A regression with a
distribution says what the failed sensor's coordinates would be; the inverse makes a window of them.
Chapter 4 of the source restores inactive features of a circuit so, by zeros or a Bayesian network.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from fusion._checks import check_count, check_key, check_number
from fusion.bayesian_linear import LinearPosterior, fit_linear, predict_linear
from fusion.reversible.blocks import Params, forward, inverse
from fusion.reversible.config import ReversibleConfig

RIDGE = 1e-4
"""Share of the mean variance that is added to covariances before they are factored."""


ITERATIONS = 6
"""Updates of the noise by its evidence; they settle within a few where rows are many."""


class Restoration(NamedTuple):
    """Conditional density of one sensor's trunk output, given those of others.

    Attributes:
        posterior: of the regression, in units of the standard deviations below.
        shift_in, scale_in, shift_out, scale_out: means and standard deviations of the rows.
        factor: Cholesky factor of the covariance of what the regression leaves.
    """

    posterior: LinearPosterior
    shift_in: Float[Array, " i"]
    scale_in: Float[Array, " i"]
    shift_out: Float[Array, " o"]
    scale_out: Float[Array, " o"]
    factor: Float[Array, "o o"]


class Restored(NamedTuple):
    """Windows put in the place of those of a failed sensor: `mean`, and ends of an interval."""

    mean: Float[Array, "n t"]
    low: Float[Array, "n t"]
    high: Float[Array, "n t"]


def trunk_rows(
    config: ReversibleConfig, params: Params, x: Float[Array, "n k t"]
) -> Float[Array, "n k f"]:
    """Trunk outputs of all sensors' windows as rows of numbers; `rows_to_windows` undoes it.

    Args:
        config: of the trunks.
        params: of an encoder, `main["encoder"]`.
        x: windows, `[batch, sensor, time]`.
    """
    z = forward(config, params, jnp.transpose(x, (1, 0, 2))[..., None])
    return jnp.transpose(z.reshape(*z.shape[:2], -1), (1, 0, 2))


def sensor_params(params: Params, sensor: int) -> Params:
    """The trunk of one sensor, as a trunk of one branch."""
    own = {n: v for n, v in params.items() if n.startswith("stage")}
    return {name: value[:, sensor : sensor + 1] for name, value in own.items()}


def rows_to_windows(
    config: ReversibleConfig, params: Params, rows: Float[Array, "n f"], sensor: int
) -> Float[Array, "n t"]:
    """Windows of one sensor from rows of its trunk's output."""
    return _own_windows(config, sensor_params(params, sensor), rows)


def _own_windows(config: ReversibleConfig, own: Params, rows: Array) -> Array:
    z = rows.reshape(1, rows.shape[0], -1, config.stage_channels()[-1])
    return inverse(config, own, z)[0, ..., 0]


@functools.partial(jax.jit, static_argnames="config")
def _drawn_windows(config: ReversibleConfig, own: Params, drawn: Array) -> Array:
    """Windows of every draw; compiled once for all sensors."""
    return jax.lax.map(lambda rows: _own_windows(config, own, rows), drawn)


def _moments(x: Array) -> tuple[Array, Array]:
    sd = jnp.std(x, axis=0)
    return jnp.mean(x, axis=0), jnp.where(sd > 1e-6, sd, jnp.ones_like(sd))


def _residual_factor(residuals: Array) -> Array:
    covariance = residuals.T @ residuals / residuals.shape[0]
    floor = RIDGE * jnp.mean(jnp.diagonal(covariance)) + 1e-12
    return jnp.linalg.cholesky(covariance + floor * jnp.eye(len(covariance), dtype=residuals.dtype))


def fit_restoration(
    inputs: Float[Array, "n i"],
    outputs: Float[Array, "m o"],
) -> Restoration:
    r"""Bayesian linear regression of one sensor's trunk output on those of others.

    .. math::
        z_F \mid z_W \sim N\left(M \phi(z_W),\; R + v(z_W)\, I\right)

    with standardised rows, :math:`\phi` the inputs and a one, prior variance 1 / i of every weight,
    noise by its evidence, R the covariance of the residuals and v the posterior variance.

    Args:
        inputs: rows of `trunk_rows` of the working sensors, side by side, in training windows.
        outputs: those of the failed one, or its windows themselves: `restored_rows` gives windows
            then, and on HAR nearer ones than the way through the inverse does.

    Raises:
        ValueError: rows that differ in number, or fewer than two.

    Source: Shim (2020), section 4.3, for the restoration; Bishop (2006), chapter 3.

    Example:
        >>> x = jax.random.normal(jax.random.key(0), (200, 2))
        >>> found = fit_restoration(x, x @ jnp.array([[1.0], [-2.0]]))
        >>> mean, _ = restored_rows(found, jnp.array([[3.0, 1.0]]))
        >>> round(float(mean[0, 0]), 2)
        1.0
    """
    moments = (*_moments(inputs), *_moments(outputs))
    x, y = _scaled(inputs, *moments[:2]), _scaled(outputs, *moments[2:])
    posterior = fit_linear(x, y, prior_variance=1.0 / inputs.shape[1], iterations=ITERATIONS)
    residuals = y - predict_linear(posterior, x)[0]
    return Restoration(posterior, *moments, _residual_factor(residuals))


def spread_of_others(
    restoration: Restoration, inputs: Float[Array, "n i"], outputs: Float[Array, "n o"]
) -> Restoration:
    """The same regression, R that of its residuals for people (or days) that it was not fitted on.

    Residuals of the rows of the fit are too small for others.
    """
    x = _scaled(inputs, restoration.shift_in, restoration.scale_in)
    y = _scaled(outputs, restoration.shift_out, restoration.scale_out)
    residuals = y - predict_linear(restoration.posterior, x)[0]
    return restoration._replace(factor=_residual_factor(residuals))


def _scaled(x: Array, shift: Array, scale: Array) -> Array:
    return (x - shift[None]) / scale[None]


def restored_rows(
    restoration: Restoration, inputs: Float[Array, "n i"]
) -> tuple[Float[Array, "n o"], Float[Array, " n"]]:
    """Expected trunk output of the failed sensor, and the posterior variance v of each row."""
    x = _scaled(inputs, restoration.shift_in, restoration.scale_in)
    mean, variance = predict_linear(restoration.posterior, x)
    return restoration.shift_out[None] + restoration.scale_out[None] * mean, variance


def draw_rows(
    restoration: Restoration, inputs: Float[Array, "n i"], n_draws: int, *, key: Key[Array, ""]
) -> Float[Array, "s n o"]:
    """Draws of the failed sensor's trunk output from the conditional density."""
    mean, variance = restored_rows(restoration, inputs)
    shape = (n_draws, *mean.shape)
    one, other = (jax.random.normal(k, shape, mean.dtype) for k in jax.random.split(key))
    spread = one @ restoration.factor.T + jnp.sqrt(variance)[None, :, None] * other
    return mean[None] + restoration.scale_out[None, None] * spread


def restore_windows(
    config: ReversibleConfig,
    params: Any,
    restoration: Restoration,
    inputs: Float[Array, "n i"],
    sensor: int,
    *,
    key: Key[Array, ""],
    n_draws: int = 32,
    level: float = 0.9,
) -> Restored:
    """Windows of a failed sensor: the mean of draws sent back through the inverse.

    Args:
        config, params: of the trunks.
        restoration: of the failed sensor.
        inputs: rows of the working sensors, as in `fit_restoration`.
        sensor: the failed one.
        key: of the draws.
        n_draws: how many.
        level: share of the draws between `low` and `high`.

    Raises:
        ValueError: a legacy key, no draw, a level outside (0, 1).
    """
    check_key(key)
    check_count("n_draws", n_draws)
    check_number("level", level, 0.0, 1.0, above=True, below=True, fix="0.9 is usual")
    drawn = draw_rows(restoration, inputs, n_draws, key=key)
    own = _drawn_windows(config, sensor_params(params, sensor), drawn)
    ends = jnp.quantile(own, jnp.array([0.5 - level / 2.0, 0.5 + level / 2.0]), axis=0)
    return Restored(jnp.mean(own, axis=0), ends[0], ends[1])
