from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from failure.models import acquisition, candidates, gp, gp_fit
from failure.models.domains import ball, box, project


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def exact_log_h(z):
    """log(phi + z Phi) through erfcx, which does not underflow (z < 0)."""
    tail = special.erfcx(-z / np.sqrt(2)) * np.sqrt(np.pi / 2)
    return -0.5 * z * z - 0.5 * np.log(2 * np.pi) + np.log1p(z * tail)


def test_log_h_against_erfcx_and_its_own_limits():
    z = np.concatenate([np.linspace(-24.9, -0.1, 60), [-25.1, -30.0, -60.0]])
    np.testing.assert_allclose(acquisition.log_h(jnp.asarray(z)), exact_log_h(z), rtol=1e-10)
    high = np.array([0.0, 1.0, 5.0, 40.0])
    phi = np.exp(-0.5 * high**2) / np.sqrt(2 * np.pi)
    np.testing.assert_allclose(
        acquisition.log_h(jnp.asarray(high)), np.log(phi + high * special.ndtr(high)), rtol=1e-13
    )
    # leading term far out: -z^2/2 - log sqrt(2 pi) - 2 log|z|
    far = float(acquisition.log_h(jnp.asarray(-1e4)))
    assert np.isclose(far, -0.5e8 - 0.5 * np.log(2 * np.pi) - 2 * np.log(1e4), rtol=1e-12)


def test_log_h_slope_is_finite_and_right_everywhere():
    z = jnp.asarray([-1e4, -300.0, -26.0, -24.0, -3.0, -1.0, 0.0, 4.0])
    slope = jax.vmap(jax.grad(acquisition.log_h))(z)
    step = 1e-6 * (1 + jnp.abs(z))
    numeric = (acquisition.log_h(z + step) - acquisition.log_h(z - step)) / (2 * step)
    np.testing.assert_allclose(slope, numeric, rtol=2e-6)


def test_confidence_bound_and_the_weighted_family():
    mean, sd = jnp.asarray([1.0, 2.0]), jnp.asarray([0.5, 0.1])
    np.testing.assert_allclose(acquisition.confidence_bound(mean, sd, 2.0), [2.0, 2.2])
    np.testing.assert_allclose(acquisition.weighted(mean, sd, jnp.asarray(0.0)), mean)
    np.testing.assert_allclose(acquisition.weighted(mean, sd, jnp.asarray(1.0)), sd)
    np.testing.assert_allclose(acquisition.pbo_weights(5), [0, 0.25, 0.5, 0.75, 1])


@pytest.fixture(scope="module")
def surrogate():
    with jax.enable_x64(True):
        rng = np.random.default_rng(3)
        x = np.zeros((32, 3))
        x[:24] = rng.uniform(-0.5, 0.5, (24, 3))
        y = np.sin(3 * x[:, 0]) - (x[:, 1] - 0.2) ** 2 + 0.3 * x[:, 2]
        y[:24] = (y[:24] - y[:24].mean()) / y[:24].std(ddof=1)
        config = gp.GPConfig()
        params = gp_fit.initial_params(config, 3)
        posterior = gp.condition(
            config, params, jnp.asarray(x), jnp.asarray(y), jnp.asarray(24, jnp.int32)
        )
        return config, posterior, float(y[:24].max())


def brute_force(config, posterior, value, n=200_000):
    points = jnp.asarray(np.random.default_rng(0).uniform(-0.5, 0.5, (n, 3)))
    mean, variance = gp.predict(config, posterior, points)
    return float(jnp.max(value(mean, jnp.sqrt(variance))))


@pytest.mark.slow
def test_ascent_beats_a_dense_random_search(surrogate):
    config, posterior, best = surrogate
    acq = acquisition.AcquisitionConfig(n_raw=64, n_restarts=4)
    domain = box(jnp.full((3,), -0.5), jnp.full((3,), 0.5))
    raw = candidates.raw_points(domain, posterior.x[:4], 64, key=jax.random.key(0))
    assert raw.shape == (64, 3) and bool(jnp.all(jnp.abs(raw) <= 0.5))
    point, value = jax.jit(partial(candidates.propose, config, acq))(
        posterior, domain, jnp.asarray(best), raw
    )
    assert bool(jnp.all(jnp.abs(point) <= 0.5))
    found = brute_force(config, posterior, lambda m, s: acquisition.log_ei(m, s, jnp.asarray(best)))
    assert float(value[0]) >= found - 1e-9
    mean, variance = gp.predict(config, posterior, point)
    np.testing.assert_allclose(
        value, acquisition.log_ei(mean, jnp.sqrt(variance), jnp.asarray(best)), rtol=1e-9
    )


@pytest.mark.slow
def test_a_pbo_batch_runs_from_exploitation_to_exploration_inside_a_ball(surrogate):
    config, posterior, best = surrogate
    acq = acquisition.AcquisitionConfig(name="pbo", batch_size=3, n_raw=64, n_restarts=3)
    domain = ball(3, 0.6)
    raw = candidates.raw_points(domain, posterior.x[:4], 64, key=jax.random.key(0))
    points, values = jax.jit(partial(candidates.propose, config, acq))(
        posterior, domain, jnp.asarray(best), raw
    )
    assert points.shape == (3, 3)
    assert bool(jnp.all(jnp.linalg.norm(points, axis=1) <= 0.6 + 1e-9))
    mean, variance = gp.predict(config, posterior, points)
    np.testing.assert_allclose(values[0], mean[0], rtol=1e-9)
    np.testing.assert_allclose(values[2], jnp.sqrt(variance[2]), rtol=1e-9)
    assert mean[0] >= mean.max() - 1e-9 and variance[2] >= variance.max() - 1e-9


def test_projection_on_a_ball_keeps_the_direction():
    domain = ball(2, 1.0)
    np.testing.assert_allclose(project(domain, jnp.asarray([3.0, 4.0])), [0.24 / 0.4, 0.8])
    np.testing.assert_allclose(project(domain, jnp.asarray([0.3, -0.4])), [0.3, -0.4])


def test_bad_configurations():
    with pytest.raises(ValueError, match="name='ei'"):
        acquisition.AcquisitionConfig(name="ei")
    with pytest.raises(ValueError, match="batch_size=0: expected at least 1"):
        acquisition.AcquisitionConfig(batch_size=0)
    with pytest.raises(ValueError, match="n_restarts=9"):
        acquisition.AcquisitionConfig(n_raw=8, n_restarts=9)


@pytest.mark.parametrize(
    ("mean", "sd", "best"), [(1.0, 2.0, 0.5), (-1.0, 0.25, 0.5), (3.0, 0.1, 3.0)]
)
def test_log_ei_is_the_logarithm_of_the_closed_form(mean, sd, best):
    z = (mean - best) / sd
    density = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    wanted = np.log((mean - best) * special.ndtr(z) + sd * density)
    with jax.enable_x64(True):
        got = acquisition.log_ei(jnp.asarray(mean), jnp.asarray(sd), jnp.asarray(best))
    np.testing.assert_allclose(got, wanted, rtol=1e-9)
