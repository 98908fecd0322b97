"""Calibrated models with the face of scikit-learn: `fit`, `predict`, `score`, `get_params`."""

from __future__ import annotations

import abc
import dataclasses
import inspect
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax

from fusion.lattice import premade
from fusion.lattice.checks import refusal, require_count
from fusion.lattice.features import Feature, together
from fusion.lattice.optimizer import with_projection
from fusion.lattice.premade import CalibratedConfig
from fusion.lattice.quantiles import quantile_keypoints
from fusion.lattice.subsets import random_features


class _Estimator(abc.ABC):
    """Settings are the arguments of `__init__`, what is learned has a trailing underscore."""

    def __init__(
        self,
        features: tuple[Feature, ...] | None = None,
        *,
        relations: tuple[tuple[Any, ...], ...] = (),
        kind: Literal["linear", "lattice", "ensemble"] = "lattice",
        n_output_keypoints: int = 10,
        n_keypoints: int = 10,
        lattice_size: int = 2,
        n_lattices: int = 8,
        rank: int = 3,
        learning_rate: float = 0.02,
        epochs: int = 100,
        batch_size: int = 128,
        seed: int = 0,
    ) -> None:
        self.features = features
        self.relations = relations
        self.kind = kind
        self.n_output_keypoints = n_output_keypoints
        self.n_keypoints = n_keypoints
        self.lattice_size = lattice_size
        self.n_lattices = n_lattices
        self.rank = rank
        self.learning_rate = learning_rate
        self.epochs = epochs
        self.batch_size = batch_size
        self.seed = seed

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The settings by name."""
        names = inspect.signature(type(self).__init__).parameters
        return {name: getattr(self, name) for name in names if name != "self"}

    def set_params(self, **settings: Any) -> Any:
        """Change settings; returns the estimator."""
        known = self.get_params()
        for name, value in settings.items():
            if name not in known:
                raise refusal("set_params", name, f"one of {sorted(known)}", "check the spelling")
            setattr(self, name, value)
        return self

    def _config(self, x: np.ndarray) -> CalibratedConfig:
        features = self.features
        if features is None:
            features = tuple(Feature(f"x{i}") for i in range(x.shape[1]))
        if len(features) != x.shape[1]:
            raise refusal("X.shape", x.shape, f"{len(features)} columns", "one for each feature")
        numbers = [i for i, f in enumerate(features) if f.n_categories is None]
        places = quantile_keypoints(x[:, numbers], self.n_keypoints) if numbers else ()
        made = list(features)
        for i, keypoints in zip(numbers, places, strict=True):
            made[i] = dataclasses.replace(features[i], keypoints=keypoints)
        subsets: tuple[tuple[int, ...], ...] = ()
        if self.kind == "ensemble":
            groups = together(made, self.relations)
            subsets = random_features(
                self.seed, len(made), self.n_lattices, self.rank, together=groups
            )
        return CalibratedConfig(
            tuple(made), self.kind, subsets, self.lattice_size, self.n_output_keypoints,
            missing=bool(np.isnan(x[:, numbers]).any()), relations=self.relations,
        )  # fmt: skip

    def _fit(self, x: Any, y: np.ndarray) -> None:
        for name in ("epochs", "batch_size"):
            require_count(name, getattr(self, name))
        x = _rows(x)
        if len(x) != len(y) or y.ndim != 1 or not np.isfinite(y).all():
            raise refusal("y.shape", y.shape, f"{len(x)} finite numbers", "one for each row of X")
        self.config_ = config = self._config(x)
        self.n_features_in_ = x.shape[1]
        size = min(self.batch_size, len(x))
        steps = self.epochs * max(1, len(x) // size)
        schedule = optax.cosine_decay_schedule(self.learning_rate, steps)
        optimizer = with_projection(optax.adam(schedule), lambda p: premade.project(config, p))
        rows, goal = jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32)
        start, draw = jax.random.split(jax.random.key(self.seed))
        params = premade.init(start, config)

        def loss(params: Any, chosen: jax.Array) -> jax.Array:
            return jnp.mean(self._loss(premade.apply(config, params, rows[chosen]), goal[chosen]))

        def step(carry: tuple[Any, Any], key: jax.Array) -> tuple[tuple[Any, Any], jax.Array]:
            params, state = carry
            chosen = jax.random.randint(key, (size,), 0, len(x))
            value, grads = jax.value_and_grad(loss)(params, chosen)
            updates, state = optimizer.update(grads, state, params)
            return (optax.apply_updates(params, updates), state), value

        @jax.jit
        def train(params: Any, keys: jax.Array) -> Any:
            return jax.lax.scan(step, (params, optimizer.init(params)), keys)

        # optax mixes types, which a caller's strict rules would forbid.
        with jax.numpy_dtype_promotion("standard"):
            (self.params_, _), losses = train(params, jax.random.split(draw, steps))
        self.losses_ = np.asarray(losses)

    def _raw(self, x: Any) -> np.ndarray:
        if not hasattr(self, "params_"):
            raise refusal("params_", None, "a fitted estimator", "call fit(X, y) first")
        rows = jnp.asarray(_rows(x), jnp.float32)
        return np.asarray(premade.apply(self.config_, self.params_, rows), np.float64)

    @abc.abstractmethod
    def _loss(self, found: jax.Array, goal: jax.Array) -> jax.Array:
        """Of each row, from the model's output and what it should be."""


