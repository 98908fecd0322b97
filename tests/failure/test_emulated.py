"""Probabilities with a Gaussian process beside them: guided lines, refined importance sampling."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from failure.ak_sampling import ak_sampling
from failure.guided_lines import BentPlane, Plane, emulated_point, guided_lines
from failure.models.emulator import Emulator
from failure.performances import slopes_by_jax
from failure.problems import make_problem

DIM = 12
KEY = jax.random.key(0)


def compiled(problem):
    with jax.enable_x64(True):
        return jax.jit(problem.performance)


def test_an_emulator_of_a_slanted_plane_knows_its_slope_in_any_unit() -> None:
    x = np.random.default_rng(0).normal(size=(40, 3))
    slope = np.array([1.0, -2.0, 0.5])
    for unit in (1e-15, 1.0, 1e9):
        emulator = Emulator(x, unit * (x @ slope))
        np.testing.assert_allclose(emulator.slope(np.ones((1, 3)))[0], unit * slope, rtol=0.02)
        mean, sd = emulator.predict(np.full((1, 3), 2.0))
        assert abs(float(mean[0]) + unit) < 0.1 * unit and float(sd[0]) < 0.2 * unit
    # Of a plane that is off, the process of the rest mends what the data tell.
    bent = BentPlane(Plane(np.zeros(3), 0.3, np.array([1.0, -1.5, 0.0])), x, x @ slope)
    point, gradient = emulated_point(bent, 4.0, np.zeros(3))
    np.testing.assert_allclose(point, 4.0 * slope / (slope @ slope), atol=0.1)
    np.testing.assert_allclose(gradient, slope, atol=0.05)


def test_an_emulator_leaves_invalid_rows_out_and_refuses_none() -> None:
    x = np.random.default_rng(1).normal(size=(20, 2))
    y = np.where(np.arange(20) < 3, np.nan, x[:, 0])
    assert np.isfinite(Emulator(x, y).predict(x)[0]).all()
    with pytest.raises(ValueError, match="0 finite values"):
        Emulator(x, np.full(20, np.nan))


@pytest.mark.parametrize("name", ["linear", "bent"])
def test_guided_lines_need_one_round_of_differences(name) -> None:
    problem = make_problem(name, 1e-9, DIM)
    found, point, first = guided_lines(compiled(problem), problem.threshold, DIM, key=KEY)
    # A boundary that bends everywhere is more than few lines by value can bound (docs, Limits).
    assert found.known and 0.5 <= found.probability / problem.probability <= 2.0
    assert name == "bent" or found.lower <= problem.probability <= found.upper
    assert found.n_simulations <= DIM + 40
    cosine = point @ problem.points[0] / np.linalg.norm(point) / problem.threshold
    assert cosine > 0.98
    assert np.isnan(first) or first > DIM


def test_few_lines_are_enough_where_the_output_grows_along_one_direction_of_sixty() -> None:
    """A process without the differences' plane lay 10 to 30 degrees off and took 2 to 4 times."""
    axis = np.random.default_rng(3).normal(size=60)
    axis /= np.linalg.norm(axis)

    def performance(x: np.ndarray) -> np.ndarray:
        return np.expm1(0.1 * (x @ axis))

    for beta in (4.75, 6.0):
        found, point, _ = guided_lines(performance, float(np.expm1(0.1 * beta)), 60, key=KEY)
        assert found.known and found.lower <= norm.sf(beta) <= found.upper
        assert found.n_simulations <= 100
        assert point @ axis / np.linalg.norm(point) > 0.99


def test_guided_lines_say_what_they_do_not_know() -> None:
    flat, _, _ = guided_lines(lambda x: jnp.zeros(x.shape[0]), 1.0, DIM, key=KEY)
    assert not flat.known and (flat.lower, flat.upper) == (0.0, 1.0)
    fails, _, _ = guided_lines(lambda x: x[:, 0] + 2.0, 1.0, DIM, key=KEY)
    assert "nominal point fails" in fails.verdict
    never, _, _ = guided_lines(lambda x: jnp.tanh(x[:, 0]), 5.0, DIM, key=KEY)
    assert "not reached" in never.verdict
    with pytest.raises(ValueError, match="most=20"):
        guided_lines(lambda x: x[:, 0], 1.0, DIM, key=KEY, most=20)
    with pytest.raises(ValueError, match="factor"):
        guided_lines(lambda x: x[:, 0], 1.0, DIM, key=KEY, factor=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("gradients", [False, True])
def test_refined_importance_sampling_stops_by_itself_and_covers(gradients) -> None:
    problem = make_problem("bent", 1e-9, DIM)
    slopes = slopes_by_jax(problem.performance) if gradients else None
    found = ak_sampling(compiled(problem), problem.threshold, DIM, key=KEY, slopes=slopes)
    assert found.estimate.known
    assert found.estimate.lower <= problem.probability <= found.estimate.upper
    assert found.estimate.n_simulations <= 160
    assert (found.n_gradients == found.estimate.n_simulations) == gradients


@pytest.mark.slow
def test_refined_importance_sampling_says_when_the_budget_ends() -> None:
    problem = make_problem("bent", 1e-9, DIM)
    short = ak_sampling(compiled(problem), problem.threshold, DIM, key=KEY, most=DIM + 16)
    assert not short.estimate.known and "not sure" in short.estimate.verdict
    never = ak_sampling(lambda x: jnp.tanh(x[:, 0]), 5.0, DIM, key=KEY)
    assert "not reached" in never.estimate.verdict and never.estimate.upper == 1.0
    assert norm.isf(problem.probability) > 5.9
