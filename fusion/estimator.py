"""ARGate as a scikit-learn classifier; needs the extra `sklearn`."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from fusion._checks import check_count, check_number
from fusion.config import HyperParams, ModelConfig, TrainConfig
from fusion.data import from_arrays
from fusion.encoders import EncoderConfig, reading_levels, readings_recur
from fusion.failures import random_failing
from fusion.fitted import FittedARGate, Prediction, finish
from fusion.loop import Corruption, fit

try:
    from sklearn.base import BaseEstimator, ClassifierMixin
    from sklearn.utils.validation import check_array, check_is_fitted
except ImportError as error:
    raise ImportError(
        "fusion.estimator needs scikit-learn: pip install 'snn-fusion-failure[sklearn]'"
    ) from error


class ARGateClassifier(ClassifierMixin, BaseEstimator):
    """Gated sensor fusion that is trained on failing sensors, with scikit-learn's interface.

    `X` is `[N, K, T]`, windows of T samples of K sensors, or `[N, K]`, one reading of each sensor
    (a column is a sensor). In `predict` NaN means that a sensor sent nothing.

    Args:
        model: a name in `fusion.MODELS` other than `oracle`.
        n_clean: sensors that keep working in two thirds of the training rows; half when None.
        kind: how the others fail, see `fusion.failure_kinds.FAILURE_KINDS`.
        epochs, batch_size, learning_rate: of the training.
        features, gate_width, head_width: sizes of the network.
        false_alarm_rate: of the sensors called failed, see `predict_sensors`.
        seed: of everything random.

    Attributes (after `fit`):
        fitted_: the `FittedARGate`, to be saved with `fitted_.save(path)`.
        classes_, n_features_in_: as scikit-learn has them.
    """

    def __init__(
        self,
        model: str = "argate_plus",
        n_clean: int | None = None,
        kind: str = "uniform",
        epochs: int = 20,
        batch_size: int = 64,
        learning_rate: float = 5e-3,
        features: int = 16,
        gate_width: int = 16,
        head_width: int = 32,
        false_alarm_rate: float = 0.05,
        seed: int = 0,
    ) -> None:
        self.model = model
        self.n_clean = n_clean
        self.kind = kind
        self.epochs = epochs
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.features = features
        self.gate_width = gate_width
        self.head_width = head_width
        self.false_alarm_rate = false_alarm_rate
        self.seed = seed

    def _windows(self, X: Any, *, missing: bool) -> np.ndarray:
        finite = "allow-nan" if missing else True
        array = check_array(X, allow_nd=True, ensure_all_finite=finite, dtype=np.float64)
        return array[:, :, None] if array.ndim == 2 else array

    def fit(self, X: Any, y: Any, groups: Any = None) -> ARGateClassifier:
        """Train on raw windows; a fifth of the rows (or groups) calibrates the probabilities.

        Raises:
            ValueError: what does not fit, with what to do.
        """
        check_count("seed", self.seed, 0)
        check_number("learning_rate", self.learning_rate, 0.0, above=True, fix="5e-3 is usual")
        windows = self._windows(X, missing=False)
        self.classes_, codes = np.unique(np.asarray(y), return_inverse=True)
        self.n_features_in_ = windows.shape[1]
        data = from_arrays(
            windows,
            codes,
            groups=groups,
            classes=tuple(map(str, self.classes_)),
            test_fraction=0.2,
            seed=self.seed,
        )
        k, t = data.n_channels, data.n_time
        # Known readings help where readings recur; of a continuous sensor no reading ever does.
        levels = reading_levels(data.train_x) if t == 1 and readings_recur(data.train_x) else ()
        model = ModelConfig(
            self.model,
            n_sensors=k,
            n_times=t,
            n_classes=data.n_classes,
            encoder=EncoderConfig(features=self.features, levels=levels),
            gate_width=self.gate_width,
            head_widths=(self.head_width,),
            dropout=0.1,
        )
        protocol = random_failing(data.channels, k // 2 if self.n_clean is None else self.n_clean)
        noise = Corruption(protocol, protocol, self.kind)
        batch = min(self.batch_size, len(data.train_y))
        train = TrainConfig(epochs=self.epochs, batch_size=batch)
        key = jax.random.key(self.seed)
        state = fit(model, train, HyperParams(self.learning_rate), data, noise, key=key).state
        # The rows held out above are the calibration rows, not test rows of a report.
        rate = self.false_alarm_rate
        self.fitted_ = finish(model, state, data, noise, key=key, false_alarm_rate=rate)
        return self

    def predict_sensors(self, X: Any) -> Prediction:
        """Class probabilities, fusion weights and the state of every sensor."""
        check_is_fitted(self, "fitted_")
        fitted: FittedARGate = self.fitted_
        return fitted.predict(self._windows(X, missing=True))

    def predict_proba(self, X: Any) -> Float[np.ndarray, "n c"]:
        """Calibrated probabilities of the classes, in the order of `classes_`."""
        return self.predict_sensors(X).probabilities

    def predict(self, X: Any) -> np.ndarray:
        """The most probable class of each window."""
        probabilities = self.predict_proba(X)
        return self.classes_[probabilities.argmax(axis=1)]
