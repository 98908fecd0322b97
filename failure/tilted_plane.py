"""A plane through the threshold whose slope is corrected by what lines find."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

TILT = 0.15
"""Expected error of a slope taken at nominal, as the tangent of its angle."""

FRESH = 0.03
"""The same for entries taken near the threshold, as a share of `TILT`."""

REST = 0.15
"""What the output does besides the plane, per sigma of slope."""


class TiltedPlane:
    r"""A plane whose value and slope are known up to normal errors.

    .. math:: y(x) = y_0 + c + (g + d) \cdot (x - x_0) + \epsilon, \qquad
        d_j \sim N(0, \lambda_j), \quad c \sim N(0, (0.1 |g|)^2), \quad
        \epsilon \sim N(0, (0.15 |g|)^2)

    Slopes from nominal are off by `TILT` together, those taken near the threshold by a fraction of
    it; every evaluation near the threshold says more (ridge regression). In as many dimensions a
    Gaussian process with a lengthscale of each needs more points than there are lines.

    Args:
        point: `[D]`, :math:`x_0`.
        value: :math:`y_0`.
        gradient: `[D]`, g.
        fresh: `[D]`, which of its entries were taken near the threshold.
    """

    def __init__(
        self,
        point: Float[np.ndarray, " D"],
        value: float,
        gradient: Float[np.ndarray, " D"],
        fresh: Bool[np.ndarray, " D"],
    ) -> None:
        self._point, self._value, self._gradient = point, value, gradient
        rate = float(np.linalg.norm(gradient))
        stale = max(int(np.sum(~fresh)), 1)
        self._variance = np.where(fresh, FRESH * TILT, TILT) ** 2 * rate**2 / stale
        self._level, self._noise = (0.1 * rate) ** 2, (REST * rate) ** 2

    def corrected(
        self, x: Float[np.ndarray, "m D"], y: Float[np.ndarray, " m"]
    ) -> tuple[float, Float[np.ndarray, " D"]]:
        """Value at the point and slope, given evaluations near the threshold."""
        good = np.isfinite(y)
        away = x[good] - self._point
        if len(away) == 0:
            return self._value, self._gradient
        rest = y[good] - self._value - away @ self._gradient
        kernel = (away * self._variance) @ away.T + self._level
        weights = np.linalg.solve(kernel + self._noise * np.eye(len(away)), rest)
        slope = self._gradient + self._variance * (weights @ away)
        return self._value + self._level * float(weights.sum()), slope