def _rows(x: Any) -> np.ndarray:
    x = np.asarray(x, np.float64)
    if x.ndim != 2 or 0 in x.shape:
        raise refusal("X.shape", x.shape, "[n_rows, n_features]", "write X[:, None] for one column")
    return x


class LatticeRegressor(_Estimator):
    """A calibrated model fitted to numbers by least squares.

    Args:
        features: what is known of each column; `None` is a free number for each. Their keypoints
            are set to quantiles of the data.
        relations: between features by name, see `CalibratedConfig`.
        kind: "linear", "lattice" or "ensemble".
        n_output_keypoints: of the output calibrator; some relations need a straight one, 2.
        n_keypoints: keypoints of each calibrator.
        lattice_size: vertices along each axis of a lattice.
        n_lattices: lattices of an ensemble.
        rank: inputs of each lattice of an ensemble.
        learning_rate: of Adam, falling to 0 along a cosine.
        epochs: passes over the data.
        batch_size: rows of a step.
        seed: of the first parameters, the batches and the ensemble's subsets.

    Example:
        >>> x = np.linspace(0.0, 1.0, 50)[:, None]
        >>> model = LatticeRegressor((Feature("x", 1),), n_keypoints=5, epochs=60, batch_size=50)
        >>> model.fit(x, x[:, 0] ** 2).score(x, x[:, 0] ** 2) > 0.9
        True
    """

    def fit(self, X: Any, y: Any) -> LatticeRegressor:
        """Learn from rows `X` `[n, n_features]` and numbers `y` `[n]`; NaN in `X` is missing."""
        y = np.asarray(y, np.float64)
        low, high = float(np.min(y)), float(np.max(y))
        self.scale_ = (low, high - low if high > low else 1.0)
        self._fit(X, (y - self.scale_[0]) / self.scale_[1])
        return self

    def predict(self, X: Any) -> np.ndarray:
        """Numbers `[n]`."""
        return self._raw(X) * self.scale_[1] + self.scale_[0]

    def score(self, X: Any, y: Any) -> float:
        r"""Explained share of the variance, :math:`1 - \sum (y - f)^2 / \sum (y - \bar y)^2`."""
        y = np.asarray(y, np.float64)
        return float(1.0 - np.sum((y - self.predict(X)) ** 2) / np.sum((y - y.mean()) ** 2))

    def _loss(self, found: jax.Array, goal: jax.Array) -> jax.Array:
        return jnp.square(found - goal)


class LatticeClassifier(_Estimator):
    """A calibrated model of the log odds of two classes; arguments as in `LatticeRegressor`.

    Example:
        >>> x = np.linspace(0.0, 1.0, 40)[:, None]
        >>> model = LatticeClassifier((Feature("x", 1),), n_keypoints=5, epochs=90, batch_size=40)
        >>> model.fit(x, x[:, 0] > 0.5).predict([[0.1], [0.9]]).tolist()
        [False, True]
    """

    def fit(self, X: Any, y: Any) -> LatticeClassifier:
        """Learn from rows `X` `[n, n_features]` and labels `y` `[n]` of two classes."""
        labels = np.asarray(y)
        self.classes_ = np.unique(labels)
        if len(self.classes_) != 2:
            raise refusal(
                "y", self.classes_.tolist(), "labels of two classes", "fit one model for each pair"
            )
        self._fit(X, (labels == self.classes_[1]).astype(np.float64))
        return self

    def decision_function(self, X: Any) -> np.ndarray:
        """Log odds `[n]` of the second of `classes_`; the shape constraints hold for these."""
        return self._raw(X)

    def predict_proba(self, X: Any) -> np.ndarray:
        """Probabilities `[n, 2]` of `classes_`."""
        second = 1.0 / (1.0 + np.exp(-self._raw(X)))
        return np.stack([1.0 - second, second], axis=1)

    def predict(self, X: Any) -> np.ndarray:
        """The more probable class of each row."""
        return self.classes_[(self._raw(X) > 0).astype(int)]

    def score(self, X: Any, y: Any) -> float:
        """Share of rows whose class is right."""
        return float(np.mean(self.predict(X) == np.asarray(y)))

    def _loss(self, found: jax.Array, goal: jax.Array) -> jax.Array:
        return optax.sigmoid_binary_cross_entropy(found, goal)
