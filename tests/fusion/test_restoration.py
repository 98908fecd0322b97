"""A failed sensor restored from the others: a known relation, intervals, and bad input."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.reversible import blocks
from fusion.reversible.config import ReversibleConfig
from fusion.reversible.restoration import (
    draw_rows,
    fit_restoration,
    restore_windows,
    restored_rows,
    rows_to_windows,
    spread_of_others,
    trunk_rows,
)

TRUNK = ReversibleConfig((2, 2), channels=4, depths=(2, 2), hidden=(3, 3), taps=(3, 3))
PARAMS = blocks.init(jax.random.key(0), TRUNK, 3)


def related(n: int, seed: int) -> np.ndarray:
    """Windows of three sensors; the third is the first two mixed, and noise of 0.05."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 3, 8)).astype(np.float32)
    x[:, 2] = 0.7 * x[:, 0] - 0.3 * x[:, 1, ::-1] + 0.05 * x[:, 2]
    return x


def test_rows_hold_the_windows() -> None:
    x = jnp.asarray(related(5, 0))
    rows = jax.jit(lambda x: trunk_rows(TRUNK, PARAMS, x))(x)
    assert rows.shape == (5, 3, 16)  # twice as many channels as samples
    for sensor in range(3):
        back = rows_to_windows(TRUNK, PARAMS, rows[:, sensor], sensor)
        np.testing.assert_allclose(back, x[:, sensor], atol=1e-5)


def test_a_linear_gaussian_relation_is_found_with_its_spread() -> None:
    """y = A x + e: mean, covariance of the noise and draws are those that made the rows."""
    rng = np.random.default_rng(1)
    a = rng.normal(size=(4, 2))
    mix = np.array([[0.5, 0.0], [0.3, 0.2]])

    def rows(n: int) -> tuple:
        x = rng.normal(size=(n, 4)) * [1.0, 5.0, 0.1, 2.0] + 3.0
        y = x @ a + rng.normal(size=(n, 2)) @ mix.T
        return jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32)

    found = jax.jit(fit_restoration)(*rows(4000))
    x, y = rows(500)
    mean, variance = restored_rows(found, x)
    np.testing.assert_allclose(mean, np.asarray(x) @ a, atol=0.1)
    assert float(variance.max()) < 0.02
    scale = np.asarray(found.scale_out)[:, None] * np.asarray(found.factor)
    np.testing.assert_allclose(scale @ scale.T, mix @ mix.T, atol=0.02)
    drawn = np.asarray(draw_rows(found, x, 200, key=jax.random.key(2)))
    low, high = np.quantile(drawn, [0.05, 0.95], axis=0)
    assert np.mean((y >= low) & (y <= high)) == pytest.approx(0.9, abs=0.04)


def test_residuals_of_held_rows_set_the_spread() -> None:
    rng = np.random.default_rng(3)
    x = jnp.asarray(rng.normal(size=(300, 2)), jnp.float32)
    noise = jnp.asarray(rng.normal(size=(300, 1)), jnp.float32)
    line = x[:, :1] - x[:, 1:]
    narrow = fit_restoration(x, line + 0.1 * noise)
    wide = spread_of_others(narrow, x, line + noise)
    spread = [float(r.factor[0, 0] * r.scale_out[0]) for r in (narrow, wide)]
    assert spread == pytest.approx([0.1, 1.0], rel=0.15)


def test_a_failed_sensor_comes_back_from_the_others() -> None:
    train, test = (jnp.asarray(related(n, s)) for n, s in ((1500, 4), (200, 5)))
    rows, seen = trunk_rows(TRUNK, PARAMS, train), trunk_rows(TRUNK, PARAMS, test)
    inputs = [r[:, :2].reshape(len(r), -1) for r in (rows, seen)]
    found = fit_restoration(inputs[0], rows[:, 2])
    restored = restore_windows(TRUNK, PARAMS, found, inputs[1], 2, key=jax.random.key(0))
    error = float(jnp.sqrt(jnp.mean((restored.mean - test[:, 2]) ** 2)))
    trivial = float(jnp.std(test[:, 2]))
    # The trunk bends a linear relation, so that a line finds most of it, not all.
    assert error < 0.4 * trivial
    inside = (test[:, 2] >= restored.low) & (test[:, 2] <= restored.high)
    assert float(jnp.mean(inside)) == pytest.approx(0.9, abs=0.06)


def test_bad_input_is_refused() -> None:
    x = jnp.zeros((5, 2))
    with pytest.raises(ValueError, match=r"y.shape\[0\]=4: expected the 5 rows of x"):
        fit_restoration(x, jnp.zeros((4, 1)))
    found = fit_restoration(x, x)
    with pytest.raises(ValueError, match="n_draws=0"):
        restore_windows(TRUNK, PARAMS, found, x, 0, key=jax.random.key(0), n_draws=0)
    with pytest.raises(ValueError, match=r"level=1\.0"):
        restore_windows(TRUNK, PARAMS, found, x, 0, key=jax.random.key(0), level=1.0)
