"""Scores of probabilities against scikit-learn and loops."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.predictive_scores import (
    aurc,
    brier_score,
    expected_calibration_error,
    negative_log_likelihood,
    risk_coverage,
)

RNG = np.random.default_rng(0)
P = RNG.dirichlet(np.full(4, 0.5), 500)
Y = np.array([RNG.choice(4, p=0.6 * p + 0.1) for p in P])


def test_likelihood_and_brier_are_those_of_scikit_learn() -> None:
    metrics = pytest.importorskip("sklearn.metrics", reason="install the extra `sklearn`")
    wanted = metrics.log_loss(Y, np.maximum(P, 1e-12), labels=range(4))
    assert negative_log_likelihood(P, Y) == pytest.approx(wanted, rel=1e-6)
    by_class = [metrics.brier_score_loss(c == Y, P[:, c]) for c in range(4)]
    assert brier_score(P, Y) == pytest.approx(sum(by_class), rel=1e-12)


@pytest.mark.parametrize("bins", [10, 15])
def test_the_calibration_error_is_that_of_scikit_learns_curve(bins: int) -> None:
    calibration = pytest.importorskip("sklearn.calibration", reason="install the extra `sklearn`")
    confidence, right = P.max(1), P.argmax(1) == Y
    shares, means = calibration.calibration_curve(right, confidence, n_bins=bins)
    counts, _ = np.histogram(confidence, np.linspace(0.0, 1.0, bins + 1))
    counts = counts[counts > 0]
    wanted = np.sum(counts * np.abs(shares - means)) / len(Y)
    assert expected_calibration_error(P, Y, bins=bins) == pytest.approx(wanted, rel=1e-9)


def test_a_sure_and_right_prediction_has_no_error_and_a_border_counts_below() -> None:
    p = np.eye(3)
    assert expected_calibration_error(p, np.array([0, 1, 2])) == 0.0
    assert expected_calibration_error(p, np.array([1, 2, 0])) == 1.0
    # 0.6 and 0.55 share the bin (0.5, 0.6]: half of them are right.
    half = np.array([[0.6, 0.4], [0.55, 0.45]])
    assert expected_calibration_error(half, np.array([0, 1]), bins=10) == pytest.approx(0.075)


def test_risks_are_those_of_a_loop_over_the_surest_examples() -> None:
    confidence, right = RNG.permutation(60) / 60, RNG.random(60) < 0.7
    found = risk_coverage(confidence, right)
    order = sorted(range(60), key=lambda i: -confidence[i])
    for n in (1, 7, 60):
        wrong = sum(not right[i] for i in order[:n])
        assert found.risk[n - 1] == pytest.approx(wrong / n)
        assert found.coverage[n - 1] == pytest.approx(n / 60)
    assert aurc(confidence, right) == pytest.approx(found.risk.mean())


def test_a_constant_confidence_has_the_error_rate_in_any_order() -> None:
    right = np.array([True] * 30 + [False] * 10)
    for order in (right, right[::-1]):
        assert aurc(np.full(40, 0.3), order) == pytest.approx(0.25)
    assert aurc(right.astype(float), right) < 0.25 / 2


@pytest.mark.parametrize(
    ("p", "y", "message"),
    [
        (P, Y[:-1], "labels=array of shape"),
        (P, Y + 3, "expected 0..3"),
        (np.log(P), Y, "apply the softmax"),
        (2 * P, Y, "apply the softmax"),
    ],
)
def test_what_is_no_prediction_is_refused(p: np.ndarray, y: np.ndarray, message: str) -> None:
    for score in (negative_log_likelihood, brier_score, expected_calibration_error):
        with pytest.raises(ValueError, match=message):
            score(p, y)


def test_confidence_without_a_rank_is_refused() -> None:
    with pytest.raises(ValueError, match="expected one finite number"):
        risk_coverage(np.array([0.1, np.nan]), np.array([True, False]))
    with pytest.raises(ValueError, match="bins=0"):
        expected_calibration_error(P, Y, bins=0)
