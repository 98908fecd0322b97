"""Checks of what a user gives, in one grammar: `name=value: expected ...; fix`.

Numbers are checked when they are Python or numpy numbers. Traced values and jax arrays pass: what a
program computes cannot be refused while it is traced.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np


def check_choice(name: str, value: Any, options: Iterable[Any]) -> None:
    """`value` is one of `options`; the message lists them and names the nearest."""
    known = list(options)
    if any(type(value) is type(option) and value == option for option in known):
        return
    near = difflib.get_close_matches(str(value), [str(o) for o in known], 1)
    fix = f"did you mean {near[0]!r}?" if near else "choose one of them"
    raise ValueError(f"{name}={value!r}: expected one of {', '.join(map(repr, known))}; {fix}")


def check_count(name: str, value: Any, low: int = 1, high: int | None = None) -> None:
    """`value` is a whole number in `low .. high`."""
    bounds = (
        f"a whole number of at least {low}" if high is None else f"a whole number {low}..{high}"
    )
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name}={value!r}: expected {bounds}; write it without a decimal point")
    if value < low or (high is not None and value > high):
        fix = "raise it" if value < low else "lower it"
        raise ValueError(f"{name}={value}: expected {bounds}; {fix}")


def check_counts(name: str, values: Any, low: int = 1, *, size: int | None = None) -> None:
    """`values` is a tuple of whole numbers of at least `low`, `size` of them when given."""
    if not isinstance(values, tuple):
        raise TypeError(
            f"{name}={values!r}: expected a tuple of whole numbers; write it with round brackets"
        )
    if size is not None and len(values) != size:
        raise ValueError(f"{name}={values}: expected {size} whole numbers; one for each layer")
    for index, value in enumerate(values):
        check_count(f"{name}[{index}]", value, low)


def check_number(
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    above: bool = False,
    below: bool = False,
    fix: str = "",
) -> None:
    """`value` is a finite number in [low, high]; `above` and `below` exclude the bounds.

    Traced values, jax arrays and other leaves of a tree pass unseen.
    """
    if isinstance(value, bool | str) or value is None:
        raise TypeError(f"{name}={value!r}: expected a number; give one")
    if not isinstance(value, int | float | np.integer | np.floating):
        return
    good = math.isfinite(value) and low <= value <= high
    good = good and not (above and value == low) and not (below and value == high)
    if good:
        return
    if high == math.inf:
        wanted = (
            "a finite number" if low == -math.inf else f"a number {'>' if above else '>='} {low:g}"
        )
    else:
        wanted = f"a number in {'(' if above else '['}{low:g}, {high:g}{')' if below else ']'}"
    raise ValueError(f"{name}={value!r}: expected {wanted}; {fix or 'choose another value'}")


def check_type(name: str, value: Any, kind: type | tuple[type, ...], fix: str) -> None:
    """`value` is an instance of `kind`."""
    if not isinstance(value, kind):
        kinds: Sequence[type] = kind if isinstance(kind, tuple) else (kind,)
        wanted = " or ".join(k.__name__ for k in kinds)
        raise TypeError(f"{name}={type(value).__name__} object: expected {wanted}; {fix}")


def check_key(key: Any, name: str = "key") -> None:
    """`key` is one typed PRNG key, traced or not."""
    if isinstance(key, jax.Array) and jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key):
        return
    shape = getattr(key, "shape", None)
    shown = repr(key) if shape is None else f"array of shape {tuple(shape)}, dtype {key.dtype}"
    raise ValueError(
        f"{name}={shown}: expected a typed PRNG key; make it with jax.random.key(seed), or wrap a "
        "legacy key with jax.random.wrap_key_data"
    )


def check_array(name: str, value: Any) -> None:
    """`value` is an array of numbers, traced or not."""
    if not hasattr(value, "shape"):
        raise TypeError(
            f"{name}={type(value).__name__} object: expected an array of numbers; write "
            f"numpy.asarray({name})"
        )
    if np.dtype(value.dtype).kind in "USOMm":
        raise TypeError(f"{name}.dtype={value.dtype}: expected numbers; convert the readings first")


def check_mask(name: str, value: Any, shape: tuple[Any, ...], *, numbers: bool = False) -> None:
    """`value` is an array of this shape, of truth values unless it may hold `numbers`.

    A size of `shape` may be a symbol: that of the batch is one while a program is exported.
    """
    check_array(name, value)
    if tuple(value.shape) != tuple(shape):
        raise ValueError(
            f"{name}.shape={tuple(value.shape)}: expected {tuple(shape)}; give one value for each "
            "sensor of each window"
        )
    if not numbers and np.dtype(value.dtype).kind not in "biu":
        raise TypeError(
            f"{name}.dtype={value.dtype}: expected True and False; write {name}.astype(bool)"
        )
