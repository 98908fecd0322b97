"""A window that slides one sample at a time over running sensors."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion.fitted import FittedARGate, Prediction


class SensorStream:
    """The last T samples of every sensor, classified whenever a sample arrives.

    A sample of NaN makes its sensor absent for as long as it lies in the window. All work of a
    sample is one compiled call on one window.

    Args:
        fitted: of `fusion.finish`, or read by `FittedARGate.load`.

    Example:
        >>> stream = SensorStream(fitted)  # doctest: +SKIP
        >>> for sample in recording:  # doctest: +SKIP
        ...     answer = stream.push(sample)
    """

    def __init__(self, fitted: FittedARGate) -> None:
        self._fitted = fitted
        shape = (1, fitted.config.n_sensors, fitted.config.n_times)
        self._window = np.full(shape, np.nan)
        self._seen = 0

    @property
    def is_full(self) -> bool:
        """Whether as many samples have arrived as a window has."""
        return self._seen >= self._window.shape[2]

    def push(self, sample: Any) -> Prediction | None:
        """Take one sample of every sensor.

        Args:
            sample: `[sensor]` in the units of the training data; NaN where nothing arrived.

        Returns:
            The prediction for the window that ends with this sample, a batch of one; None until
            the first window is full.

        Raises:
            ValueError: another number of sensors, or an infinite reading.
        """
        row = np.asarray(sample, np.float64)
        k = self._window.shape[1]
        if row.shape != (k,):
            raise ValueError(
                f"sample.shape={row.shape}: expected ({k},), one reading of each of "
                f"{list(self._fitted.channels)}; give NaN for a sensor that sent nothing"
            )
        self._window[0, :, :-1] = self._window[0, :, 1:]
        self._window[0, :, -1] = row
        self._seen += 1
        return self._fitted.predict(self._window) if self.is_full else None
