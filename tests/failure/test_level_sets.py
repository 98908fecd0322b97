"""Features learned from gradients: one bent coordinate in the place of many straight ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from failure import level_sets


def bent(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and gradients of a parabola along two oblique directions of five."""
    a, b = np.array([1.0, 2.0, 0.0, -1.0, 1.0]), np.array([1.0, 0.0, 1.0, 1.0, 0.0])
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return x @ a + 0.4 * (x @ b) ** 2, a[None] + 0.8 * (x @ b)[:, None] * b[None]


@pytest.mark.slow
def test_one_feature_holds_a_curved_output_and_the_map_can_be_undone() -> None:
    x = np.random.default_rng(0).normal(size=(100, 5))
    _, g = bent(x)
    found, shares = level_sets.fit(x, g, key=jax.random.key(0))
    # Straight coordinates hold two thirds at best, a bent one nearly all.
    assert shares[0] < 0.8 < 0.97 < shares[-1]
    new = np.random.default_rng(1).normal(size=(200, 5))
    with jax.enable_x64(True):
        z = np.asarray(level_sets.features(found, jnp.asarray(new)))
        back = np.asarray(level_sets.samples(found, jnp.asarray(z)))
    np.testing.assert_allclose(back, new, atol=1e-9)
    truth, _ = bent(new)
    rest = truth - np.polyval(np.polyfit(z[:, 0], truth, 3), z[:, 0])
    assert rest.var() < 0.1 * truth.var()


def test_a_linear_output_needs_no_network() -> None:
    """Before any training the rotation alone holds all of its gradient."""
    x = np.random.default_rng(0).normal(size=(20, 7))
    g = np.tile(np.arange(1.0, 8.0), (20, 1))
    found, shares = level_sets.fit(
        x, g, key=jax.random.key(0), config=level_sets.LevelSetConfig(depth=1, steps=1)
    )
    assert shares[0] > 0.99
    assert abs(found.rotation[:, 0] @ g[0]) == pytest.approx(np.linalg.norm(g[0]))


def test_bad_requests() -> None:
    x = np.ones((4, 3))
    with pytest.raises(ValueError, match="expected the same"):
        level_sets.fit(x, x[:, :2], key=jax.random.key(0))
    with pytest.raises(ValueError, match="at least one finite gradient"):
        level_sets.fit(x, 0.0 * x, key=jax.random.key(0))
    with pytest.raises(ValueError, match="n_active=5"):
        level_sets.fit(x, x, key=jax.random.key(0), config=level_sets.LevelSetConfig(n_active=5))
    with pytest.raises(ValueError, match="depth=0"):
        level_sets.LevelSetConfig(depth=0)
