"""ARGate as a scikit-learn classifier and regressor; needs the extra `sklearn`."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from fusion import sensor_network
from fusion._checks import check_choice, check_count, check_number
from fusion.config import MODELS, HyperParams, ModelConfig, TrainConfig
from fusion.data import from_arrays
from fusion.data.csv_folder import assemble
from fusion.encoders import EncoderConfig, reading_levels, readings_recur
from fusion.failures import Protocol, no_failure, random_failing
from fusion.fitted import FittedARGate, Prediction, finish
from fusion.fitted_sensors import FittedSensors, SensorPrediction, finish_sensors
from fusion.loop import Corruption, fit

try:
    from sklearn.base import BaseEstimator, ClassifierMixin, MultiOutputMixin, RegressorMixin
    from sklearn.utils.multiclass import check_classification_targets
    from sklearn.utils.validation import check_is_fitted, column_or_1d, validate_data
except ImportError as error:
    raise ImportError(
        "fusion.estimator needs scikit-learn: pip install 'snn-fusion-failure[sklearn]'"
    ) from error


class _Sensors(BaseEstimator):
    """Windows of sensors as scikit-learn sees them: columns, or columns of samples."""

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.three_d_array = True
        return tags

    def _windows(self, X: Any, *, missing: bool, fitting: bool, y: Any = None) -> Any:
        given: dict[str, Any] = {
            "allow_nd": True,
            "ensure_all_finite": "allow-nan" if missing else True,
            "dtype": np.float64,
            "ensure_min_samples": 2 if fitting else 1,
            "reset": fitting,
        }
        if fitting:
            array, y = validate_data(self, X, y, multi_output=True, y_numeric=False, **given)
        else:
            array = validate_data(self, X, **given)
        windows = array[:, :, None] if array.ndim == 2 else array
        if windows.ndim != 3:
            raise ValueError(
                f"X.shape={array.shape}: expected [rows, sensors] or [rows, sensors, samples]; "
                "bring X to it"
            )
        return (windows, y) if fitting else windows


def _protocol(channels: tuple[str, ...], n_clean: int | None) -> Protocol:
    """Which sensors fail in training; a single one has no other to stand in for it."""
    if len(channels) == 1 and n_clean is None:
        return no_failure(channels)
    return random_failing(channels, len(channels) // 2 if n_clean is None else n_clean)


class ARGateClassifier(ClassifierMixin, _Sensors):
    """Gated sensor fusion that is trained on failing sensors, with scikit-learn's interface.

    `X` is `[N, K, T]`, windows of T samples of K sensors, or `[N, K]`, one reading of each sensor
    (a column is a sensor). In `predict` NaN means that a sensor sent nothing, so scikit-learn's
    `check_estimators_nan_inf`, which wants it refused there, does not apply.

    Args:
        model: a name in `fusion.MODELS` other than `oracle`, which would have to be told failures.
        n_clean: sensors that keep working in two thirds of the training rows; half when None. A
            single sensor never fails in training: no other could stand in for it.
        kind: how the others fail, see `fusion.failure_kinds.FAILURE_KINDS`.
        epochs, batch_size, learning_rate: of the training.
        features, gate_width, head_width: sizes of the network.
        false_alarm_rate: of the sensors called failed, see `predict_sensors`; 0.05 when None, or
            one of the calibration rows where these are too few for it.
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
        false_alarm_rate: float | None = None,
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

    def fit(self, X: Any, y: Any, groups: Any = None) -> ARGateClassifier:
        """Train on raw windows; a fifth of the rows (or groups) calibrates the probabilities.

        Raises:
            ValueError: what does not fit, with what to do.
        """
        check_count("seed", self.seed, 0)
        check_number("learning_rate", self.learning_rate, 0.0, above=True, fix="5e-3 is usual")
        # An oracle would train on masks of failures that nobody gives it in `predict`.
        check_choice("model", self.model, [name for name in MODELS if name != "oracle"])
        windows, y = self._windows(X, missing=False, fitting=True, y=y)
        check_classification_targets(y)
        if np.ndim(y) == 2:
            y = column_or_1d(y, warn=True)
        self.classes_, codes = np.unique(y, return_inverse=True)
        if len(self.classes_) < 2:
            raise ValueError(f"y={self.classes_}: expected more than 1 class; give rows of others")
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
        protocol = _protocol(data.channels, self.n_clean)
        noise = Corruption(protocol, protocol, self.kind)
        batch = min(self.batch_size, len(data.train_y))
        train = TrainConfig(epochs=self.epochs, batch_size=batch)
        key = jax.random.key(self.seed)
        state = fit(model, train, HyperParams(self.learning_rate), data, noise, key=key).state
        # The rows held out above are the calibration rows, not test rows of a report.
        rate = self.false_alarm_rate
        rate = max(0.05, 1.0 / len(data.test_y)) if rate is None else rate
        self.fitted_ = finish(model, state, data, noise, key=key, false_alarm_rate=rate)
        return self

    def predict_sensors(self, X: Any) -> Prediction:
        """Class probabilities, fusion weights and the state of every sensor."""
        check_is_fitted(self, "fitted_")
        fitted: FittedARGate = self.fitted_
        return fitted.predict(self._windows(X, missing=True, fitting=False))

    def predict_proba(self, X: Any) -> Float[np.ndarray, "n c"]:
        """Calibrated probabilities of the classes, in the order of `classes_`."""
        return self.predict_sensors(X).probabilities

    def predict(self, X: Any) -> np.ndarray:
        """The most probable class of each window."""
        probabilities = self.predict_proba(X)
        return self.classes_[probabilities.argmax(axis=1)]


