"""Leaves of a `Params` tree by dotted name: list them, find the one a user means, fill a batch."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

# What one of a unit is in the unit that the code computes with.
UNITS = {
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9,
    "mV": 1.0, "V": 1e3, "Hz": 1.0, "kHz": 1e3, "px": 1.0, "deg": 1.0, "sigma": 1.0,
}  # fmt: skip
_KINDS = (("s", "ms", "us", "ns"), ("mV", "V"), ("Hz", "kHz"), ("px",), ("deg",), ("sigma",))
# What `scripts/train_snn.py` writes before the name of a leaf of the outermost tuple.
PREFIXES = ("params.",)
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?inf|nan)([A-Za-z]*)")


def leaf_names(params: Any) -> tuple[str, ...]:
    """Dotted names of all leaves, in the order of `jax.tree.leaves`.

    Example:
        >>> from jaxsnn.neurons import LIFParams
        >>> leaf_names(LIFParams())[:2]
        ('tau_m', 'v_rest')
    """
    import jax

    paths = jax.tree_util.tree_flatten_with_path(params)[0]
    return tuple(
        ".".join(str(getattr(k, "name", getattr(k, "key", getattr(k, "idx", k)))) for k in path)
        for path, _ in paths
    )


def resolve(name: str, known: Sequence[str]) -> str:
    """The leaf that `name` means: a full dotted name, or a last part that only one leaf has.

    Raises:
        ValueError: no leaf or several leaves fit; the message lists them.

    Example:
        >>> resolve("tau_z", ["gamma", "stdp.tau_z"]), resolve("params.gamma", ["gamma"])
        ('stdp.tau_z', 'gamma')
    """
    if name in known:
        return name
    for prefix in PREFIXES:
        if name.startswith(prefix) and name[len(prefix) :] in known:
            return name[len(prefix) :]
    ends = [leaf for leaf in known if leaf.endswith("." + name)]
    if len(ends) == 1:
        return ends[0]
    if ends:
        raise ValueError(f"{name!r} names several leaves: {', '.join(ends)}; give the whole name")
    near = difflib.get_close_matches(name, [*known, *(k.rpartition(".")[2] for k in known)], 1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    raise ValueError(f"{name!r} is no leaf of this study{hint}; its leaves: {', '.join(known)}")


def in_unit(value: float, given: str, unit: str, what: str) -> float:
    """`value`, given in unit `given` (bare when empty), in the unit `unit` of an axis.

    Raises:
        ValueError: the units do not measure the same thing.

    Example:
        >>> in_unit(0.025, "s", "ms", "tau_z"), in_unit(25.0, "", "ms", "tau_z")
        (25.0, 25.0)
    """
    if not given or given == unit:
        return value
    kind = next((k for k in _KINDS if unit in k), ())
    if given not in kind:
        fits = f"expected {' or '.join(kind)}" if kind else "it has no unit"
        raise ValueError(f"{what}: unit {given!r} does not fit; {fits}")
    # Round away the last bits of the conversion, so that 25ms and 0.025s are one value.
    return float(f"{value * UNITS[given] / UNITS[unit]:.15g}")


def parse_number(text: str, unit: str, what: str) -> float:
    """A number with an optional unit behind it, in the unit of its axis.

    Raises:
        ValueError: it is no finite number.
    """
    match = _NUMBER.fullmatch(text.strip())
    if not match or not np.isfinite(float(match[1])):
        raise ValueError(f"{what}: {text!r} is not a finite number (0.5, 1e-4, 25ms ...)")
    return in_unit(float(match[1]), match[2], unit, what)


def batch(
    params: Any, columns: Mapping[str, np.ndarray], n: int, units: Mapping[str, str], dtype: str
) -> Any:
    """A tree like `params` whose leaves are `[n]` arrays: a column where there is one.

    Args:
        params: the study's own constants; a whole number stays one (int32).
        columns: leaf name -> values in the axis' unit, `[n]`.
        n: trials.
        units: unit of an axis, by leaf.
        dtype: of the other arrays.
    """
    import jax

    leaves, tree = jax.tree.flatten(params)
    filled = []
    for name, leaf in zip(leaf_names(params), leaves, strict=True):
        kind = "int32" if isinstance(leaf, int) and not isinstance(leaf, bool) else dtype
        if name in columns:
            values = np.asarray(columns[name], np.float64) * UNITS.get(units.get(name, ""), 1.0)
        else:
            values = np.full(n, float(leaf))
        filled.append(values.astype(kind))
    return jax.tree.unflatten(tree, filled)
