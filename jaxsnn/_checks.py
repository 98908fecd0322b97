"""Checks of what a user gives: one sentence with the value, what was expected and the fix."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

__all__ = ["concrete", "require", "require_finite", "require_positive"]


def concrete(value: Any) -> np.ndarray | None:
    """The value as numbers, or None when it is traced: inside jit nothing can be checked."""
    if isinstance(value, jax.core.Tracer):
        return None
    return np.asarray(value)


def require(condition: bool, message: str) -> None:
    """Raise ValueError with `message` unless the condition holds."""
    if not condition:
        raise ValueError(message)


def require_positive(name: str, value: Any, fix: str, *, zero: bool = False) -> None:
    """`value` (any shape) is finite and > 0 (or >= 0); traced values pass."""
    numbers = concrete(value)
    if numbers is None:
        return
    good = np.isfinite(numbers) & ((numbers >= 0) if zero else (numbers > 0))
    if not good.all():
        bound = ">= 0" if zero else "> 0"
        raise ValueError(f"{name} = {numbers[~good].flat[0]}: expected a number {bound}; {fix}")


def require_finite(name: str, value: Any, fix: str) -> None:
    """`value` (any shape) has no NaN and no infinity; traced values pass."""
    numbers = concrete(value)
    if numbers is None:
        return
    good = np.isfinite(numbers)
    if not good.all():
        count = int((~good).sum())
        raise ValueError(f"{name} holds {count} of {good.size} values that are not finite; {fix}")
