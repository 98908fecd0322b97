"""Intervals of estimates, by values of tables and of SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from failure.estimates import clopper_pearson, log_normal_interval, mean_of_terms


@pytest.mark.parametrize(("hits", "n"), [(0, 10), (1, 10), (5, 100), (10, 10), (37, 1000)])
def test_the_exact_interval_of_a_share_is_scipy_s(hits, n) -> None:
    exact = stats.binomtest(hits, n).proportion_ci(0.95, method="exact")
    assert clopper_pearson(hits, n) == pytest.approx((exact.low, exact.high), rel=1e-9)


def test_nothing_is_known_without_a_sample() -> None:
    assert clopper_pearson(0, 0) == (0.0, 1.0)


def test_the_log_normal_interval_has_the_variance_of_its_error() -> None:
    """exp(N(m, s)) with s^2 = log(1 + (error / mean)^2) has that relative error."""
    low, high = log_normal_interval(1e-3, 5e-4, 1.96)
    spread = np.sqrt(np.log(1.25))
    assert low == pytest.approx(1e-3 * np.exp(-1.96 * spread))
    assert high == pytest.approx(1e-3 * np.exp(1.96 * spread))
    assert log_normal_interval(0.5, 5.0, 1.96)[1] == 1.0  # a probability


def test_terms_that_are_alike_count_in_full_and_one_that_stands_out_counts_alone() -> None:
    mean, low, high, effective = mean_of_terms(np.full(50, 0.2))
    assert (mean, effective) == pytest.approx((0.2, 50.0)) and low == high == pytest.approx(0.2)
    mean, low, high, effective = mean_of_terms(np.array([1.0, *[0.0] * 99]))
    assert (mean, effective) == pytest.approx((0.01, 1.0)) and low < 1e-4 and high == 1.0
    assert mean_of_terms(np.zeros(9)) == (0.0, 0.0, 0.0, 0.0)
