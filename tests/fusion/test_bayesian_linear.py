"""Bayesian linear regression against the textbook's matrices."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion import bayesian_linear


def test_conjugate_baseline_is_the_textbook_posterior() -> None:
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


def test_unequal_rows_are_refused() -> None:
    with pytest.raises(ValueError, match=r"y.shape\[0\]=4: expected the 3 rows of x, at least 2"):
        bayesian_linear.fit_linear(jnp.zeros((3, 1)), jnp.zeros((4, 1)))
