"""Samples of an analysis: each simulated once, counted against a budget."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from failure.performances import Performance

Evaluate = Callable[[np.ndarray], np.ndarray]
"""`x [n, d] -> g [n, k]`: violations, above 0 where a specification fails, NaN where unknown."""


class BudgetSpentError(RuntimeError):
    """More simulations were asked for than the budget holds."""


class Archive:
    """All samples of an analysis, each simulated once and counted against a budget."""

    def __init__(self, evaluate: Evaluate, dim: int, budget: int) -> None:
        self._evaluate = evaluate
        self.budget = budget
        self.x = np.zeros((0, dim))
        self.g: np.ndarray | None = None
        self.labels: list[str] = []
        self.spent = 0
        self._known: dict[bytes, np.ndarray] = {}

    @property
    def left(self) -> int:
        """Simulations that the budget still holds."""
        return self.budget - self.spent

    def add(self, x: Float[np.ndarray, "n d"], g: Float[np.ndarray, "n k"], label: str) -> None:
        """Samples that are known already, at no cost."""
        self.x = np.concatenate([self.x, x])
        self.g = g if self.g is None else np.concatenate([self.g, g])
        self.labels += [label] * len(x)
        self._known.update((row.tobytes(), values) for row, values in zip(x, g, strict=True))

    def __call__(self, x: Float[np.ndarray, "n d"], label: str) -> Float[np.ndarray, "n k"]:
        """Violations of new samples.

        Raises:
            BudgetSpentError: the budget does not hold them.
        """
        # Zero has two signs, which are one sample.
        x = np.asarray(x, np.float64) + 0.0
        new = np.array([row for row in x if row.tobytes() not in self._known])
        if len(new) > self.left:
            raise BudgetSpentError(f"{len(new)} simulations wanted, {self.left} left")
        if len(new):
            g = np.asarray(self._evaluate(new), np.float64)
            if g.ndim != 2 or len(g) != len(new):
                raise ValueError(f"violations of shape {g.shape}: expected [{len(new)}, k]")
            self.spent += len(new)
            self.add(new, g, label)
        if len(x) == 0 and self.g is not None:
            return np.zeros((0, self.g.shape[1]))
        return np.array([self._known[row.tobytes()] for row in x])

    def violation(self, spec: int, label: str) -> Performance:
        """One specification as a performance function.

        Unknown violations are no failures and count as the nominal one, -1 in relative terms; NaN
        where the budget does not hold the samples.
        """

        def performance(x: Any) -> np.ndarray:
            try:
                return np.nan_to_num(self(np.asarray(x), label)[:, spec], nan=-1.0)
            except BudgetSpentError:
                return np.full(len(x), np.nan)

        return performance
