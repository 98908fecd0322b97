r"""From a head's log odds to a probability that can be taken at its word, and when to call it.

.. math:: p_k = \sigma(a_k \ell_k + b_k)

:math:`\ell_k` is what a trained head tells of sensor k, :math:`a_k \ge 0` and :math:`b_k` are
fitted on frames that no training saw. The order of frames, and with it every AUROC, stays. A sensor
is called failed where :math:`p_k > t_k`, with :math:`t_k` the :math:`\lceil (n+1)(1-r)\rceil`-th
smallest of n frames in which all sensors work: in a further such frame this happens with a
probability of at most r, whatever the head.

Source: Platt (1999), whose targets keep the fit finite where the log odds separate the frames; Guo
et al. (2017) for networks; the threshold, Vovk, Gammerman, Shafer (2005), conformal prediction.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import expit

_ITERATIONS = 60
_DAMPING = 1e-9  # of Newton's steps; log odds are scaled to a deviation of 1


class Calibration(NamedTuple):
    """How told log odds of (camera, lidar) are read.

    Attributes:
        slope, offset: a and b of `rescaled`, `[2]`.
        threshold: probability above which a sensor is called failed, `[2]`.
    """

    slope: Array | np.ndarray
    offset: Array | np.ndarray
    threshold: Array | np.ndarray


AS_TOLD = Calibration(np.ones(2, np.float32), np.zeros(2, np.float32), np.full(2, 0.5, np.float32))
"""Log odds as the head tells them."""


def rescaled(calibration: Calibration | None, log_odds: Float[Array, "*b 2"]) -> Array:
    r"""Calibrated log odds :math:`a \ell + b`; NaN, of a network that tells nothing, stays.

    Example:
        >>> import jax.numpy as jnp
        >>> half = Calibration(jnp.array([0.5, 1.0]), jnp.array([1.0, 0.0]), jnp.ones(2))
        >>> rescaled(half, jnp.array([[4.0, 4.0]])).tolist()
        [[3.0, 4.0]]
    """
    if calibration is None:
        return log_odds
    shape = (1,) * (log_odds.ndim - 1) + (2,)
    a, b = (jnp.asarray(x, log_odds.dtype).reshape(shape) for x in calibration[:2])
    return a * log_odds + b


def fit_platt(
    log_odds: Float[np.ndarray, " n"], failed: Bool[np.ndarray, " n"]
) -> tuple[float, float]:
    r"""Slope and offset that minimize the cross entropy, by Newton's method in float64.

    The targets are :math:`(n_+ + 1) / (n_+ + 2)` of the :math:`n_+` failed readings and
    :math:`1 / (n_- + 2)` of the others. Where the log odds are lower for failed readings, the slope
    is 0 and the probability the share of failed ones: such a head tells nothing.

    Raises:
        ValueError: log odds that are not finite, or readings of one kind only.

    Example:
        >>> import numpy as np
        >>> rng = np.random.default_rng(0)
        >>> truth = rng.normal(0.0, 2.0, 20_000)
        >>> failed = rng.uniform(size=20_000) < 1 / (1 + np.exp(-truth))
        >>> slope, offset = fit_platt(4.0 * truth - 8.0, failed)  # too sure, and too seldom
        >>> abs(slope - 0.25) < 0.02, abs(offset - 2.0) < 0.1
        (True, True)
    """
    x, y = np.asarray(log_odds, np.float64), np.asarray(failed, bool)
    n_failed, n_working = int(y.sum()), int((~y).sum())
    if not np.isfinite(x).all() or not n_failed or not n_working:
        raise ValueError(
            f"log_odds of {n_failed} failed and {n_working} working readings: expected finite ones "
            "of both; give frames with and without failure"
        )
    target = np.where(y, (n_failed + 1) / (n_failed + 2), 1 / (n_working + 2))
    centre, scale = x.mean(), x.std() + 1e-12
    design = np.stack([(x - centre) / scale, np.ones_like(x)], axis=1)
    share = target.mean()
    flat = np.array([0.0, math.log(share / (1 - share))])

    def loss(w: np.ndarray) -> float:
        z = design @ w
        return float(np.mean(np.logaddexp(0.0, z) - target * z))

    w = flat
    for _ in range(_ITERATIONS):
        p = expit(design @ w)
        gradient = design.T @ (p - target) / len(x)
        curvature = (design.T * (p * (1 - p))) @ design / len(x) + _DAMPING * np.eye(2)
        step, factor = np.linalg.solve(curvature, gradient), 1.0
        while factor > 1e-6 and loss(w - factor * step) > loss(w):
            factor /= 2
        if factor * np.abs(step).max() < 1e-9:
            break
        w = w - factor * step
    w = w if w[0] > 0 else flat
    return float(w[0] / scale), float(w[1] - w[0] * centre / scale)


def alarm_threshold(working: Float[np.ndarray, " n"], false_alarm_rate: float) -> float:
    """Probability above which a sensor is called failed, at a rate of false alarms of at most this.

    Args:
        working: probabilities told of a sensor in frames in which all sensors work.
        false_alarm_rate: r above; holds over such frames and calibrations, not for each one alone.

    Raises:
        ValueError: a rate outside (0, 1), or fewer than 1 / r - 1 frames.

    Example:
        >>> import numpy as np
        >>> alarm_threshold(np.arange(99) / 100, 0.1)
        0.89
    """
    if not 0.0 < false_alarm_rate < 1.0:
        raise ValueError(f"false_alarm_rate={false_alarm_rate}: expected a share in (0, 1)")
    n, least = len(working), frames_needed(false_alarm_rate)
    if n < least:
        raise ValueError(
            f"false_alarm_rate={false_alarm_rate}: expected at least {least} frames to tell it "
            f"from, not {n}; give more frames or a higher rate"
        )
    rank = math.ceil((n + 1) * (1.0 - false_alarm_rate) - 1e-9)
    return float(np.sort(np.asarray(working, np.float64))[rank - 1])


def frames_needed(false_alarm_rate: float) -> int:
    """Fewest frames from which a threshold of this rate can be told.

    Example:
        >>> frames_needed(0.01)
        99
    """
    return math.ceil(1.0 / false_alarm_rate - 1.0 - 1e-9)
