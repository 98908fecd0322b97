"""Scores: closed forms, brute force, and parity with scipy."""

from __future__ import annotations

import doctest
import importlib
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from fusion.evaluate import (
    accuracy,
    auroc,
    confusion_matrix,
    gap_closure,
    gate_auroc,
    mean_retained_accuracy,
    mean_weights,
    retained_accuracy,
    split_accuracy,
)

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    "module",
    [
        "fusion.evaluate",
        "fusion.failures",
        "fusion.data",
        "fusion.data.dataset",
        "fusion.data.simulated",
    ],
)
def test_examples_in_the_docstrings(module: str) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0 and result.failed == 0


def test_split_accuracy_weighs_the_parts() -> None:
    labels, guesses = RNG.integers(0, 4, 90), RNG.integers(0, 4, 90)
    mask = RNG.random((90, 3)) < 0.3
    split = split_accuracy(labels, guesses, mask)
    n = mask.any(axis=1).sum()
    assert split.overall == pytest.approx((split.corrupted * n + split.clean * (90 - n)) / 90)
    assert split.overall == accuracy(labels, guesses) == (labels == guesses).mean()
    none = split_accuracy(labels, guesses, np.zeros((90, 3), bool))
    assert none.clean == none.overall and math.isnan(none.corrupted)


@given(hnp.arrays(np.int64, (30, 2), elements=st.integers(0, 4)))
def test_confusion_matrix_counts_pairs(pairs: np.ndarray) -> None:
    matrix = confusion_matrix(pairs[:, 0], pairs[:, 1], 5)
    expected, *_ = np.histogram2d(
        pairs[:, 0], pairs[:, 1], bins=5, range=((-0.5, 4.5), (-0.5, 4.5))
    )
    np.testing.assert_array_equal(matrix, expected)
    assert np.trace(matrix) == (pairs[:, 0] == pairs[:, 1]).sum()


def test_confusion_matrix_refuses_labels_out_of_range() -> None:
    with pytest.raises(ValueError, match=r"predictions=array spanning 0..5: expected 0..4"):
        confusion_matrix(np.array([0, 1]), np.array([0, 5]), 5)


scores = hnp.arrays(np.float64, st.integers(1, 25), elements=st.sampled_from(np.linspace(0, 1, 7)))


@given(scores, scores)
def test_auroc_equals_mann_whitney_with_ties(a: np.ndarray, b: np.ndarray) -> None:
    u = stats.mannwhitneyu(a, b, method="asymptotic").statistic
    assert auroc(a, b) == pytest.approx(u / (a.size * b.size), abs=1e-12)
    assert auroc(b, a) == pytest.approx(1.0 - auroc(a, b), abs=1e-12)
    assert auroc(np.exp(a), np.exp(b)) == auroc(a, b)


def test_auroc_of_gaussians_has_its_closed_form() -> None:
    a, b = RNG.normal(1.0, 1.0, 40_000), RNG.normal(0.0, 1.0, 40_000)
    assert auroc(a, b) == pytest.approx(stats.norm.cdf(1.0 / math.sqrt(2.0)), abs=0.006)
    assert math.isnan(auroc(a, np.array([])))
    with pytest.raises(ValueError, match="NaN"):
        auroc(np.array([np.nan]), b)


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_gate_auroc_equals_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    w = rng.integers(0, 5, (12, 4)).astype(np.float32)
    mask = (rng.random((12, 4)) < 0.5) & (rng.random((12, 1)) < 0.7)

    def compare(clean: list[float], failed: list[float]) -> float:
        wins = [1.0 if c > f else 0.5 if c == f else 0.0 for c in clean for f in failed]
        return float(np.mean(wins)) if wins else math.nan

    rows = [i for i in range(12) if mask[i].any()]
    cells = [(i, k) for i in rows for k in range(4)]
    pooled = compare([w[c] for c in cells if not mask[c]], [w[c] for c in cells if mask[c]])
    by_row = [compare(list(w[i][~mask[i]]), list(w[i][mask[i]])) for i in rows]
    by_channel = [
        compare([w[i, k] for i in rows if not mask[i, k]], [w[i, k] for i in rows if mask[i, k]])
        for k in range(4)
    ]
    for among, values in (("pooled", [pooled]), ("example", by_row), ("channel", by_channel)):
        known = [v for v in values if not math.isnan(v)]
        expected = np.mean(known) if known else math.nan
        np.testing.assert_allclose(gate_auroc(w, mask, among=among), expected, atol=1e-12)


def test_gate_auroc_of_known_gates() -> None:
    mask = np.zeros((90, 6), bool)
    mask[30:] = np.argsort(RNG.random((60, 6)), axis=1) < 4
    oracle = np.where(mask, 0.0, 1.0)
    oracle /= oracle.sum(axis=1, keepdims=True)
    for among in ("pooled", "example", "channel"):
        assert gate_auroc(oracle, mask, among=among) == 1.0
        assert gate_auroc(1.0 - oracle, mask, among=among) == 0.0
        assert gate_auroc(np.full((90, 6), 1 / 6), mask, among=among) == 0.5
        assert math.isnan(gate_auroc(oracle, np.zeros_like(mask), among=among))
    assert mean_weights(oracle, mask) == (pytest.approx(0.5), 0.0)
    assert math.isnan(mean_weights(oracle, np.ones_like(mask))[0])
    with pytest.raises(ValueError, match=r"among='row': expected one of 'pooled'"):
        gate_auroc(oracle, mask, among="row")


def test_gap_closure_and_retained_accuracy() -> None:
    assert gap_closure(np.array([0.8, 0.9]), np.array([0.6, 0.8]), np.array([0.9, 1.0])) == (
        pytest.approx(0.6)
    )
    assert gap_closure(0.5, 0.6, 0.8) == pytest.approx(-0.5)
    assert math.isnan(gap_closure(0.7, 0.8, 0.8))
    assert retained_accuracy(0.6, 0.8) == pytest.approx(0.75)
    assert mean_retained_accuracy({"zero": 0.6, "stuck": 0.8, "gain": 0.4}, 0.8) == pytest.approx(
        0.75
    )
    with pytest.raises(ValueError, match=r"clean=0.0: expected a share"):
        retained_accuracy(0.6, 0.0)
    with pytest.raises(ValueError, match="expected at least one failure kind"):
        mean_retained_accuracy({}, 0.8)
