"""Scores of predicted probabilities: likelihood, Brier, calibration, and what abstaining buys.

Everything runs on the host in float64, on `[example, class]` probabilities and class numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from fusion._checks import check_count

BINS = 15
"""Bins of equal width that the calibration error of record is counted in."""


class RiskCoverage(NamedTuple):
    """Error among the examples that are answered, for every number of them.

    Attributes:
        coverage: share of examples that are answered, `1/n` to 1.
        risk: error rate among them, the surest first.
    """

    coverage: Float[np.ndarray, " n"]
    risk: Float[np.ndarray, " n"]


def _checked(probabilities: ArrayLike, labels: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    p, y = np.asarray(probabilities, np.float64), np.asarray(labels, np.int64)
    if p.ndim != 2 or y.shape != p.shape[:1] or not y.size:
        raise ValueError(
            f"labels=array of shape {y.shape}: expected one class for each of the rows of "
            f"probabilities, shape {p.shape}; give both of the same examples"
        )
    if y.min() < 0 or y.max() >= p.shape[1]:
        raise ValueError(
            f"labels=array spanning {y.min()}..{y.max()}: expected 0..{p.shape[1] - 1}; give the "
            "class numbers that the probabilities were made for"
        )
    # float32 softmax sums to one within about 1e-6.
    if not np.isfinite(p).all() or p.min() < 0.0 or np.abs(p.sum(axis=1) - 1.0).max() > 1e-4:
        raise ValueError(
            "probabilities=array with rows that are no shares: expected values in [0, 1] that sum "
            "to 1 in each row; apply the softmax to logits"
        )
    return p, y


def negative_log_likelihood(probabilities: ArrayLike, labels: ArrayLike) -> float:
    r"""Mean of :math:`-\log p_{n, y_n}`, in nats; probabilities below 1e-12 count as that.

    Raises:
        ValueError: probabilities that are no shares, labels that do not fit.

    Example:
        >>> p, y = np.array([[0.5, 0.5], [0.75, 0.25]]), np.array([0, 0])
        >>> round(negative_log_likelihood(p, y), 4)
        0.4904
    """
    p, y = _checked(probabilities, labels)
    return float(-np.log(np.maximum(p[np.arange(y.size), y], 1e-12)).mean())


def brier_score(probabilities: ArrayLike, labels: ArrayLike) -> float:
    r"""Mean squared distance of the probabilities from the truth, in [0, 2].

    .. math:: \frac1N \sum_n \sum_c \left(p_{nc} - [c = y_n]\right)^2

    Raises:
        ValueError: probabilities that are no shares, labels that do not fit.

    Source: Brier (1950).
    """
    p, y = _checked(probabilities, labels)
    truth = np.eye(p.shape[1])[y]
    return float(((p - truth) ** 2).sum(axis=1).mean())


def expected_calibration_error(
    probabilities: ArrayLike, labels: ArrayLike, *, bins: int = BINS
) -> float:
    r"""How far confidence is from accuracy, over bins of equal width.

    .. math:: \sum_b \frac{n_b}{N} \left|\text{acc}_b - \text{conf}_b\right|

    with the confidence :math:`\max_c p_{nc}` of each example; a confidence on a border counts to
    the bin below it.

    Raises:
        ValueError: probabilities that are no shares, labels that do not fit, no bins.

    Source: Guo et al. (2017), section 2.
    """
    check_count("bins", bins)
    p, y = _checked(probabilities, labels)
    confidence, right = p.max(axis=1), p.argmax(axis=1) == y
    index = np.clip(np.ceil(confidence * bins).astype(int) - 1, 0, bins - 1)
    gap = np.bincount(index, confidence - right, minlength=bins)
    return float(np.abs(gap).sum() / y.size)


def risk_coverage(confidence: ArrayLike, right: ArrayLike) -> RiskCoverage:
    """Error rate among the surest examples, for every number of examples that are answered.

    Examples of equal confidence share their errors evenly, so that the order of rows says nothing.

    Args:
        confidence: the larger, the earlier an example is answered.
        right: True where the prediction is right.

    Raises:
        ValueError: different lengths, no examples, confidence that has no rank.

    Source: El-Yaniv and Wiener (2010).
    """
    c, ok = np.asarray(confidence, np.float64), np.asarray(right, bool)
    if c.shape != ok.shape or c.ndim != 1 or not c.size or not np.isfinite(c).all():
        raise ValueError(
            f"confidence=array of shape {c.shape}: expected one finite number for each of "
            f"{ok.size} predictions; give both of the same examples"
        )
    _, level, count = np.unique(-c, return_inverse=True, return_counts=True)
    wrong = np.bincount(level, ~ok) / count
    errors = np.cumsum(wrong[np.sort(level)])
    answered = np.arange(1, c.size + 1)
    return RiskCoverage(answered / c.size, errors / answered)


def aurc(confidence: ArrayLike, right: ArrayLike) -> float:
    """Area under the risk-coverage curve: the mean of its risks; smaller is better.

    A confidence that says nothing has the error rate; the best possible one answers all right
    examples first.

    Raises:
        ValueError: as `risk_coverage`.

    Source: Geifman et al. (2019).

    Example:
        >>> round(aurc(np.array([0.9, 0.8, 0.7]), np.array([True, True, False])), 4)
        0.1111
    """
    return float(risk_coverage(confidence, right).risk.mean())


def fit_temperature(logits: ArrayLike, labels: ArrayLike) -> float:
    r"""The T that minimizes the cross entropy of `softmax(logits / T)`; between 0.05 and 20.

    Args:
        logits: `[n, class]` of held-out rows, or logarithms of probabilities.
        labels: their classes.

    Source: Guo et al. (2017).
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import log_softmax

    y = np.asarray(labels)
    rows = np.arange(len(y))
    z = np.asarray(logits, np.float64)

    def loss(log_t: float) -> float:
        return -float(log_softmax(z / np.exp(log_t), axis=1)[rows, y].mean())

    found = minimize_scalar(loss, bounds=(np.log(0.05), np.log(20.0)), method="bounded")
    return float(np.exp(found.x))


