r"""How far a reading's statistics lie from those of readings of sensors that work.

.. math:: q = \tfrac14 \min\big(|L^\top (s - m)|,\, 8\big), \qquad
    L L^\top = \big((1 - \lambda)\, C + \lambda\, \mathrm{diag}\, C\big)^{-1}

:math:`m` and :math:`C` are mean and covariance of the statistics of clean training frames, of one
sensor, and :math:`\lambda = f / (n + f)` shrinks the covariance of f statistics from n frames. A
direction in which clean frames hardly vary counts as much as one in which they vary a lot, and a
size without sign says "unlike clean frames" of failures that nobody has shown to the gate.

Source: Mahalanobis (1936); as a test for readings of an unknown kind Lee et al. (2018). Shrinkage
as of Ledoit and Wolf (2004), with a fixed share.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

MOST = 8.0  # deviations beyond are alike: no failure is more of one than another
SCALE = 0.25  # of the size of other inputs of the gate
_LEAST = 1e-3  # of a deviation: a statistic that never varies on clean frames


class Clean(NamedTuple):
    """Mean and whitening matrix of the statistics of one sensor on clean frames.

    Attributes:
        mean: `[f]`.
        whiten: `[f, f]`, L divided by each statistic's deviation.
    """

    mean: Array | np.ndarray
    whiten: Array | np.ndarray


def fit_clean(statistics: Float[np.ndarray, "n f"]) -> Clean:
    """Mean and whitening matrix from the statistics of n frames whose sensor works.

    Raises:
        ValueError: fewer than two frames, or statistics that are not finite.

    Example:
        >>> import numpy as np
        >>> clean = fit_clean(np.random.RandomState(0).normal(3.0, 2.0, (5000, 4)))
        >>> np.round(np.abs(clean.whiten).max(), 1), np.round(clean.mean[0])
        (np.float32(0.5), np.float32(3.0))
    """
    given = np.asarray(statistics, np.float64)
    n, f = given.shape
    if n < 2 or not np.isfinite(given).all():
        raise ValueError(
            f"statistics of shape {given.shape}: expected finite ones of at least two clean frames"
        )
    deviation = given.std(axis=0) + _LEAST
    standard = (given - given.mean(axis=0)) / deviation
    shrink = f / (n + f)
    covariance = (1.0 - shrink) * np.cov(standard.T, bias=True).reshape(f, f)
    covariance += shrink * np.eye(f)
    root = np.linalg.cholesky(np.linalg.inv(covariance))
    whiten = root / deviation[:, None]
    return Clean(given.mean(axis=0).astype(np.float32), whiten.astype(np.float32))


def deviations(clean: Clean, statistics: Float[Array, "b f"]) -> Float[Array, "b f"]:
    """Size of the whitened statistics, capped and scaled; without gradient."""
    white = (statistics - clean.mean[None]) @ clean.whiten
    return jax.lax.stop_gradient(SCALE * jnp.minimum(jnp.abs(white), MOST))
