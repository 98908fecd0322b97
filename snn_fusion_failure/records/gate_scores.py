"""Scores of ways to trustworthy probabilities: one seed and row of the study of Bayesian gates."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

CHUNK = 512
CLASS_METRICS = ("accuracy", "nll", "ece", "brier", "aurc")
SCALED = (
    "argate_l",
    "argate_l_unsmoothed",
    "ensemble",
    "bayesian (samples)",
    "bayesian (one pass)",
)
"""Models that are also scored with a temperature from validation rows."""
LAPLACE_PRIORS = (1.0, 0.1)
SEEN_KINDS = ("uniform", "gaussian")

Found = tuple[np.ndarray, np.ndarray]
"""Class probabilities and fusion weights of all examples."""


def corrupted(x: Any, protocol: Any, kind: Any, *, key: Any) -> tuple[Any, Any]:
    """Windows with failed sensors, and which."""
    from fusion.failures import corrupt

    return jax.jit(corrupt, static_argnums=(0, 2))(protocol, jnp.asarray(x), kind, key=key)


def class_scores(probabilities: np.ndarray, labels: np.ndarray) -> dict[str, float]:
    """Accuracy %, and the scores of `fusion.predictive_scores`."""
    from fusion import predictive_scores as s

    right = probabilities.argmax(axis=1) == labels
    return {
        "accuracy": 100.0 * float(right.mean()),
        "nll": s.negative_log_likelihood(probabilities, labels),
        "ece": s.expected_calibration_error(probabilities, labels),
        "brier": s.brier_score(probabilities, labels),
        "aurc": s.aurc(probabilities.max(axis=1), right),
    }


def heated(probabilities: np.ndarray, temperature: float) -> np.ndarray:
    """Probabilities with their logarithms divided by a temperature."""
    logs = np.log(np.maximum(np.asarray(probabilities, np.float64), 1e-12)) / temperature
    logs -= logs.max(axis=1, keepdims=True)
    p = np.exp(logs)
    return p / p.sum(axis=1, keepdims=True)


def in_chunks(function: Callable[..., Any], x: Any) -> Found:
    """`function(windows, key=...)` on equal chunks, so that one program serves all sets."""
    parts: list[Found] = []
    for number, start in enumerate(range(0, len(x), CHUNK)):
        chunk = x[start : start + CHUNK]
        padded = jnp.concatenate([chunk, jnp.zeros((CHUNK - len(chunk), *x.shape[1:]))])
        found = function(padded, key=jax.random.fold_in(jax.random.key(0), number))
        kept = (np.asarray(part)[: len(chunk)] for part in (found.probabilities, found.weights))
        parts.append(tuple(kept))  # type: ignore[arg-type]
    return np.concatenate([p for p, _ in parts]), np.concatenate([w for _, w in parts])


def predictors(
    configs: Mapping[str, Any], mains: Mapping[str, Any], laplace: Any
) -> dict[str, Callable[..., Any]]:
    """Model -> function of windows and key that gives the predictive distribution."""
    from fusion import posteriors, uncertainty
    from fusion.models import predict

    plain, bayes = configs["argate_l"], configs["bayesian"]

    def softmax(x: Any, *, key: Any, name: str = "argate_l") -> Any:
        out = _predict(configs[name], mains[name], x)
        p = jax.nn.softmax(out.logits, axis=-1)
        return uncertainty.Predictive(p, out.weights, out.weights, out.weights, p[:, 0], p[:, 0])

    _predict = jax.jit(predict, static_argnums=0)
    dropout = jax.jit(posteriors.dropout_predictive, static_argnums=0)
    around = jax.jit(posteriors.laplace_predictive, static_argnums=0)
    mixture = jax.jit(posteriors.ensemble_predictive, static_argnums=0)
    draw = jax.jit(uncertainty.sample_predictive, static_argnums=0)
    once = jax.jit(uncertainty.one_pass_predictive, static_argnums=0)
    main = mains["argate_l"]
    found: dict[str, Callable[..., Any]] = {
        "argate_l": softmax,
        "mc_dropout": lambda x, *, key: dropout(plain, main, x, key=key),
        "laplace": lambda x, *, key: around(plain, main, laplace, x, key=key),
        "bayesian (samples)": lambda x, *, key: draw(bayes, mains["bayesian"], x, key=key),
        "bayesian (one pass)": lambda x, *, key: once(bayes, mains["bayesian"], x),
    }
    if "argate_l_unsmoothed" in mains:
        found["argate_l_unsmoothed"] = functools.partial(softmax, name="argate_l_unsmoothed")
    if "ensemble" in mains:
        found["ensemble"] = lambda x, *, key: mixture(plain, mains["ensemble"], x)
    return found


def fit_gaussian(config: Any, main: Any, dataset: Any, noise: Any, *, key: Any) -> Any:
    """Laplace's Gaussian with the prior that is likeliest on validation rows."""
    from fusion import posteriors

    x, _ = corrupted(dataset.train_x, noise.train, noise.kind, key=jax.random.fold_in(key, 11))
    seen, _ = corrupted(dataset.test_x, noise.test, noise.kind, key=jax.random.fold_in(key, 12))
    around = jax.jit(posteriors.laplace_predictive, static_argnums=0)
    found = []
    for prior in LAPLACE_PRIORS:
        fitted = posteriors.fit_laplace(config, main, x, prior=prior)
        p, _ = in_chunks(lambda x, *, key, f=fitted: around(config, main, f, x, key=key), seen)
        found.append((class_scores(p, dataset.test_y)["nll"], prior, fitted))
    return min(found, key=lambda one: one[0])[2]


