"""Intervals and paired tests: equal to scipy's; whole groups are redrawn."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from snn_fusion_failure.records.statistics import (
    bootstrap_interval,
    holm,
    mean_interval,
    paired_test,
    two_way_interval,
)


@given(st.integers(2, 12), st.floats(0.5, 0.99), st.integers(0, 10_000))
@settings(max_examples=50, deadline=None)
def test_interval_and_paired_test_equal_scipy(n: int, level: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(0.9, 0.02, n), rng.normal(0.88, 0.02, n)
    interval = mean_interval(a, level=level)
    low, high = stats.t.interval(level, n - 1, loc=a.mean(), scale=stats.sem(a))
    np.testing.assert_allclose([interval.low, interval.high], [low, high], rtol=1e-9)
    ours, theirs = paired_test(a, b, level=level), stats.ttest_rel(a, b)
    np.testing.assert_allclose([ours.t, ours.p_value], [theirs.statistic, theirs.pvalue], rtol=1e-8)
    ci = theirs.confidence_interval(level)
    np.testing.assert_allclose([ours.low, ours.high], [ci.low, ci.high], rtol=1e-7, atol=1e-12)
    assert ours.n == n and ours.difference == pytest.approx((a - b).mean())


def test_paired_test_without_spread_and_bad_input() -> None:
    same = paired_test([0.5, 0.75], [0.25, 0.5])
    assert (
        math.isinf(same.t) and same.t > 0 and same.p_value == 0.0 and same.low == same.high == 0.25
    )
    zero = paired_test([0.5, 0.7], [0.5, 0.7])
    assert zero.t == 0.0 and zero.p_value == 1.0
    for call, expected in (
        (lambda: paired_test([0.5, 0.6], [0.5, 0.6, 0.7]), "b=3 runs: expected 2"),
        (lambda: mean_interval([0.5]), "at least two runs"),
        (lambda: mean_interval([0.5, np.nan]), "a run has failed"),
        (lambda: mean_interval([0.5, 0.6], level=95.0), "level=95"),
    ):
        with pytest.raises(ValueError, match=expected):
            call()


def test_bootstrap_redraws_whole_groups() -> None:
    rng = np.random.default_rng(1)
    subject = np.repeat(np.arange(9), 100)
    right = (rng.random(900) < (0.7 + 0.25 * rng.random(9))[subject]).astype(float)
    alone = bootstrap_interval(right)
    grouped = bootstrap_interval(right, subject)
    assert grouped.n == 9 and alone.n == 900
    assert grouped.high - grouped.low > 1.5 * (alone.high - alone.low)
    assert alone.high - alone.low == pytest.approx(2 * 1.96 * alone.sd / 30, rel=0.1)
    assert bootstrap_interval([1.0, 1.0]).high == 1.0
    with pytest.raises(ValueError, match=r"groups=.*expected at least two"):
        bootstrap_interval([1.0, 0.0], [3, 3])


def test_adjusted_p_values_are_those_of_a_worked_example() -> None:
    """Four tests; by hand: 4 x 0.01, then 3 x 0.02 and 2 x 0.04 and never falling."""
    assert holm([0.04, 0.01, 0.9, 0.02]) == pytest.approx([0.08, 0.04, 0.9, 0.06])
    assert holm([0.03, 0.031]) == pytest.approx([0.06, 0.06])
    assert holm([]) == []


def test_the_interval_over_seeds_and_subjects_is_wider_than_over_seeds() -> None:
    """Subjects differ by several points, seeds hardly."""
    rng = np.random.default_rng(0)
    table = rng.normal(0.0, 3.0, 9)[None, :] + rng.normal(0.0, 0.1, (5, 9))
    low, high = two_way_interval(table)
    assert low < table.mean() < high
    assert high - low > 5.0 * np.ptp(table.mean(axis=1))


def test_groups_that_are_redrawn_whole_count_by_their_size() -> None:
    """One 0 and nine 1: half of the draws hold both groups, whose mean is 0.9 and not 0.5."""
    values, groups = [0.0, *[1.0] * 9], [0, *[1] * 9]
    found = bootstrap_interval(values, groups, level=0.4)
    assert (found.low, found.high, found.n) == (0.9, 0.9, 2)
