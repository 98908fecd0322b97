"""A window that slides one sample at a time over running sensors."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion._checks import check_type
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
        check_type("fitted", fitted, FittedARGate, "read a file with FittedARGate.load")
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
            ValueError: another number of sensors, or an infinite reading; the stream goes on as if
                the sample had not come.
            TypeError: no numbers.
        """
        try:
            row = np.asarray(sample, np.float64)
        except (TypeError, ValueError):
            raise TypeError(
                f"sample={sample!r}: expected one number for each sensor; give NaN for a sensor "
                "that sent nothing"
            ) from None
        k = self._window.shape[1]
        if row.shape != (k,):
            raise ValueError(
                f"sample.shape={row.shape}: expected ({k},), one reading of each of "
                f"{list(self._fitted.channels)}; give NaN for a sensor that sent nothing"
            )
        if np.isinf(row).any():
            # Refused before it is in the window, where it would spoil every answer of its time.
            sensor = int(np.argmax(np.isinf(row)))
            raise ValueError(
                f"sample[{sensor}]={row[sensor]}: expected a finite reading of "
                f"{self._fitted.channels[sensor]!r}; give NaN for one that is lost"
            )
        self._window[0, :, :-1] = self._window[0, :, 1:]
        self._window[0, :, -1] = row
        self._seen += 1
        return self._fitted.predict(self._window) if self.is_full else None