def auroc_of(scores: np.ndarray, failed: np.ndarray) -> float:
    """Chance that a failed sensor scores above a working one, all windows and sensors together."""
    from fusion.evaluate import auroc

    return auroc(scores[failed], scores[~failed])


def told_the_kind(train: tuple[Any, Any, Any], test: tuple[Any, Any]) -> np.ndarray:
    """Scores of boosted trees that were trained on the kind of the test: the bound of a detector.

    Args:
        train: windows, class probabilities and mask; test: windows and class probabilities.
    """
    from sklearn.ensemble import HistGradientBoostingClassifier

    from fusion.failure_odds import window_statistics

    statistics = jax.jit(window_statistics)

    def inputs(x: Any, classes: np.ndarray) -> np.ndarray:
        s = np.asarray(statistics(x))
        n, k, _ = s.shape
        # Of the sensor, of all sensors, the classes, and which sensor it is.
        whole = np.broadcast_to(s.reshape(n, 1, -1), (n, k, s[0].size))
        shares = np.broadcast_to(classes[:, None], (n, k, classes.shape[1]))
        which = np.broadcast_to(np.arange(k)[None, :, None], (n, k, 1))
        return np.concatenate([s, whole, shares, which], axis=-1).reshape(n * k, -1)

    x, classes, failed = train
    keep = np.random.default_rng(0).permutation(failed.size)[:12000]
    trees = HistGradientBoostingClassifier(max_iter=60, random_state=0)
    trees.fit(inputs(x, classes)[keep], failed.reshape(-1)[keep])
    shape = test[0].shape[:2]
    return np.asarray(trees.predict_proba(inputs(*test))[:, 1]).reshape(shape)


def detectors(
    configs: Any, mains: Any, dataset: Any, noise: Any, others: tuple[str, ...], kind: str,
    x: Any, classes: Any, mask: Any, predictor: Any, *, key: Any,
) -> dict[str, dict[str, float]]:  # fmt: skip
    """Scores of what tells failed sensors: fitted without the kind of the test, and with it alone.

    Args:
        others: kinds that the calibration sees; kind: of the test.
        x, classes, mask: test windows, class probabilities there, and which sensors failed.
        predictor: gives class probabilities of other windows.
    """
    from fusion import failure_odds, monitor
    from fusion.models import predict

    protocol = noise.test
    seen, told = corrupted(
        dataset.test_x, protocol, others if len(others) > 1 else others[0],
        key=jax.random.fold_in(key, 13),
    )  # fmt: skip
    model = failure_odds.fit_working(
        jnp.asarray(dataset.train_x), dataset.train_y, dataset.n_classes
    )
    model = failure_odds.calibrate_failures(
        model, seen, jnp.asarray(in_chunks(predictor, seen)[0]), told
    )
    odds = jax.jit(failure_odds.failure_odds)
    found = {"working model": np.asarray(odds(model, x, jnp.asarray(classes)))}
    config, main = configs["argate_l"], mains["argate_l"]
    fitted = monitor.fit_monitor(
        config, main, dataset.test_x, key=jax.random.fold_in(key, 14), kinds=SEEN_KINDS
    )
    features = jax.jit(predict, static_argnums=0)(config, main, x).features
    found["monitor, seen kinds"] = np.asarray(monitor.failure_probability(fitted, features))
    own, own_mask = corrupted(dataset.train_x, protocol, kind, key=jax.random.fold_in(key, 15))
    own_classes, _ = in_chunks(predictor, own)
    found["told the kind (bound)"] = told_the_kind(
        (own, own_classes, np.asarray(own_mask)), (x, classes)
    )
    scores = {}
    for name, p in found.items():
        two = np.stack([1.0 - p.ravel(), p.ravel()], axis=1)
        scores[name] = {
            "failed_auroc": auroc_of(p, mask),
            "failed_ece": class_scores(two, mask.ravel().astype(int))["ece"],
        }
    return scores
