"""Probability that a sensor has failed, in ways that nobody simulated: how unlike a working window.

What a working sensor sends is modelled, not how it fails: a Gaussian over a few statistics of the
window for each class, mixed by the class probabilities that the fusion gives. Simulated failures
set the scale of the probability only; they do not change the order of two windows of one sensor.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from fusion._checks import check_count

TINY = 1e-4
"""Readings span [-1, 1]; differences below this are none in the logarithms."""
SHARED = 0.3
"""Share of the covariance over all classes in that of each class."""
FLOOR = 0.1
"""Least standard deviation of a statistic given the others, as a share of its own."""
RIDGE = 1e-3
"""Weight of the squared slope in the calibration."""
N_STATISTICS = 7


class WorkingModel(NamedTuple):
    """What windows of working sensors are like, and what doubt about it means.

    Attributes:
        mean: of the statistics, by class and sensor; precision: inverse covariances;
            log_det: logarithms of the covariances' determinants.
        center, scale: novelty of working windows of each sensor, median and 90 % less median.
        slope, offset: of the calibrated log odds; 1 and 0 before `calibrate_failures`.
    """

    mean: Float[Array, "c k d"]
    precision: Float[Array, "c k d d"]
    log_det: Float[Array, "c k"]
    center: Float[Array, " k"]
    scale: Float[Array, " k"]
    slope: Float[Array, ""]
    offset: Float[Array, ""]


def window_statistics(x: Float[Array, "n k t"]) -> Float[Array, "n k 7"]:
    r"""Seven statistics of each window, without regard to how sensors fail.

    .. math::
        \bar x, \quad \log s, \quad \log s_\Delta, \quad \log \max |x|, \quad
        \bar x_{\text{last}} - \bar x_{\text{first}}, \quad
        \tfrac{1}{T-1} \#\{\Delta x_t = 0\}, \quad \rho_1

    Symbols: s and :math:`s_\Delta` are the standard deviations of the readings and of their
    differences, first and last are an eighth of the window each, :math:`\rho_1` is the
    autocorrelation at one sample. A small constant is added in the logarithms.

    Args:
        x: windows scaled to [-1, 1], of 8 samples or more.

    Raises:
        ValueError: shorter windows.
    """
    t = x.shape[-1]
    if t < 8:
        raise ValueError(
            f"x.shape={tuple(x.shape)}: expected windows of at least 8 samples; for scalar "
            "sensors use fusion.monitor"
        )
    step = jnp.diff(x, axis=-1)
    mean = jnp.mean(x, axis=-1)
    centred = x - mean[..., None]
    spread = jnp.sqrt(jnp.mean(centred**2, axis=-1))
    part = t // 8
    together = jnp.mean(centred[..., 1:] * centred[..., :-1], axis=-1)
    return jnp.stack(
        [
            mean,
            jnp.log(spread + TINY),
            jnp.log(jnp.std(step, axis=-1) + TINY),
            jnp.log(jnp.max(jnp.abs(x), axis=-1) + TINY),
            jnp.mean(x[..., -part:], axis=-1) - jnp.mean(x[..., :part], axis=-1),
            jnp.mean((step == 0.0).astype(x.dtype), axis=-1),
            together / (spread**2 + TINY),
        ],
        axis=-1,
    )


def fit_working(
    x: Float[Array, "n k t"], labels: Int[ArrayLike, " n"], n_classes: int
) -> WorkingModel:
    r"""Gaussians of the statistics of working sensors, one for each class and sensor.

    .. math::
        \Sigma_{ck} = (1 - \lambda) S_{ck} + \lambda S_k + \operatorname{diag}(0.1^2 s_k^2)

    with the covariances S of a class and of all (within classes), whose diagonal is :math:`s_k^2`.

    Args:
        x: clean training windows.
        labels: their classes.
        n_classes: number of classes; a class without windows has the Gaussian of all.

    Raises:
        ValueError: fewer windows than two for each statistic, or short ones.
    """
    check_count("n_classes", n_classes, 2)
    if len(x) < 2 * N_STATISTICS:
        raise ValueError(
            f"x=array with {len(x)} windows: expected at least {2 * N_STATISTICS}; give more"
        )
    s, y = np.asarray(jax.jit(window_statistics)(x), np.float64), np.asarray(labels)
    means = np.stack(
        [s[y == c].mean(axis=0) if (y == c).any() else s.mean(0) for c in range(n_classes)]
    )
    rest = s - means[y]
    pooled = np.einsum("nkd,nke->kde", rest, rest) / len(s)
    floor = np.maximum(FLOOR**2 * np.einsum("kdd->kd", pooled), TINY**2)
    covariances = []
    for c in range(n_classes):
        of = rest[y == c] if (y == c).any() else rest
        own = np.einsum("nkd,nke->kde", of, of) / len(of)
        mixed = (1.0 - SHARED) * own + SHARED * pooled
        covariances.append(mixed + np.einsum("kd,de->kde", floor, np.eye(N_STATISTICS)))
    stacked = np.stack(covariances)
    given = means, np.linalg.inv(stacked), np.linalg.slogdet(stacked)[1]
    mean, precision, log_det = (jnp.asarray(a, jnp.float32) for a in given)
    k = s.shape[1]
    one, zero = jnp.ones(()), jnp.zeros(())
    plain = WorkingModel(mean, precision, log_det, jnp.zeros(k), jnp.ones(k), one, zero)
    own = jax.nn.one_hot(jnp.asarray(y), n_classes)
    return _standardize(plain, np.asarray(jax.jit(novelty)(plain, x, own)))


def _standardize(params: WorkingModel, found: np.ndarray) -> WorkingModel:
    middle, high = np.quantile(found, [0.5, 0.9], axis=0)
    scale = np.maximum(high - middle, TINY)
    return params._replace(
        center=jnp.asarray(middle, jnp.float32), scale=jnp.asarray(scale, jnp.float32)
    )


def novelty(
    params: WorkingModel, x: Float[Array, "n k t"], classes: Float[Array, "n c"]
) -> Float[Array, "n k"]:
    r"""How unlike a working sensor's window each window is, in nats.

    .. math::
        \nu_k = -\log \sum_c p_c\, N\!\left(\phi(x_k);\, \mu_{ck}, \Sigma_{ck}\right)

    Args:
        params: of `fit_working`.
        x: windows scaled to [-1, 1].
        classes: class probabilities of each example, from the fusion of all sensors.

    Returns:
        Up to a constant that is the same for all windows of all sensors.
    """
    apart = window_statistics(x)[None] - params.mean[:, None]
    distance = jnp.einsum("cnkd,ckde,cnke->cnk", apart, params.precision, apart)
    likelihood = -0.5 * (distance + params.log_det[:, None])
    share = jnp.log(jnp.maximum(classes.T, 1e-6))
    return -jax.nn.logsumexp(share[:, :, None] + likelihood, axis=0)


def _standing(params: WorkingModel, found: Array) -> Array:
    """Novelty against that of working windows; grows like a logarithm, as novelty has no bound."""
    return jnp.arcsinh((found - params.center) / params.scale)


def failure_odds(
    params: WorkingModel, x: Float[Array, "n k t"], classes: Float[Array, "n c"]
) -> Float[Array, "n k"]:
    r"""Probability that each sensor has failed; 1 where its window holds NaN.

    .. math::
        p_k = \sigma\left(a \operatorname{arsinh} \frac{\nu_k - m_k}{q_k} + b\right)

    Symbols: :math:`m_k` and :math:`q_k` are median, and 90 % quantile less median, of the novelty
    of working windows; a and b come from `calibrate_failures`.
    """
    absent = jnp.any(jnp.isnan(x), axis=-1)
    known = jnp.where(absent[:, :, None], jnp.zeros_like(x), x)
    u = _standing(params, novelty(params, known, classes))
    calls = jax.nn.sigmoid(params.slope * u + params.offset)
    return jnp.where(absent, jnp.ones_like(calls), calls)


def calibrate_failures(
    params: WorkingModel,
    x: Float[Array, "n k t"],
    classes: Float[Array, "n c"],
    failed: ArrayLike,
) -> WorkingModel:
    """Scale and log odds from held-out windows, some sensors of which fail in simulation.

    The slope is kept positive: more novelty never means less chance of a failure. Failures are
    taken to be as frequent as they are in `failed`.

    Args:
        params: of `fit_working`.
        x: windows of rows that nothing was trained on, with simulated failures of some kinds.
        classes: class probabilities that the network gives for them.
        failed: `[n, k]`, True where a sensor has failed.

    Raises:
        ValueError: a sensor without working windows, or no failed ones at all.
    """
    from scipy.optimize import minimize

    mask = np.asarray(failed, bool)
    if mask.all(axis=0).any() or not mask.any():
        raise ValueError(
            f"failed=mask with {int(mask.sum())} of {mask.size} set: expected working windows of "
            "every sensor and some failed ones; draw it with fusion.corrupt"
        )
    found = np.asarray(jax.jit(novelty)(params, x, classes))
    working = np.where(mask, np.nan, found)
    middle, high = np.nanquantile(working, [0.5, 0.9], axis=0)
    params = params._replace(
        center=jnp.asarray(middle, jnp.float32),
        scale=jnp.asarray(np.maximum(high - middle, TINY), jnp.float32),
    )
    u = np.asarray(_standing(params, jnp.asarray(found)), np.float64).ravel()
    sign = np.where(mask.ravel(), -1.0, 1.0)

    def loss(ab: np.ndarray) -> float:
        slope = np.exp(ab[0])
        # Where the two are told apart wholly, the likelihood alone has no maximum.
        return float(np.logaddexp(0.0, sign * (slope * u + ab[1])).mean() + RIDGE * slope**2)

    log_slope, offset = minimize(loss, np.zeros(2), method="Nelder-Mead").x
    return params._replace(slope=jnp.float32(np.exp(log_slope)), offset=jnp.float32(offset))
