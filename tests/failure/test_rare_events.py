import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from failure import opposite, rare_events
from failure.problems import make_problem

DIM = 60
KEY = jax.random.key(0)


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
            performance, threshold, np.asarray(points), key=jax.random.key(run), n=1000
        )
        inside += result.lower <= truth <= result.upper
        ratios.append(result.probability / truth)
    assert inside >= 90
    assert abs(np.mean(ratios) - 1.0) < 0.05


def test_importance_sampling_misses_a_region_it_is_not_told_of():
    performance, threshold, truth, points = PROBLEMS["two regions"]
    one = rare_events.importance_sampling(
        performance, threshold, np.asarray(points[:1]), key=jax.random.key(0), scan=0
    )
    assert one.upper < 0.5 * truth
    default = rare_events.importance_sampling(
        performance, threshold, np.asarray(points[:1]), key=jax.random.key(0)
    )
    assert not default.known and default.upper >= truth


def test_importance_sampling_says_that_the_other_side_of_its_points_fails():
    problem = make_problem("window", 1e-6, DIM)

    def estimate(points):
        return rare_events.importance_sampling(
            problem.performance, problem.threshold, points, key=KEY, n=1000
        )

    one = estimate(problem.points[:1])
    assert not one.known and "opposite side" in one.verdict
    assert one.lower <= problem.probability <= one.upper
    both = estimate(problem.points)
    assert both.known and both.lower <= problem.probability <= both.upper
    assert both.n_simulations == 1102


def test_monte_carlo_interval_covers_the_truth():
    inside = 0
    for run in range(100):
        result = rare_events.monte_carlo(
            linear, stats.norm.isf(1e-2), DIM, key=jax.random.key(run), n=2000, batch=2000
        )
        inside += result.lower <= 1e-2 <= result.upper
    assert inside >= 90


def test_monte_carlo_without_a_hit_still_bounds_the_probability():
    result = rare_events.monte_carlo(linear, 6.0, DIM, key=jax.random.key(0), n=1000)
    assert result.probability == 0.0 and result.lower == 0.0
    # the exact bound at no hit: 1 - 0.025 ** (1 / n)
    assert np.isclose(result.upper, 1 - 0.025 ** (1 / 1000))


def test_subset_simulation_of_one_in_a_billion():
    result = rare_events.subset_simulation(
        linear, stats.norm.isf(1e-9), DIM, key=jax.random.key(1), n=500, replicates=5
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
        result = rare_events.subset_simulation(performance, threshold, DIM, key=jax.random.key(run))
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
        performance, 3.0, unit(0, 3.0)[None], key=jax.random.key(0), n=4000
    )
    assert 1500 < result.n_invalid < 2500
    assert result.lower < 0.5 * stats.norm.sf(3.0) < result.upper


def test_bad_input():
    with pytest.raises(ValueError, match="at least one finite failure point"):
        rare_events.importance_sampling(linear, 1.0, np.zeros((0, DIM)), key=KEY)
    with pytest.raises(ValueError, match="replicates=2"):
        rare_events.subset_simulation(linear, 1.0, DIM, key=KEY, replicates=2)
    with pytest.raises(ValueError, match="n \\* share >= 10"):
        rare_events.subset_simulation(linear, 1.0, DIM, key=KEY, n=50)


@pytest.mark.slow
def test_steps_and_ties_are_counted_not_climbed():
    """One output in a thousand is 1, the others are 0: there is no ladder to climb."""

    def flag(x):
        return (x[:, 0] > 3.0).astype(x.dtype)

    result = rare_events.subset_simulation(flag, 0.5, 10, key=KEY, n=1000, replicates=5)
    assert result.lower <= stats.norm.sf(3.0) <= result.upper
    rarer = rare_events.subset_simulation(
        lambda x: (x[:, 0] > 5.0).astype(x.dtype), 0.5, 10, key=KEY, n=200, replicates=3
    )
    assert not rarer.known and "outputs tie" in rarer.verdict
    assert rarer.lower <= stats.norm.sf(5.0) <= rarer.upper

    def counter(x):
        return jnp.floor(2.0 * x[:, 0])

    steps = rare_events.subset_simulation(counter, 5.5, 10, key=KEY, n=1000, replicates=5)
    assert steps.lower <= stats.norm.sf(3.0) <= steps.upper
    flat = rare_events.subset_simulation(
        lambda x: jnp.minimum(x[:, 0], 2.0), 3.0, 10, key=KEY, n=200, replicates=3
    )
    assert not flat.known and flat.lower == 0.0 and 0.0 < flat.upper < 0.1