class ARGateRegressor(MultiOutputMixin, RegressorMixin, _Sensors):
    """Gated sensor fusion for numbers, trained on failing sensors, with scikit-learn's interface.

    `X` is `[N, K, T]`, windows of T samples of K sensors, or `[N, K]`, one reading of each sensor
    (a column is a sensor); NaN, in training too, means that a sensor sent nothing. `y` is `[N]` or
    `[N, M]` in its own units.

    Args:
        model: one of `fusion.sensor_network.RECIPES`.
        n_clean: sensors that keep working in two thirds of the training rows; half when None. A
            single sensor never fails in training: no other could stand in for it.
        kind: how the others fail, see `fusion.failure_kinds.FAILURE_KINDS`.
        epochs, batch_size, learning_rate: of the training.
        features, width: sizes of the network.
        seed: of everything random.

    Attributes (after `fit`):
        fitted_: the `FittedSensors`, to be saved with `fitted_.save(path)`.
        n_features_in_: as scikit-learn has it.
    """

    def __init__(
        self,
        model: str = "argate_plus",
        n_clean: int | None = None,
        kind: str = "uniform",
        epochs: int = 30,
        batch_size: int = 32,
        learning_rate: float = 5e-3,
        features: int = 16,
        width: int = 32,
        seed: int = 0,
    ) -> None:
        self.model = model
        self.n_clean = n_clean
        self.kind = kind
        self.epochs = epochs
        self.batch_size = batch_size
        self.learning_rate = learning_rate
        self.features = features
        self.width = width
        self.seed = seed

    def fit(self, X: Any, y: Any) -> ARGateRegressor:
        """Train on raw windows.

        Raises:
            ValueError: what does not fit, with what to do.
        """
        check_count("seed", self.seed, 0)
        windows, y = self._windows(X, missing=True, fitting=True, y=y)
        target = np.asarray(y, np.float64)
        self._flat = target.ndim == 1
        target = target.reshape(len(target), -1)
        n, k, _ = windows.shape
        sensors = tuple(f"sensor_{s}" for s in range(k))
        names = tuple(f"y{column}" for column in range(target.shape[1]))
        rows = np.ones(n, bool)
        data = assemble(
            {"sensors": {s: (s,) for s in sensors}, "target": {"kind": "numbers"}},
            names, np.arange(n), self._readings(windows), target, rows, ~rows,
        )  # fmt: skip
        config = sensor_network.FolderConfig(
            self.model,
            features=self.features,
            width=self.width,
            epochs=self.epochs,
            batch_size=self.batch_size,
            learning_rate=self.learning_rate,
        )
        protocol = _protocol(sensors, self.n_clean)
        key = jax.random.key(self.seed)
        trained = sensor_network.fit(config, data, protocol, self.kind, key=key)
        self.fitted_ = finish_sensors(config, trained.params, data)
        return self

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = True
        return tags

    @staticmethod
    def _readings(windows: np.ndarray) -> list[np.ndarray]:
        return [windows[:, k : k + 1] for k in range(windows.shape[1])]

    def predict_sensors(self, X: Any) -> SensorPrediction:
        """Numbers, fusion weights, and which sensors are absent or out of range."""
        check_is_fitted(self, "fitted_")
        fitted: FittedSensors = self.fitted_
        return fitted.predict(self._readings(self._windows(X, missing=True, fitting=False)))

    def predict(self, X: Any) -> np.ndarray:
        """The numbers of each row, `[N]` or `[N, M]` as in training."""
        output = self.predict_sensors(X).output
        return output[:, 0] if self._flat else output
