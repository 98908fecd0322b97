"""Ranks, the Pareto front and paired comparisons, by numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from snn_fusion_failure.sweeps import definition
from snn_fusion_failure.sweeps.rank import compare, pareto, rank
from snn_fusion_failure.sweeps.results import setting_scores
from snn_fusion_failure.sweeps.rungs import promotions, survivors


def dataset(values, status=None, *, goal="max", cost=None, common=False) -> xr.Dataset:
    values = np.asarray(values, float)
    status = np.zeros(values.shape, int) if status is None else np.asarray(status)
    variables = {
        "value": (("a", "seed"), values, {"goal": goal, "units": "1"}),
        "status": (("a", "seed"), status),
    }
    if cost is not None:
        variables["cost"] = (("a", "seed"), np.asarray(cost, float), {"goal": "min", "units": "1"})
    return xr.Dataset(
        variables, {"a": ("a", np.arange(len(values)), {"units": "1"})},
        {"objective": "value", "min_valid": 0.5, "mixed": 0, "common_seeds": int(common)},
    )  # fmt: skip


def test_a_number_of_a_trial_that_is_not_ok_does_not_count() -> None:
    """A failed trial may have left a finite number; the status decides."""
    status = [
        [definition.OK, definition.OK, definition.FAILED],
        [definition.OK, definition.NON_FINITE, definition.OK],
    ]
    rows = rank(dataset([[1.0, 3.0, 100.0], [4.0, np.nan, 6.0]], status))
    assert [(r["setting"], r["mean"], r["n"], r["broken"]) for r in rows] == [
        (1, 5.0, 2, 1), (0, 2.0, 2, 1),
    ]  # fmt: skip


def test_smaller_is_better_where_the_metric_says_so() -> None:
    rows = rank(dataset([[1.0, 3.0], [4.0, 6.0], [0.0, 2.0]], goal="min"))
    assert [(r["setting"], r["mean"]) for r in rows] == [(2, 1.0), (0, 2.0), (1, 5.0)]


def test_a_score_is_the_mean_of_the_valid_seeds_or_none_at_all() -> None:
    values = np.array([[2.0, 4.0, np.nan, np.nan], [1.0, np.nan, np.nan, np.nan]])
    status = np.where(np.isfinite(values), definition.OK, definition.NON_FINITE)
    assert setting_scores(values, status, "max", 0.5).tolist() == [3.0, -np.inf]
    assert setting_scores(values, status, "min", 0.25).tolist() == [-3.0, -1.0]
    empty = np.full((1, 2), np.nan)
    assert setting_scores(empty, np.full((1, 2), definition.FAILED), "max", 0.0).tolist() == [
        -np.inf
    ]


def test_the_front_keeps_what_is_as_good_in_one_and_better_in_another() -> None:
    """Setting 1 ties setting 0 in value at a lower cost; 2 is best in value; 3 loses to all."""
    data = dataset([[5.0], [5.0], [7.0], [1.0]], cost=[[3.0], [2.0], [9.0], [9.0]])
    assert pareto(data, ["value", "cost"]) == [2, 1]


def test_paired_seeds_are_those_that_are_valid_in_both() -> None:
    status = np.zeros((2, 5), int)
    status[0, 4] = status[1, 3] = definition.FAILED
    a, b = np.array([5.0, 7.0, 9.0, 100.0, 100.0]), np.array([4.0, 5.0, 6.5, -100.0, -100.0])
    found = compare(dataset([a, b], status, common=True), 0, 1)
    wanted = stats.ttest_rel(a[:3], b[:3])
    assert found["paired"] and found["n"] == 3
    assert found["difference"] == pytest.approx((1.0 + 2.0 + 2.5) / 3)
    assert found["p"] == pytest.approx(wanted.pvalue)


def test_independent_seeds_are_compared_without_equal_variances() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(0.0, 5.0, 6), rng.normal(1.0, 0.1, 6)
    a[5] = 1e6  # of a trial that failed
    status = np.zeros((2, 6), int)
    status[0, 5] = definition.FAILED
    found = compare(dataset([a, b], status), 0, 1)
    test = stats.ttest_ind(a[:5], b, equal_var=False)
    interval = test.confidence_interval(0.95)
    assert not found["paired"] and found["p"] == pytest.approx(test.pvalue)
    assert found["ci95"] == pytest.approx([interval.low, interval.high])


def test_who_goes_on() -> None:
    scores = np.array([1.0, 3.0, 3.0, 2.0])
    assert survivors(scores, 0.25).tolist() == [1]  # the earlier of two that are alike
    assert survivors(scores, 0.5).tolist() == [1, 2]
    assert survivors(scores, 0.01).tolist() == [1]  # always one
    assert survivors(np.array([5.0, 4.0, 1.0, 2.0]), 0.5).tolist() == [0, 1]
    assert survivors(np.full(8, -np.inf), 0.1).tolist() == [0]
    broken = np.array([-np.inf, 5.0, -np.inf, -np.inf])
    assert promotions(broken, np.ones(4, bool), 0.5).tolist() == [1]
