"""Scores of a fusion model from arrays: accuracy, gate quality, robustness, comparison over seeds.

Everything here runs on the host in float64, on the outputs of a model and the mask of failed
channels; nothing needs the model itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int, Num
from scipy import special

__all__ = [
    "AccuracySplit",
    "Interval",
    "PairedTest",
    "accuracy",
    "auroc",
    "confusion_matrix",
    "gap_closure",
    "gate_auroc",
    "mean_interval",
    "mean_retained_accuracy",
    "mean_weights",
    "paired_test",
    "retained_accuracy",
    "split_accuracy",
]

GateAmong = Literal["pooled", "example", "channel"]


class AccuracySplit(NamedTuple):
    """Accuracy of all examples, of the clean ones and of those with a failed channel."""

    overall: float
    clean: float
    corrupted: float


class Interval(NamedTuple):
    """Mean of n runs with a confidence interval and the standard deviation of one run."""

    mean: float
    low: float
    high: float
    sd: float
    n: int


class PairedTest(NamedTuple):
    """Mean difference of n paired runs, its interval, and the t test of no difference."""

    difference: float
    low: float
    high: float
    t: float
    p_value: float
    n: int


def accuracy(labels: Int[ArrayLike, " n"], predictions: Int[ArrayLike, " n"]) -> float:
    """Share of right predictions; NaN for no examples.

    Example:
        >>> accuracy(np.array([0, 1, 1, 2]), np.array([0, 1, 2, 2]))
        0.75
    """
    right = np.asarray(labels) == np.asarray(predictions)
    return float(right.mean()) if right.size else float("nan")


def split_accuracy(
    labels: Int[ArrayLike, " n"], predictions: Int[ArrayLike, " n"], mask: Bool[ArrayLike, "n k"]
) -> AccuracySplit:
    """Accuracy overall, on the clean third and on the corrupted two thirds.

    Args:
        labels, predictions: class of each example.
        mask: True where a channel has failed; an example with no failed channel counts as clean.

    Returns:
        AccuracySplit; NaN for a part without examples.
    """
    y, p = np.asarray(labels), np.asarray(predictions)
    corrupted = np.asarray(mask).any(axis=1)
    return AccuracySplit(
        accuracy(y, p), accuracy(y[~corrupted], p[~corrupted]), accuracy(y[corrupted], p[corrupted])
    )


def confusion_matrix(
    labels: Int[ArrayLike, " n"], predictions: Int[ArrayLike, " n"], n_classes: int
) -> Int[np.ndarray, "c c"]:
    """Number of examples of each true class (row) predicted as each class (column).

    Raises:
        ValueError: a label or prediction outside 0..n_classes-1.

    Example:
        >>> confusion_matrix(np.array([0, 0, 1]), np.array([0, 1, 1]), 2).tolist()
        [[1, 1], [0, 1]]
    """
    y, p = np.asarray(labels, dtype=np.int64), np.asarray(predictions, dtype=np.int64)
    for name, array in (("labels", y), ("predictions", p)):
        if array.size and (array.min() < 0 or array.max() >= n_classes):
            raise ValueError(
                f"{name} span {array.min()}..{array.max()}, expected 0..{n_classes - 1}"
            )
    counts = np.bincount(y * n_classes + p, minlength=n_classes * n_classes)
    return counts.reshape(n_classes, n_classes)


def auroc(positive: Num[ArrayLike, " p"], negative: Num[ArrayLike, " q"]) -> float:
    r"""Area under the ROC curve as an exact rank statistic, ties counted half.

    .. math:: A = \frac{1}{pq} \sum_{i,j} \left([a_i > b_j] + \tfrac12 [a_i = b_j]\right)

    Symbols: :math:`a` is `positive` (p scores), :math:`b` is `negative` (q scores).

    Returns:
        A value in [0, 1]: the chance that a random positive scores above a random negative; NaN
        when one side is empty.

    Source: Mann and Whitney (1947); Hanley and McNeil (1982).

    Example:
        >>> auroc(np.array([1.0, 2.0]), np.array([0.0, 1.0]))
        0.875
    """
    a, b = np.asarray(positive, dtype=np.float64), np.sort(np.asarray(negative, dtype=np.float64))
    if not a.size or not b.size:
        return float("nan")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("scores hold NaN or infinite values: they have no rank")
    below = np.searchsorted(b, a, side="left").sum(dtype=np.int64)
    up_to = np.searchsorted(b, a, side="right").sum(dtype=np.int64)
    return float((below + up_to) / (2 * a.size * b.size))


def gate_auroc(
    weights: Float[ArrayLike, "n k"],
    mask: Bool[ArrayLike, "n k"],
    *,
    among: str = "pooled",
) -> float:
    """How well fusion weights tell clean channels from failed ones: 1 always, 0.5 not at all.

    Only corrupted examples count: weights sum to one in an example, so those of a clean example say
    nothing about a failure.

    Args:
        weights: fusion weights, one set per example.
        mask: True where a channel has failed.
        among: which weights are compared. `pooled`: every clean channel with every failed channel
            of all corrupted examples; `example`: within each example, then the mean over examples
            that have both; `channel`: each channel's weight when clean with its weight when failed
            (as Figure 3.7 of the source), then the mean over channels that have both.

    Returns:
        AUROC in [0, 1]; NaN when no pair can be formed.

    Raises:
        ValueError: unknown `among`; non-finite weights.
    """
    if among not in get_args(GateAmong):
        raise ValueError(f"among is {among!r}, expected one of {list(get_args(GateAmong))}")
    m = np.asarray(mask)
    w = np.asarray(weights, dtype=np.float64)[m.any(axis=1)]
    m = m[m.any(axis=1)]
    if among == "pooled":
        return auroc(w[~m], w[m])
    if among == "channel":
        areas = [auroc(w[~m[:, k], k], w[m[:, k], k]) for k in range(m.shape[1])]
    else:
        if not np.isfinite(w).all():
            raise ValueError("weights hold NaN or infinite values: they have no rank")
        wins = (w[:, :, None] > w[:, None, :]) + 0.5 * (w[:, :, None] == w[:, None, :])
        pairs = ~m[:, :, None] & m[:, None, :]
        count = pairs.sum(axis=(1, 2))
        both = count > 0
        areas = list((wins * pairs).sum(axis=(1, 2))[both] / count[both])
    known = [a for a in areas if np.isfinite(a)]
    return float(np.mean(known)) if known else float("nan")


def mean_weights(
    weights: Float[ArrayLike, "n k"], mask: Bool[ArrayLike, "n k"]
) -> tuple[float, float]:
    """Mean fusion weight of clean and of failed channels over the corrupted examples.

    Returns:
        (mean weight of a clean channel, mean weight of a failed channel); NaN where there is none.
    """
    m = np.asarray(mask)
    rows = m.any(axis=1)
    w, m = np.asarray(weights, dtype=np.float64)[rows], m[rows]
    clean, failed = w[~m], w[m]
    return (
        float(clean.mean()) if clean.size else float("nan"),
        float(failed.mean()) if failed.size else float("nan"),
    )


def gap_closure(
    model: Float[ArrayLike, "*s"], baseline: Float[ArrayLike, "*s"], oracle: Float[ArrayLike, "*s"]
) -> float:
    r"""Share of the distance from a baseline to the oracle gate that a model closes.

    .. math:: g = \frac{\bar a - \bar b}{\bar o - \bar b}

    Symbols: :math:`a, b, o` are the accuracies of `model`, `baseline` and `oracle` (a gate
    that is told which channels failed); bars are means over seeds.

    Returns:
        1 at the oracle, 0 at the baseline, negative below it; NaN when the oracle is not above the
        baseline, where the share has no meaning.

    Example:
        >>> gap_closure(0.75, 0.5, 0.8125)
        0.8
    """
    a, b, o = (float(np.mean(np.asarray(v, dtype=np.float64))) for v in (model, baseline, oracle))
    return (a - b) / (o - b) if o > b else float("nan")


def retained_accuracy(corrupted: float, clean: float) -> float:
    """RA, accuracy under a failure divided by accuracy on clean data.

    Raises:
        ValueError: clean accuracy is not in (0, 1].

    Source: Beemelmanns et al. (2024), MultiCorrupt, resistance ability.
    """
    if not 0.0 < clean <= 1.0:
        raise ValueError(f"clean accuracy is {clean}, expected a share in (0, 1]")
    return corrupted / clean


def mean_retained_accuracy(corrupted: Mapping[str, float], clean: float) -> float:
    """mRA, the mean of `retained_accuracy` over F failure kinds: `mRA = sum_f A_f / (F A_clean)`.

    Args:
        corrupted: failure kind -> accuracy under it.
        clean: accuracy on clean data.

    Raises:
        ValueError: no kinds, or clean accuracy not in (0, 1].

    Example:
        >>> mean_retained_accuracy({"zero": 0.8, "drift": 0.6}, 0.8)
        0.875
    """
    if not corrupted:
        raise ValueError("no failure kinds given, expected at least one")
    return float(np.mean([retained_accuracy(v, clean) for v in corrupted.values()]))


def _values(name: str, values: Sequence[float] | ArrayLike) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or array.size < 2:
        raise ValueError(f"{name} has shape {array.shape}, expected at least two runs in one axis")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds NaN or infinite values: a run has failed")
    return array


def mean_interval(values: Sequence[float] | ArrayLike, *, level: float = 0.95) -> Interval:
    r"""Mean over seeds and its confidence interval by Student's t.

    .. math:: \bar x \pm t_{n-1, (1 + p) / 2}\, s / \sqrt n

    Symbols: :math:`p` is `level`; :math:`s` is the standard deviation with n - 1 in the divisor.

    Raises:
        ValueError: fewer than two values, non-finite values, or `level` outside (0, 1).
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is {level}, expected a share in (0, 1), such as 0.95")
    x = _values("values", values)
    sd = float(x.std(ddof=1))
    half = float(special.stdtrit(x.size - 1, (1.0 + level) / 2.0)) * sd / x.size**0.5
    mean = float(x.mean())
    return Interval(mean, mean - half, mean + half, sd, x.size)


def paired_test(
    a: Sequence[float] | ArrayLike, b: Sequence[float] | ArrayLike, *, level: float = 0.95
) -> PairedTest:
    r"""Compare two models run by run (same seed, same corruption, same split).

    .. math:: d_i = a_i - b_i, \qquad t = \frac{\bar d}{s_d / \sqrt n}

    Args:
        a, b: a score of each model in each run, in the same order.
        level: of the interval of the mean difference.

    Returns:
        PairedTest with the two-sided p value. When all differences are equal, t is infinite and p
        is 0, or t is 0 and p is 1 if they are all zero.

    Raises:
        ValueError: different lengths, fewer than two runs, or non-finite values.

    Source: Student (1908).
    """
    x, y = _values("a", a), _values("b", b)
    if x.size != y.size:
        raise ValueError(f"{x.size} runs against {y.size}: a paired test needs the same runs")
    d = mean_interval(x - y, level=level)
    if d.sd > 0.0:
        t = d.mean / (d.sd / d.n**0.5)
    else:
        t = float(np.copysign(np.inf, d.mean)) if d.mean else 0.0
    p = 2.0 * float(special.stdtr(d.n - 1, -abs(t)))
    return PairedTest(d.mean, d.low, d.high, t, p, d.n)