def test_a_simulator_that_never_answers_leaves_everything_open():
    def nothing(x):
        return jnp.full(x.shape[0], jnp.nan)

    for result in (
        rare_events.subset_simulation(nothing, 1.0, 5, key=KEY, n=100, replicates=3),
        rare_events.monte_carlo(nothing, 1.0, 5, key=KEY, n=100),
    ):
        assert np.isnan(result.probability) and result.upper == 1.0
        assert "invalid" in result.verdict


def test_a_share_that_does_not_divide_the_samples_is_unbiased():
    ratios = [
        rare_events.subset_simulation(
            linear, stats.norm.isf(1e-5), DIM, key=jax.random.key(k), n=1000, share=0.3,
            replicates=10, explore=0,
        ).probability / 1e-5
        for k in range(2)
    ]  # fmt: skip
    # a third of the samples counted as 0.3 gave half of the truth
    assert 0.7 < np.mean(ratios) < 1.5


def test_numpy_simulators_climb_as_well():
    def numpy_only(x):
        return np.sort(np.asarray(x), axis=1)[:, -1]

    result = rare_events.subset_simulation(numpy_only, 4.0, 5, key=KEY, n=200, replicates=3)
    assert result.lower <= 1.0 - stats.norm.cdf(4.0) ** 5 <= result.upper


def test_a_region_beside_the_ladder_is_reported():
    problem = make_problem("hidden_region", 1e-6, DIM)
    result = rare_events.subset_simulation(
        problem.performance, problem.threshold, DIM, key=KEY, n=500, replicates=3
    )
    assert "fail beside the regions of the ladder" in result.verdict
    assert result.lower <= problem.probability <= result.upper


def test_one_effective_sample_is_no_interval():
    """A shift that is far off: one sample carries the sum."""
    for k in range(5):
        result = rare_events.importance_sampling(
            linear, 5.0, unit(0, 5.0)[None], key=jax.random.key(k), n=300
        )
        assert not result.known and result.lower == 0.0
        assert stats.norm.sf(5.0) <= result.upper <= 1.0
        assert "effective samples" in result.verdict


@pytest.mark.parametrize("keep", [slice(0, 1), slice(0, -1), 0], ids=repr)
@pytest.mark.parametrize("kind", ["traced", "numpy"])
def test_fewer_outputs_than_samples_are_refused_and_not_broadcast(keep, kind):
    def short(x):
        return (jnp if kind == "traced" else np).asarray(x[:, 0])[keep]

    point = unit(0, 3.0)
    calls = [
        lambda: rare_events.monte_carlo(short, 1.0, DIM, key=KEY, n=50, batch=20),
        lambda: rare_events.importance_sampling(short, 1.0, point[None], key=KEY, n=50, scan=0),
        lambda: opposite.fails(short, 1.0, np.ones((5, DIM))),
        lambda: rare_events.design_points(short, 1.0, np.stack([point, 2 * point])),
    ]
    if kind == "traced":
        calls.append(
            lambda: rare_events.subset_simulation(short, 1.0, DIM, key=KEY, n=100, explore=0)
        )
    for call in calls:
        with pytest.raises(
            ValueError, match=r"y\.shape=\(.*\): expected \(\d+,\), one value per row"
        ):
            call()


@pytest.mark.parametrize("threshold", [np.nan, np.inf])
def test_a_threshold_that_nothing_exceeds_is_refused(threshold):
    for call in (
        lambda: rare_events.monte_carlo(linear, threshold, DIM, key=KEY),
        lambda: rare_events.subset_simulation(linear, threshold, DIM, key=KEY),
        lambda: rare_events.importance_sampling(linear, threshold, unit(0, 3.0)[None], key=KEY),
        lambda: rare_events.find_design_point(linear, threshold, DIM),
        lambda: rare_events.design_points(linear, threshold, unit(0, 3.0)[None]),
    ):
        with pytest.raises(ValueError, match=f"threshold={threshold}: expected a finite number"):
            call()


def test_two_estimates_that_disagree_span_both():
    one = rare_events.Estimate(1e-7, 5e-8, 2e-7, 100, 0, 50.0)
    other = rare_events.Estimate(2e-7, 1e-7, 4e-7, 900, 0, 50.0)
    both = rare_events.combine(one, other)
    assert both.known and both.n_simulations == 1000
    missed = rare_events.combine(one, other._replace(probability=1e-5, lower=5e-6, upper=2e-5))
    assert (missed.lower, missed.upper) == (5e-8, 2e-5) and "disagree" in missed.verdict
