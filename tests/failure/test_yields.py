"""Worst-case points, probabilities and yield by values alone, where the answer is known."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy.stats import norm

from failure.archive import Archive, BudgetSpentError
from failure.worst_case import find_regions
from failure.yield_analysis import Analysis, AnalysisConfig, analyse
from failure.yields import normal_draws

DIM = 8
RNG = np.random.default_rng(0)
A = RNG.normal(size=DIM)
A /= np.linalg.norm(A)
B = RNG.normal(size=DIM)
B -= (B @ A) * A
B /= np.linalg.norm(B)


def analysis(function, n_total: int = 500, **options) -> Analysis:
    return analyse(AnalysisConfig(n_total), function, DIM, key=jax.random.key(1), **options)


def test_two_linear_specifications_of_very_different_size() -> None:
    found = analysis(lambda x: np.stack([x @ A / 4.0 - 1, 1e-15 * (x @ B - 6.0)], 1), 800)
    for spec, beta in zip(found.specs, (4.0, 6.0), strict=True):
        assert spec.regions[0].converged
        assert spec.distance == pytest.approx(beta, abs=0.01)
        assert spec.estimate.probability == pytest.approx(norm.sf(beta), rel=1e-3)
        assert spec.mixture.lower < norm.sf(beta) < spec.mixture.upper
        assert spec.estimate.verdict == "good"
    cosine = found.specs[1].regions[0].point @ B / found.specs[1].distance
    assert cosine == pytest.approx(1.0, abs=1e-6)
    assert found.union.probability == pytest.approx(norm.sf(4.0), rel=0.02)
    assert found.archive.spent <= 800


def test_a_curved_limit_against_its_integral() -> None:
    """g > 0 is x.A > 4.5 + 0.03 |rest|^2, whose probability is a mean over a chi-square."""
    found = analysis(lambda x: (x @ A - 0.03 * ((x**2).sum(1) - (x @ A) ** 2) - 4.5)[:, None])
    rest = np.random.default_rng(3).chisquare(DIM - 1, 200_000)
    wanted = norm.sf(4.5 + 0.03 * rest).mean()
    (spec,) = found.specs
    assert spec.estimate.lower < wanted < spec.estimate.upper
    assert spec.lines is not None and spec.lines.probability == pytest.approx(wanted, rel=0.2)


def test_a_region_on_the_other_side_counts() -> None:
    found = analysis(lambda x: np.maximum(x @ A - 4.0, -(x @ A) - 4.2)[:, None])
    (spec,) = found.specs
    assert sorted(round(r.distance, 1) for r in spec.regions) == [4.0, 4.2]
    assert spec.estimate.probability == pytest.approx(norm.sf(4.0) + norm.sf(4.2), rel=1e-2)


def test_a_jump_is_found_by_wide_samples_and_said_not_to_be_verified() -> None:
    """A measure that fails: no slope leads there."""
    found = analysis(lambda x: np.where(x @ A > 3.0, 1.0, -1.0)[:, None], 1500)
    (spec,) = found.specs
    assert spec.regions and not spec.regions[0].converged
    assert spec.estimate.verdict != "good"
    assert spec.estimate.lower < norm.sf(3.0) < spec.estimate.upper


def test_no_failure_is_no_number() -> None:
    found = analysis(lambda x: np.stack([x @ A - 3.0, 0.01 * (x @ B) - 1.0], 1))
    assert found.specs[1].regions == [] and np.isnan(found.specs[1].estimate.probability)
    assert "no failing sample" in found.specs[1].estimate.verdict
    assert 0.0 < found.specs[1].estimate.upper < 1.0
    assert found.union.verdict != "good"


def test_unknown_violations_are_no_failures() -> None:
    def simulate(x: np.ndarray) -> np.ndarray:
        g = x @ A - 3.5
        return np.where(x @ B > 1.0, np.nan, g)[:, None]

    (spec,) = analysis(simulate, 800).specs
    assert spec.estimate.lower < norm.sf(3.5) * norm.cdf(1.0) < spec.estimate.upper


def test_known_samples_save_the_first_slopes() -> None:
    def simulate(x: np.ndarray) -> np.ndarray:
        return (x @ A - 3.0)[:, None]

    x = 1.5 * np.random.default_rng(2).normal(size=(60, DIM))
    archive = Archive(simulate, DIM, 100)
    archive.add(x, simulate(x), "start")
    _, regions = find_regions(archive, DIM)
    assert regions[0].distance == pytest.approx(3.0, abs=0.02)
    cold = Archive(simulate, DIM, 100)
    find_regions(cold, DIM)
    assert archive.spent < cold.spent


def test_a_sample_is_simulated_once_and_the_budget_holds() -> None:
    calls = []

    def simulate(x: np.ndarray) -> np.ndarray:
        calls.append(len(x))
        return x[:, :1]

    archive = Archive(simulate, 2, 3)
    x = np.array([[0.0, 1.0], [2.0, 3.0]])
    archive(x, "a")
    np.testing.assert_array_equal(archive(x[::-1], "b"), [[2.0], [0.0]])
    assert calls == [2] and archive.left == 1
    with pytest.raises(BudgetSpentError, match="2 simulations wanted, 1 left"):
        archive(x + 1.0, "c")


def test_a_longer_draw_begins_with_the_shorter_one() -> None:
    key = jax.random.key(3)
    np.testing.assert_array_equal(normal_draws(100, 3, key=key)[:10], normal_draws(10, 3, key=key))


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="a nominal circuit that fails has no rare failures"):
        analysis(lambda x: np.ones((len(x), 1)))
    with pytest.raises(ValueError, match=r"n_total=12: expected at least 18"):
        analysis(lambda x: x, 12)
    with pytest.raises(ValueError, match=r"expected one row \[1, k\]"):
        analysis(lambda x: x[:, 0] - 3.0)
    for change in ({"n_total": 3}, {"reach": 0.0}, {"line_share": 1.0}, {"max_lines": 1}):
        with pytest.raises(ValueError, match="expected"):
            AnalysisConfig(**change)
