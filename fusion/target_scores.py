"""Scores of classes, numbers and labels, overall, without and with failed sensors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fusion.data.csv_folder import TargetKind


def balanced_accuracy(output: np.ndarray, target: np.ndarray) -> float:
    r"""Mean over the classes that occur of the share of their rows that is found, in %.

    Example:
        >>> balanced_accuracy(np.eye(2)[[0, 0, 0, 0]], np.array([0, 0, 0, 1]))
        50.0
    """
    right = output.argmax(-1) == target
    return 100.0 * float(np.mean([right[target == c].mean() for c in np.unique(target)]))


def explained(output: np.ndarray, target: np.ndarray) -> float:
    r"""Share of the variance that is explained, the mean over columns, in %.

    .. math:: R^2 = 1 - \sum_n (y_n - \hat y_n)^2 / \sum_n (y_n - \bar y)^2

    Example:
        >>> explained(np.array([[1.0], [3.0]]), np.array([[0.0], [4.0]]))
        75.0
    """
    left = ((output - target) ** 2).sum(axis=0)
    return 100.0 * float(np.mean(1.0 - left / ((target - target.mean(axis=0)) ** 2).sum(axis=0)))


def macro_f1(output: np.ndarray, target: np.ndarray) -> float:
    r"""F1 of each label at the threshold of one half, the mean over labels, in %.

    .. math:: F_1 = 2\,TP / (2\,TP + FP + FN)

    A label that occurs neither in the rows nor in the predictions counts as 1.

    Example:
        >>> round(macro_f1(np.array([[1.0], [1.0], [-1.0]]), np.array([[1.0], [0.0], [0.0]])), 2)
        66.67
    """
    said, true = output > 0.0, target > 0.5
    hits, wrong = (said & true).sum(axis=0), (said ^ true).sum(axis=0)
    whole = 2 * hits + wrong
    return 100.0 * float(np.mean(np.where(whole > 0, 2 * hits / np.maximum(whole, 1), 1.0)))


def _accuracy(output: np.ndarray, target: np.ndarray) -> float:
    return 100.0 * float((output.argmax(-1) == target).mean())


def _rmse(output: np.ndarray, target: np.ndarray) -> float:
    return float(np.sqrt(((output - target) ** 2).mean()))


def _exact(output: np.ndarray, target: np.ndarray) -> float:
    return 100.0 * float(((output > 0.0) == (target > 0.5)).all(axis=-1).mean())


SCORES: dict[TargetKind, dict[str, Callable[[np.ndarray, np.ndarray], float]]] = {
    "classes": {"accuracy": _accuracy, "balanced_accuracy": balanced_accuracy},
    "numbers": {"explained": explained, "rmse": _rmse},
    "labels": {"macro_f1": macro_f1, "exact": _exact},
}
"""Kind of target -> name -> score of outputs and targets; the first is the headline."""


def target_scores(
    kind: TargetKind, output: np.ndarray, target: np.ndarray, failed: np.ndarray
) -> dict[str, float]:
    """Each score of all rows, and with `_clean` and `_corrupted` of the parts of them.

    Args:
        kind: of the target.
        output: logits, or numbers in their own units.
        target: class numbers, numbers or labels.
        failed: `[N, sensor]`; a row with a failed sensor counts as corrupted.

    Returns:
        Scores; NaN for a part without rows.
    """
    corrupted = failed.any(axis=1)
    parts = {"": np.ones(len(target), bool), "_clean": ~corrupted, "_corrupted": corrupted}
    return {
        f"{name}{part}": score(output[rows], target[rows]) if rows.any() else float("nan")
        for name, score in SCORES[kind].items()
        for part, rows in parts.items()
    }
