import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from failure import rare_events

DIM = 60


def linear(x):
    slope = jnp.arange(1.0, DIM + 1.0)
    return x @ (slope / jnp.linalg.norm(slope))


def quadratic(x):
    return x[:, 0] + 0.02 * jnp.sum(x[:, 1:11] ** 2, 1)


def quadratic_truth(threshold):
    def inner(s):
        return stats.norm.sf(threshold - 0.02 * s) * stats.chi2.pdf(s, 10)

    return integrate.quad(inner, 0, 200, epsabs=0, epsrel=1e-10)[0]


def two_regions(x):
    return jnp.maximum(x[:, 0], 0.3 - x[:, 1])


def two_regions_truth(threshold):
    a, b = stats.norm.sf(threshold), stats.norm.sf(threshold - 0.3)
    return a + b - a * b


def unit(index, size):
    return size * np.eye(DIM)[index]


# problem, threshold, truth, most likely failure points
PROBLEMS = {
    "linear 1e-9": (
        linear,
        stats.norm.isf(1e-9),
        1e-9,
        [np.arange(1.0, 61.0) / np.linalg.norm(np.arange(1.0, 61.0)) * stats.norm.isf(1e-9)],
    ),
    "linear 1e-3": (
        linear,
        stats.norm.isf(1e-3),
        1e-3,
        [np.arange(1.0, 61.0) / np.linalg.norm(np.arange(1.0, 61.0)) * stats.norm.isf(1e-3)],
    ),
    "quadratic": (quadratic, 6.0, quadratic_truth(6.0), [unit(0, 6.0)]),
    "two regions": (two_regions, 5.5, two_regions_truth(5.5), [unit(0, 5.5), -unit(1, 5.2)]),
}


def test_probabilities_reach_down_to_1e_9():
    assert PROBLEMS["linear 1e-9"][2] == 1e-9
    assert 1e-9 < PROBLEMS["quadratic"][2] < 1e-8
    assert 1e-8 < PROBLEMS["two regions"][2] < 2e-7


@pytest.mark.parametrize("name", PROBLEMS)
def test_importance_sampling_interval_covers_the_truth(name):
    performance, threshold, truth, points = PROBLEMS[name]
    inside, ratios = 0, []
    for run in range(100):
        result = rare_events.importance_sampling(
            jax.random.key(run), performance, threshold, np.asarray(points), n=1000
        )
        inside += result.lower <= truth <= result.upper
        ratios.append(result.probability / truth)
    assert inside >= 90
    assert abs(np.mean(ratios) - 1.0) < 0.05


def test_importance_sampling_misses_a_region_it_is_not_told_of():
    performance, threshold, truth, points = PROBLEMS["two regions"]
    one = rare_events.importance_sampling(
        jax.random.key(0), performance, threshold, np.asarray(points[:1])
    )
    assert one.upper < 0.5 * truth


def test_monte_carlo_interval_covers_the_truth():
    inside = 0
    for run in range(100):
        result = rare_events.monte_carlo(
            jax.random.key(run), linear, stats.norm.isf(1e-2), DIM, n=2000, batch=2000
        )
        inside += result.lower <= 1e-2 <= result.upper
    assert inside >= 90


def test_monte_carlo_without_a_hit_still_bounds_the_probability():
    result = rare_events.monte_carlo(jax.random.key(0), linear, 6.0, DIM, n=1000)
    assert result.probability == 0.0 and result.lower == 0.0
    # the exact bound at no hit: 1 - 0.025 ** (1 / n)
    assert np.isclose(result.upper, 1 - 0.025 ** (1 / 1000))


def test_subset_simulation_of_one_in_a_billion():
    result = rare_events.subset_simulation(
        jax.random.key(1), linear, stats.norm.isf(1e-9), DIM, n=500, replicates=5
    )
    assert result.lower <= 1e-9 <= result.upper
    assert result.upper / result.lower < 30
    # eight ladders of 450 fresh samples on the first 500, five times
    assert 5 * 500 < result.n_simulations < 5 * (500 + 11 * 450)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["linear 1e-9", "quadratic", "two regions"])
def test_subset_simulation_interval_covers_the_truth(name):
    performance, threshold, truth, _ = PROBLEMS[name]
    inside = 0
    for run in range(100):
        result = rare_events.subset_simulation(jax.random.key(run), performance, threshold, DIM)
        inside += result.lower <= truth <= result.upper
    assert inside >= 90


def test_design_points_of_both_regions_from_failures_far_away():
    rng = np.random.default_rng(0)
    failures = np.concatenate(
        [unit(0, 9.0) + rng.normal(size=(3, DIM)), -unit(1, 8.0) + rng.normal(size=(3, DIM))]
    )
    points, used = rare_events.design_points(two_regions, 5.5, failures)
    assert points.shape == (2, DIM)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), [5.2, 5.5], atol=0.05)
    np.testing.assert_allclose(points[1], unit(0, 5.5), atol=0.1)
    assert used < 3000


def test_design_points_with_a_gradient_cost_few_simulations():
    rng = np.random.default_rng(1)
    failures = unit(0, 9.0)[None] + 2.0 * rng.normal(size=(1, DIM))
    counted = []

    def performance(x):
        counted.append(len(x))
        return quadratic(x)

    gradient = jax.grad(lambda x: jnp.sum(quadratic(x)))
    points, used = rare_events.design_points(performance, 6.0, failures, gradient=gradient)
    np.testing.assert_allclose(points[0], unit(0, 6.0), atol=0.05)
    assert sum(counted) <= used < 150


def test_a_point_that_does_not_fail_is_named():
    failures = np.stack([unit(0, 9.0), unit(0, 1.0)])
    with pytest.raises(ValueError, match="row 1 of failures does not fail"):
        rare_events.design_points(two_regions, 5.5, failures)


def test_invalid_outputs_are_no_failures_and_counted():
    def performance(x):
        return jnp.where(x[:, 1] > 0, jnp.nan, x[:, 0])

    result = rare_events.importance_sampling(
        jax.random.key(0), performance, 3.0, unit(0, 3.0)[None], n=4000
    )
    assert 1500 < result.n_invalid < 2500
    assert result.lower < 0.5 * stats.norm.sf(3.0) < result.upper


def test_bad_input():
    with pytest.raises(ValueError, match="at least one finite failure point"):
        rare_events.importance_sampling(jax.random.key(0), linear, 1.0, np.zeros((0, DIM)))
    with pytest.raises(ValueError, match="replicates=2"):
        rare_events.subset_simulation(jax.random.key(0), linear, 1.0, DIM, replicates=2)
    with pytest.raises(ValueError, match="n \\* share >= 10"):
        rare_events.subset_simulation(jax.random.key(0), linear, 1.0, DIM, n=50)
