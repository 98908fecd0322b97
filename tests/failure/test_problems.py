"""Problems of known probability: the number, the nearest points, values below and above."""

import jax
import numpy as np
import pytest

from failure.problems import PROBLEMS, make_problem


@pytest.mark.parametrize("name", PROBLEMS)
def test_probability_is_that_of_many_samples_and_points_lie_on_the_boundary(name):
    problem = make_problem(name, 0.02, 12)
    assert problem.name == name and np.isclose(problem.probability, 0.02, rtol=0.02)
    with jax.enable_x64(True):
        x = jax.random.normal(jax.random.key(0), (200_000, 12))
        share = float(np.mean(np.asarray(problem.performance(x)) > problem.threshold))
        inside = np.asarray(problem.performance(1.0001 * problem.points))
        outside = np.asarray(problem.performance(0.999 * problem.points))
    # four standard errors of the share
    assert abs(share - problem.probability) < 4 * np.sqrt(0.02 / 200_000)
    assert np.all(inside > problem.threshold) and np.all(outside < problem.threshold)


def test_small_probabilities_and_bad_requests():
    for name in ("bent", "curved_manifold", "shell"):
        problem = make_problem(name, 1e-9, 200)
        assert 3.0 < problem.threshold < 12.0 and problem.points.shape[1] == 200
    with pytest.raises(ValueError, match="name='flat': expected one of linear"):
        make_problem("flat", 1e-6)
    with pytest.raises(ValueError, match=r"probability=0\.5"):
        make_problem("linear", 0.5)
    with pytest.raises(ValueError, match="dim=4"):
        make_problem("linear", 1e-6, 4)
