"""Design points that are checked, lines from them, and all regions together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from failure.hlrf import find_design_point
from failure.lines import line_sampling, sample_lines
from failure.opposite import wide_strangers
from failure.performances import slopes_by_jax
from failure.problems import make_problem
from failure.rare_events import importance_sampling
from failure.regions import probability_by_lines

DIM = 60
KEY = jax.random.key(0)


def test_a_design_point_by_gradient_takes_a_handful_of_evaluations():
    problem = make_problem("bent", 1e-9, DIM)
    found = find_design_point(
        problem.performance, problem.threshold, DIM, slopes=slopes_by_jax(problem.performance)
    )
    assert found.converged and found.n_gradients <= 6 and found.n_simulations == 0
    assert np.isclose(found.beta, problem.threshold, rtol=1e-3)
    cosine = found.point @ problem.points[0] / problem.threshold / np.linalg.norm(found.point)
    assert cosine > 0.999 and found.first_failure <= 5


def test_values_alone_take_two_rounds_of_differences():
    problem = make_problem("bent", 1e-9, DIM)
    found = find_design_point(problem.performance, problem.threshold, DIM)
    assert found.converged and found.n_gradients == 0
    assert 2 * DIM < found.n_simulations < 2 * DIM + 15


@pytest.mark.parametrize("scale", [1e-15, 1.0, 1e12])
def test_units_do_not_matter(scale):
    problem = make_problem("curved_manifold", 1e-6, 12)

    def scaled(x):
        return scale * problem.performance(x)

    start = 0.3 * np.ones(12)
    found = find_design_point(scaled, scale * problem.threshold, 12, start=start)
    whole = find_design_point(problem.performance, problem.threshold, 12, start=start)
    np.testing.assert_allclose(found.point, whole.point, rtol=1e-5, atol=1e-7)
    assert found.verdict == whole.verdict


def test_a_descent_that_stops_elsewhere_says_so_and_gives_no_narrow_interval():
    def saturates(x):
        return jnp.tanh(x[:, 0])

    found = find_design_point(saturates, 1.1, DIM, slopes=slopes_by_jax(saturates))
    assert not found.converged and "not reached" in found.verdict
    estimate = line_sampling(saturates, 1.1, found, key=KEY)
    assert not estimate.known and (estimate.lower, estimate.upper) == (0.0, 1.0)

    flat = find_design_point(lambda x: jnp.zeros(x.shape[0]), 1.0, DIM)
    assert "does not vary" in flat.verdict
    invalid = find_design_point(lambda x: jnp.full(x.shape[0], jnp.nan), 1.0, DIM)
    assert "not finite" in invalid.verdict and np.isnan(invalid.beta)
    nominal = find_design_point(lambda x: x[:, 0], -1.0, DIM)
    assert "nominal point fails" in nominal.verdict


@pytest.mark.parametrize("name", ["many_regions", "hidden_region"])
def test_one_region_of_several_is_not_called_good(name):
    """No opposite side shows these; wide samples do. Both spoke for one region before."""
    problem = make_problem(name, 1e-9, DIM)
    slopes = slopes_by_jax(problem.performance)
    design = find_design_point(problem.performance, problem.threshold, DIM, slopes=slopes)
    assert design.converged
    for k in range(5):
        key = jax.random.key(k)
        for found in (
            line_sampling(problem.performance, problem.threshold, design, key=key, slopes=slopes),
            importance_sampling(
                problem.performance, problem.threshold, design.point[None], key=key, n=300
            ),
        ):
            assert not found.known and "beside the region" in found.verdict
            assert found.lower <= problem.probability <= found.upper


@pytest.mark.parametrize("name", ["linear", "bent"])
def test_wide_samples_of_a_single_region_raise_hardly_a_doubt(name):
    """Seven samples in a hundred fail far beside the axis of a boundary that bends."""
    problem = make_problem(name, 1e-9, DIM)
    slopes = slopes_by_jax(problem.performance)
    design = find_design_point(problem.performance, problem.threshold, DIM, slopes=slopes)
    region = design.axis[None], np.array([design.beta])
    seen = [
        wide_strangers(problem.performance, problem.threshold, *region, 100, key=jax.random.key(k))
        for k in range(20)
    ]
    assert sum(s.strange > 0 for s in seen) <= 2
    closer = sum(s.n_simulations - 100 for s in seen)
    assert closer > 0 if name == "bent" else closer == 0


def test_lines_cover_the_truth_within_twenty_gradients():
    problem = make_problem("bent", 1e-9, DIM)
    slopes = slopes_by_jax(problem.performance)
    design = find_design_point(problem.performance, problem.threshold, DIM, slopes=slopes)
    inside, cost, within = 0, [], 0
    for k in range(20):
        found = line_sampling(
            problem.performance, problem.threshold, design, key=jax.random.key(k), slopes=slopes,
            scan=0,
        )  # fmt: skip
        inside += found.lower <= problem.probability <= found.upper
        within += 0.5 <= found.probability / problem.probability <= 2.0
        cost.append(design.n_gradients + found.n_simulations)
    assert inside >= 18 and within >= 19
    assert np.median(cost) <= 20


def test_lines_with_values_only():
    problem = make_problem("bent", 1e-9, DIM)
    design = find_design_point(problem.performance, problem.threshold, DIM)
    found = line_sampling(problem.performance, problem.threshold, design, key=KEY, scan=0)
    assert found.known and found.lower <= problem.probability <= found.upper
    assert found.n_simulations <= 80


def test_values_alone_leave_room_where_all_lines_end_nearer_than_their_middle():
    """Without it 17 of 20 intervals held the truth; a slanted boundary is no bent one."""
    from failure.line_roots import bend_of_lines

    rng = np.random.default_rng(0)
    bent = [6.0 - 0.02 * float(rng.chisquare(10)) for _ in range(2000)]
    assert bend_of_lines(np.array(bent), 6.0) == pytest.approx(0.24, rel=0.2)
    seen = [bend_of_lines(6.0 + 0.1 * rng.normal(size=10), 6.0) > 0.0 for _ in range(200)]
    assert np.mean(seen) < 0.1
    problem = make_problem("bent", 1e-9, DIM)
    design = find_design_point(problem.performance, problem.threshold, DIM)
    found = [
        line_sampling(problem.performance, problem.threshold, design, key=jax.random.key(k))
        for k in range(20)
    ]
    assert sum(e.lower <= problem.probability <= e.upper for e in found) >= 18


def test_a_saddle_is_seen_by_its_curvature():
    """From nominal the descent ends between the two nearest points, where all checks hold."""
    problem = make_problem("curved_manifold", 1e-9, DIM)
    slopes = slopes_by_jax(problem.performance)
    saddle = find_design_point(problem.performance, problem.threshold, DIM, slopes=slopes)
    assert saddle.converged
    lines = sample_lines(problem.performance, problem.threshold, saddle, key=KEY, slopes=slopes)
    assert lines.bend > 1.0 and not lines.estimate.known
    both = probability_by_lines(
        problem.performance, problem.threshold, DIM, key=KEY, slopes=slopes, scan=0
    )
    assert len(both.points) == 2
    assert both.estimate.lower <= problem.probability <= both.estimate.upper


@pytest.mark.parametrize("name", ["window", "opposite_mechanisms", "hidden_region"])
def test_all_regions_are_found_and_summed(name):
    problem = make_problem(name, 1e-9, DIM)
    found = probability_by_lines(
        problem.performance, problem.threshold, DIM, key=KEY,
        slopes=slopes_by_jax(problem.performance),
    )  # fmt: skip
    assert len(found.points) == len(problem.points)
    assert found.estimate.known and np.isclose(found.shares.sum(), 1.0)
    np.testing.assert_allclose(found.estimate.probability, problem.probability, rtol=0.02)


@pytest.mark.parametrize("name", ["window", "opposite_mechanisms", "shell"])
def test_lines_say_that_the_opposite_side_fails(name):
    problem = make_problem(name, 1e-9, DIM)
    axis = problem.points[0] / np.linalg.norm(problem.points[0])
    slopes = slopes_by_jax(problem.performance)
    design = find_design_point(
        problem.performance, problem.threshold, DIM, slopes=slopes, start=3.0 * axis
    )
    found = line_sampling(problem.performance, problem.threshold, design, key=KEY)
    assert not found.known and "opposite side fails" in found.verdict
    assert found.lower <= problem.probability <= found.upper == 1.0


def test_failures_on_a_whole_circle_are_not_called_known():
    problem = make_problem("shell", 1e-9, DIM)
    for slopes in (None, slopes_by_jax(problem.performance)):
        found = probability_by_lines(
            problem.performance, problem.threshold, DIM, key=KEY, slopes=slopes
        )
        assert not found.estimate.known and found.estimate.upper == 1.0


def test_a_boundary_that_bends_is_one_region_and_known():
    """Wide samples beside it lead back to it; that was taken for no design point at all."""
    problem = make_problem("bent", 1e-9, DIM)
    for k in range(3):
        found = probability_by_lines(
            problem.performance, problem.threshold, DIM, key=jax.random.key(k),
            slopes=slopes_by_jax(problem.performance),
        )  # fmt: skip
        assert found.estimate.known and len(found.points) == 1
        assert found.estimate.lower <= problem.probability <= found.estimate.upper
        assert found.estimate.n_simulations < 350


@pytest.mark.parametrize("name", ["curved_manifold", "shell"])
def test_regions_by_values_are_not_good_and_wrong(name):
    """The way from a wide sample to the heart of a saddle, or around a circle, fails as well."""
    problem = make_problem(name, 1e-9, DIM)
    for k in (9, 15):
        found = probability_by_lines(
            problem.performance, problem.threshold, DIM, key=jax.random.key(k)
        ).estimate
        assert not found.known or found.lower <= problem.probability <= found.upper


def test_bad_requests():
    design = find_design_point(lambda x: x[:, 0], 3.0, 4)
    with pytest.raises(ValueError, match=r"factor=1\.0"):
        line_sampling(lambda x: x[:, 0], 3.0, design, key=KEY, factor=1.0)
    with pytest.raises(ValueError, match="scan=-1"):
        line_sampling(lambda x: x[:, 0], 3.0, design, key=KEY, scan=-1)
    with pytest.raises(ValueError, match="min_lines=2"):
        line_sampling(lambda x: x[:, 0], 3.0, design, key=KEY, min_lines=2)
    with pytest.raises(ValueError, match=r"start.shape=\(3,\)"):
        find_design_point(lambda x: x[:, 0], 3.0, 4, start=np.zeros(3))
    with pytest.raises(ValueError, match=r"y.shape=\(1, 1\)"):
        find_design_point(lambda x: np.asarray(x), 3.0, 1)
    with pytest.raises(ValueError, match="most=0"):
        probability_by_lines(lambda x: x[:, 0], 3.0, 4, key=KEY, most=0)
    assert np.isclose(design.beta, 3.0) and np.isclose(
        stats.norm.sf(design.beta), 1.35e-3, rtol=1e-3
    )
