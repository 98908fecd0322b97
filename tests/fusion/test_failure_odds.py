"""Failed sensors told without knowing how they fail: statistics, densities, calibration."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from fusion.evaluate import auroc
from fusion.failure_kinds import apply_failure
from fusion.failure_odds import (
    FLOOR,
    SHARED,
    calibrate_failures,
    failure_odds,
    fit_working,
    novelty,
    window_statistics,
)

pytestmark = pytest.mark.relaxed

RNG = np.random.default_rng(0)
N, K, T = 400, 2, 32
Y = RNG.integers(0, 2, N)
TIME = np.arange(T) / T


def windows(y: np.ndarray) -> jax.Array:
    """Waves whose frequency tells the class, with a phase and noise of their own."""
    n = len(y)
    phase = RNG.uniform(0.0, 2.0 * np.pi, (n, K, 1))
    waves = 0.5 * np.sin(2.0 * np.pi * (2.0 + 3.0 * y[:, None, None]) * TIME + phase)
    return jnp.asarray(waves + 0.05 * RNG.normal(size=(n, K, T)), jnp.float32)


X = windows(Y)
CLASSES = jnp.asarray(np.eye(2)[Y], jnp.float32)
MODEL = fit_working(X, Y, 2)


def test_statistics_are_those_of_numpy() -> None:
    x = np.asarray(X[3, 1], np.float64)
    step, s = np.diff(x), x.std()
    wanted = [x.mean(), np.log(s + 1e-4), np.log(step.std() + 1e-4)]
    wanted += [np.log(np.abs(x).max() + 1e-4), x[-4:].mean() - x[:4].mean(), 0.0]
    lag = np.mean((x[1:] - x.mean()) * (x[:-1] - x.mean())) / (s**2 + 1e-4)
    found = jax.jit(window_statistics)(X)[3, 1]
    np.testing.assert_allclose(found, [*wanted, lag], atol=1e-4)
    half = X.at[:, :, 16:].set(0.25)
    np.testing.assert_allclose(window_statistics(half)[:, :, 5], 15 / 31, atol=1e-6)
    with pytest.raises(ValueError, match="expected windows of at least 8 samples"):
        window_statistics(X[:, :, :4])


def test_novelty_is_the_log_density_of_the_mixture() -> None:
    s = np.asarray(window_statistics(X), np.float64)[:, 0]
    means = [s[c == Y].mean(0) for c in (0, 1)]
    rest = s - np.stack(means)[Y]
    pooled = rest.T @ rest / N
    p, dens = np.array([0.3, 0.7]), []
    for c in (0, 1):
        own = rest[c == Y].T @ rest[c == Y] / np.sum(c == Y)
        floor = np.diag(np.maximum(FLOOR**2 * np.diag(pooled), 1e-8))
        cov = (1 - SHARED) * own + SHARED * pooled + floor
        dens.append(stats.multivariate_normal(means[c], cov).pdf(s[:5]))
    wanted = -np.log(p @ np.stack(dens)) - 0.5 * 7 * np.log(2 * np.pi)
    shares = jnp.tile(jnp.asarray(p, jnp.float32), (5, 1))
    found = jax.jit(novelty)(MODEL, X[:5], shares)
    np.testing.assert_allclose(found[:, 0], wanted, atol=5e-2)


@pytest.mark.parametrize("kind", ["stuck", "zero", "dropout", "gain", "drift"])
def test_kinds_that_nothing_was_fitted_to_are_told(kind: str) -> None:
    y = RNG.integers(0, 2, 300)
    mask = jnp.asarray(RNG.random((300, K)) < 0.5)
    x = apply_failure(windows(y), mask, kind, key=jax.random.key(1))
    classes = jnp.asarray(np.eye(2)[y], jnp.float32)
    found, failed = np.asarray(failure_odds(MODEL, x, classes)), np.asarray(mask)
    assert auroc(found[failed], found[~failed]) > 0.85


def test_calibrated_on_one_kind_the_probability_is_right_for_it_and_keeps_the_order() -> None:
    mask = RNG.random((N, K)) < 0.3
    x = apply_failure(windows(Y), jnp.asarray(mask), "gain", key=jax.random.key(2))
    fitted = calibrate_failures(MODEL, x, CLASSES, mask)
    p = np.asarray(jax.jit(failure_odds)(fitted, x, CLASSES))
    # At the optimum of the logistic loss the mean probability is the share of failures.
    assert p.mean() == pytest.approx(mask.mean(), abs=0.01)
    before = np.asarray(novelty(MODEL, x, CLASSES))
    for k in range(K):
        assert (np.diff(p[np.argsort(before[:, k]), k]) >= 0.0).all()
    assert 0.0 < float(fitted.slope) < 20.0


def test_an_absent_sensor_has_failed_and_the_others_are_judged_as_before() -> None:
    gone = X.at[0, 1, 3].set(jnp.nan)
    found, before = (failure_odds(MODEL, x, CLASSES) for x in (gone, X))
    assert float(found[0, 1]) == 1.0
    np.testing.assert_array_equal(found[:, 0], before[:, 0])


def test_what_cannot_be_calibrated_is_refused() -> None:
    for mask in (np.zeros((N, K), bool), np.ones((N, K), bool)):
        with pytest.raises(ValueError, match="expected working windows of every sensor"):
            calibrate_failures(MODEL, X, CLASSES, mask)
    with pytest.raises(ValueError, match="x=array with 5 windows"):
        fit_working(X[:5], Y[:5], 2)
