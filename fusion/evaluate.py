"""Scores of a fusion model from arrays: accuracy, gate quality, robustness.

Everything here runs on the host in float64, on the outputs of a model and the mask of failed
channels; nothing needs the model itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple, get_args

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int, Num

from fusion._checks import check_choice

GateAmong = Literal["pooled", "example", "channel"]


class AccuracySplit(NamedTuple):
    """Accuracy of all examples, of the clean ones and of those with a failed channel."""

    overall: float
    clean: float
    corrupted: float


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
                f"{name}=array spanning {array.min()}..{array.max()}: expected 0..{n_classes - 1}; "
                "give the number of classes that they were made for"
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
        raise ValueError(
            "positive, negative=array with NaN or infinity: expected finite scores; NaN has no rank"
        )
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
    check_choice("among", among, get_args(GateAmong))
    m = np.asarray(mask)
    w = np.asarray(weights, dtype=np.float64)[m.any(axis=1)]
    m = m[m.any(axis=1)]
    if among == "pooled":
        return auroc(w[~m], w[m])
    if among == "channel":
        areas = [auroc(w[~m[:, k], k], w[m[:, k], k]) for k in range(m.shape[1])]
    else:
        if not np.isfinite(w).all():
            raise ValueError(
                "weights=array with NaN or infinity: expected finite weights; NaN has no rank"
            )
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
        raise ValueError(f"clean={clean}: expected a share in (0, 1]; divide percent by 100")
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
        raise ValueError("corrupted={}: expected at least one failure kind; give their accuracies")
    return float(np.mean([retained_accuracy(v, clean) for v in corrupted.values()]))
