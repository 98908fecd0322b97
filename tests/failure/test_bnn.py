import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from failure import bayesian_linear, bnn

CONFIG = bnn.BNNConfig(hidden=8, steps=1500)


@pytest.fixture(scope="module")
def nuts(golden):
    record = json.loads((golden / "failure_bnn.json").read_text())
    return {k: np.asarray(v, np.float32) for k, v in record.items() if isinstance(v, list)}


@pytest.fixture(scope="module")
def fitted(nuts):
    fit = jax.jit(bnn.fit, static_argnums=0)
    return fit(
        CONFIG, bnn.BNNTrainParams(), jnp.asarray(nuts["x"]), jnp.asarray(nuts["y"]),
        key=jax.random.key(0),
    )  # fmt: skip


def truth(x):
    return np.stack([np.sin(1.5 * x[:, 0]) + 0.3 * x[:, 1], x[:, 1] * x[:, 2]], 1)


def rmse(a, b):
    return float(np.sqrt(np.mean((np.asarray(a) - np.asarray(b)) ** 2)))


def test_training_lowers_the_bound(fitted):
    _, losses = fitted
    assert losses[-50:].mean() < losses[:50].mean() - 0.5


def test_mean_field_predicts_nearly_as_well_as_nuts(fitted, nuts):
    params, _ = fitted
    target = truth(nuts["x_new"])
    ours = rmse(bnn.predict(params, jnp.asarray(nuts["x_new"])), target)
    oracle = rmse(nuts["mean"], target)
    constant = rmse(nuts["y"].mean(0), target)
    assert ours < oracle + 0.25 * (constant - oracle)


def test_samples_spread_around_the_mean_like_the_oracle_within_mean_field_limits(fitted, nuts):
    params, _ = fitted
    x = jnp.asarray(nuts["x_new"])
    draws = bnn.sample(params, x, 400, key=jax.random.key(1))
    assert draws.shape == (400, 40, 2)
    assert rmse(draws.mean(0), bnn.predict(params, x)) < 0.1
    # mean-field posteriors are narrower than the true one, but not collapsed
    ratio = float(jnp.mean(draws.std(0))) / float(nuts["sd"].mean())
    assert 0.2 < ratio < 1.5


def test_conjugate_baseline_is_the_textbook_posterior():
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        x = rng.normal(size=(50, 3))
        weights = rng.normal(size=(4, 2))
        phi = np.concatenate([x, np.ones((50, 1))], 1)
        y = phi @ weights + 0.1 * rng.normal(size=(50, 2))
        posterior = bayesian_linear.fit_linear(jnp.asarray(x), jnp.asarray(y), prior_variance=4.0)
        # the covariance gives the noise back: S = (Phi' Phi / s2 + I / 4)^-1
        noise = 0.01
        for _ in range(50):
            s = np.linalg.inv(phi.T @ phi / noise + np.eye(4) / 4.0)
            mean = s @ phi.T @ y / noise
            effective = np.trace(phi.T @ phi @ s) / noise
            noise = np.mean(np.sum((y - phi @ mean) ** 2, 0)) / (50 - effective)
        np.testing.assert_allclose(posterior.mean, mean, rtol=1e-6)
        np.testing.assert_allclose(posterior.covariance, s, rtol=1e-6, atol=1e-12)
        predicted, variance = bayesian_linear.predict_linear(posterior, jnp.asarray(x[:5]))
        np.testing.assert_allclose(predicted, phi[:5] @ mean, rtol=1e-6)
        np.testing.assert_allclose(variance, np.sum(phi[:5] @ s * phi[:5], 1), rtol=1e-6)
        draws = bayesian_linear.sample_linear(
            posterior, jnp.asarray(x[:5]), 4000, key=jax.random.key(0)
        )
        np.testing.assert_allclose(draws.mean(0), predicted, atol=0.01)
        np.testing.assert_allclose(draws.std(0)[:, 0], np.sqrt(variance), rtol=0.1)


def test_unequal_rows_are_refused():
    with pytest.raises(ValueError, match="x has 3 rows and y 4"):
        bayesian_linear.fit_linear(jnp.zeros((3, 1)), jnp.zeros((4, 1)))
