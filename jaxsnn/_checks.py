"""Checks of what a user gives, all with one grammar: `name=value: expected ...; fix`.

Values that are traced pass: inside jit nothing can be looked at.
"""

from __future__ import annotations

import numbers
from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def default_float() -> Any:
    """The dtype that states are made in: float32, or float64 under `jax.enable_x64`."""
    return jnp.result_type(float)


def concrete(value: Any) -> np.ndarray | None:
    """The value as numbers, or None when it is traced: inside jit nothing can be checked."""
    if isinstance(value, jax.core.Tracer):
        return None
    return np.asarray(value)


def require(condition: bool, message: str) -> None:
    """Raise ValueError with `message` unless the condition holds."""
    if not condition:
        raise ValueError(message)


def require_choice(name: str, value: Any, allowed: Collection[Any]) -> None:
    """`value` is one of `allowed`."""
    if value not in allowed:
        words = ", ".join(map(repr, allowed))
        raise ValueError(f"{name}={value!r}: expected one of {words}; choose one of them")


def require_whole(name: str, value: Any, least: int, fix: str) -> None:
    """`value` is a whole number >= `least`.

    Raises:
        TypeError: it is no integer (104.0 is none).
        ValueError: it is too small.
    """
    if not isinstance(value, numbers.Integral) or isinstance(value, bool):
        raise TypeError(f"{name}={value!r}: expected a whole number; write it without a point")
    if value < least:
        raise ValueError(f"{name}={value}: expected a whole number >= {least}; {fix}")


def require_positive(name: str, value: Any, fix: str, *, zero: bool = False) -> None:
    """`value` (any shape) is finite and > 0 (or >= 0); traced values pass."""
    given = concrete(value)
    if given is None:
        return
    good = np.isfinite(given) & ((given >= 0) if zero else (given > 0))
    if not good.all():
        bound = ">= 0" if zero else "> 0"
        raise ValueError(f"{name}={given[~good].flat[0]}: expected a number {bound}; {fix}")


def require_finite(name: str, value: Any, fix: str) -> None:
    """`value` (any shape) has no NaN and no infinity; traced values pass."""
    given = concrete(value)
    if given is None:
        return
    good = np.isfinite(given)
    if not good.all():
        what = f"{given[~good].flat[0]}"
        if given.ndim:
            what += f" in {int((~good).sum())} of {good.size} values"
        raise ValueError(f"{name}={what}: expected finite numbers; {fix}")


def require_key(key: Any, name: str = "key") -> None:
    """`key` is one typed key, as `jax.random.key` makes it."""
    _require_typed(key, name)
    require(
        key.ndim == 0,
        f"{name}=<{key.shape} keys>: expected a single key; vmap over them or take one",
    )


def require_keys(keys: Any, name: str = "keys") -> None:
    """`keys` are typed keys along one axis, at least one."""
    _require_typed(keys, name)
    require(
        keys.ndim == 1 and keys.shape[0] > 0,
        f"{name}=<shape {keys.shape}>: expected one key per robot, at least one; use "
        "jax.random.split(jax.random.key(seed), robots)",
    )


def _require_typed(key: Any, name: str) -> None:
    dtype = getattr(key, "dtype", None)
    if dtype is None or not jnp.issubdtype(dtype, jax.dtypes.prng_key):
        what = f"<{dtype or type(key).__name__}>"
        raise ValueError(f"{name}={what}: expected a typed key; use jax.random.key(seed)")