def outcome_brier(
    probabilities: ArrayLike,
    outcomes: ArrayLike,
    weights: ArrayLike | None = None,
) -> float:
    r"""Mean squared distance of the told probabilities of an event to what happened, in [0, 1].

    .. math:: B = \sum_i w_i (p_i - y_i)^2 / \sum_i w_i

    Symbols: :math:`p` is `probabilities`, :math:`y` is `outcomes`, :math:`w` is `weights` (alike
    when left out).

    Source: Brier (1950).

    Example:
        >>> outcome_brier(np.array([0.5, 1.0]), np.array([True, True]))
        0.125
    """
    p, y, w = _told(probabilities, outcomes, weights)
    return float(np.sum(w * (p - y) ** 2))


def outcome_calibration_error(
    probabilities: ArrayLike,
    outcomes: ArrayLike,
    weights: ArrayLike | None = None,
    n_bins: int = 10,
) -> float:
    r"""Expected calibration error: how far told probabilities lie from shares of what happened.

    .. math:: E = \sum_b W_b \, |\bar p_b - \bar y_b|

    over `n_bins` bins of equal width, with :math:`W_b` the share of a bin and bars means in it.

    Source: Naeini, Cooper, Hauskrecht (2015).

    Example:
        >>> outcome_calibration_error(np.array([0.9, 0.9]), np.array([True, False]))
        0.4
    """
    p, y, w = _told(probabilities, outcomes, weights)
    place = np.minimum((p * n_bins).astype(np.int64), n_bins - 1)
    gaps = np.bincount(place, weights=w * (p - y), minlength=n_bins)
    return float(np.abs(gaps).sum())


def _told(
    probabilities: ArrayLike, outcomes: ArrayLike, weights: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All three in float64, the weights summing to one."""
    p, y = np.asarray(probabilities, np.float64), np.asarray(outcomes, np.float64)
    w = np.ones_like(p) if weights is None else np.asarray(weights, np.float64)
    if not p.size or not ((p >= 0) & (p <= 1)).all():
        raise ValueError(
            "probabilities=array: expected numbers from 0 to 1, at least one; leave out what is "
            "not told"
        )
    return p, y, w / w.sum()
