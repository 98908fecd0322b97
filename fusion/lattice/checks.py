"""Checks of configurations, keys and shapes that all layers share, and their one form of error."""

from __future__ import annotations

import dataclasses
import numbers
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Shaped


def refusal(name: str, value: object, expected: str, fix: str) -> ValueError:
    """The error of a bad value: `name=value: expected ...; fix`.

    Example:
        >>> str(refusal("n_inputs", 0, "1 or more", "give the number of columns"))
        'n_inputs=0: expected 1 or more; give the number of columns'
    """
    return ValueError(f"{name}={value!r}: expected {expected}; {fix}")


def require_static(config: Any) -> None:
    """Refuse fields that cannot be hashed: a configuration is static under `jit`.

    Raises:
        TypeError: a field is a list or an array; the text shows the tuple to write.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        try:
            hash(value)
        except TypeError:
            tuples = _tuples(value)
            raise TypeError(
                f"{field.name}={value!r}: expected tuples, since a configuration is static under "
                f"jit; write {tuples!r}"
            ) from None


def _tuples(value: Any) -> Any:
    if isinstance(value, np.ndarray | jax.Array):
        value = np.asarray(value).tolist()
    return tuple(_tuples(v) for v in value) if isinstance(value, list | tuple) else value


def require_count(name: str, value: Any, least: int = 1) -> None:
    """Refuse what is not a whole number of at least `least`.

    Raises:
        TypeError: not a whole number.
        ValueError: too small.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name}={value!r}: expected a whole number; write an int")
    if value < least:
        raise refusal(name, value, f"{least} or more", f"set {name} to {least} at least")


def require_range(name: str, value: Any) -> None:
    """Refuse what is not `(low, high)` with finite `low < high`, either of which may be None."""
    if not isinstance(value, tuple) or len(value) != 2:
        raise refusal(name, value, "a pair (low, high)", "write None for a side without a bound")
    low, high = value
    if any(side is not None and not np.isfinite(side) for side in value):
        raise refusal(name, value, "finite bounds", "write None for a side without a bound")
    if low is not None and high is not None and not low < high:
        raise refusal(name, value, "low < high", "exchange the two, or widen the range")


def require_signs(name: str, value: Any, n: int) -> None:
    """Refuse what is neither None nor a tuple of `n` entries out of -1, 0, 1."""
    if value is None:
        return
    good = isinstance(value, tuple) and len(value) == n
    if not good or any(isinstance(s, bool) or s not in (-1, 0, 1) for s in value):
        raise refusal(
            name, value, f"-1, 0 or 1 for each of {n} inputs", f"write a tuple of {n}, 0 for free"
        )


def require_key(given: Shaped[Array, "..."]) -> None:
    """Refuse a legacy key (two words of uint32).

    Raises:
        ValueError: the key is not a typed one.
    """
    if not (hasattr(given, "dtype") and jnp.issubdtype(given.dtype, jax.dtypes.prng_key)):
        kind = getattr(given, "dtype", type(given).__name__)
        raise ValueError(f"key={kind}: expected a typed key; use jax.random.key(seed)")


def require_width(x: Array, width: int, layer: str) -> None:
    """Refuse inputs whose last axis is not `width`, which could broadcast to something else."""
    if x.ndim == 0 or x.shape[-1] != width:
        raise ValueError(
            f"x.shape={tuple(x.shape)}: {layer} expected [..., {width}], the inputs on the last "
            "axis; write x[..., None] for a single one"
        )
