"""Axes: what a constant may be in a sweep, and how it is written on a command line.

tau_z=5,25,100            these values
tau_z=5ms,0.025s          with units
gamma=1e-4:1e-1:log:16    16 values from 1e-4 to 1e-1, evenly spaced in the logarithm
k=0:2:lin:5  or  k=0:2:5  5 values, evenly spaced
gamma=1e-4:1e-1:log       a range (random, Sobol and adaptive designs)
depth=1:4:int             whole numbers of a range
network=S3,S4             words: one compiled program each
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from snn_fusion_failure.sweeps.leaves import parse_number

Kind = Literal["float", "int", "category", "static"]


class Axis(NamedTuple):
    """One leaf and what it may be: a list of values, or a range when `values` is empty.

    Attributes:
        leaf: the constant's name; empty until it stands in a space.
        unit: in which its values are written.
        kind: `float` and `int` are numbers that the compiled program takes; `category` gives it
            the number of the label; `static` values are Python's own, one compiled program each.
        values: the list.
        low, high: the range.
        log: evenly spread in the logarithm.
        every: each value is visited, whatever the design draws of the other axes.
    """

    leaf: str = ""
    unit: str = ""
    kind: Kind = "float"
    values: tuple[Any, ...] = ()
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    every: bool = False

    @property
    def ranges(self) -> bool:
        """Whether values have to be drawn: it has no list."""
        return not self.values

    def at(self, share: np.ndarray) -> list[Any]:
        """Values at a share in [0, 1) of the way through the range or the list."""
        if self.values:
            index = np.minimum((share * len(self.values)).astype(int), len(self.values) - 1)
            return [self.values[i] for i in index]
        low, high = self.low, self.high
        if self.kind == "int":
            high += 1.0  # the last number is as likely as the first
        if self.log:
            drawn = np.exp(np.log(low) + share * (np.log(high) - np.log(low)))
        else:
            drawn = low + share * (high - low)
        if self.kind == "int":
            return [int(v) for v in np.minimum(np.floor(drawn), self.high)]
        return drawn.tolist()

    def share_of(self, value: Any) -> float:
        """Where a value stands, the inverse of `at` up to rounding."""
        if self.values:
            return (self.values.index(value) + 0.5) / len(self.values)
        if self.kind == "int":
            low, high, value = self.low, self.high + 1.0, value + 0.5
        else:
            low, high = self.low, self.high
        if self.log:
            low, high, value = np.log(low), np.log(high), np.log(value)
        return float((value - low) / (high - low))


def grid(*values: float) -> Axis:
    """These numbers, every one of them, each with all values of the other axes.

    Returns:
        The axis, to stand in a space under the name of a constant.

    Example:
        >>> grid(5, 25, 100).values
        (5.0, 25.0, 100.0)

    Raises:
        ValueError: no value, a value twice, or one that is not finite.
    """
    numbers = tuple(float(v) for v in values)
    return _checked(Axis(values=numbers, every=True))


def uniform(low: float, high: float) -> Axis:
    """Numbers of a range, drawn evenly.

    Returns:
        The axis, to stand in a space under the name of a constant.

    Raises:
        ValueError: `low` is not below `high`.

    Example:
        >>> [float(v) for v in uniform(-1.0, 1.0).at(np.array([0.0, 0.5]))]
        [-1.0, 0.0]
    """
    return _checked(Axis(low=float(low), high=float(high)))


def loguniform(low: float, high: float) -> Axis:
    """Numbers of a range, drawn evenly in the logarithm.

    Returns:
        The axis, to stand in a space under the name of a constant.

    Raises:
        ValueError: `low` is not below `high`, or not above 0.

    Example:
        >>> [round(v, 6) for v in loguniform(1e-4, 1e-2).at(np.array([0.0, 0.5]))]
        [0.0001, 0.001]
    """
    return _checked(Axis(low=float(low), high=float(high), log=True))


def integers(low: int, high: int) -> Axis:
    """Whole numbers from `low` to `high`, both included; traced, so none compiles anew.

    Returns:
        The axis, to stand in a space under the name of a constant.

    Raises:
        ValueError: `low` is not below `high`.

    Example:
        >>> integers(1, 6).kind, integers(1, 6).ranges
        ('int', True)
    """
    return _checked(Axis(kind="int", low=int(low), high=int(high)))


def choice(*values: Any) -> Axis:
    """Values that the trial gets as they are: sizes, names, maps, data sets.

    Each compiles a program of its own, once; for numbers that need not be known when the program
    is compiled `grid` is cheaper.

    Returns:
        The axis, to stand in a space under the name of a constant.

    Raises:
        ValueError: no value, a value twice, or one that JSON cannot hold.

    Example:
        >>> choice(32, 64).kind
        'static'
    """
    return _checked(Axis(kind="static", values=tuple(values)))


def categorical(*labels: Any) -> Axis:
    """Labels of which the trial gets the number, traced (for `jax.lax.switch`).

    Returns:
        The axis, to stand in a space under the name of a constant.

    Raises:
        ValueError: no label, a label twice, or one that JSON cannot hold.

    Example:
        >>> categorical("softmax", "sparse").kind
        'category'
    """
    return _checked(Axis(kind="category", values=tuple(labels)))


def _checked(axis: Axis) -> Axis:
    name = f"axis {axis.leaf}" if axis.leaf else "axis"
    if axis.values:
        texts = [json.dumps(v, sort_keys=True, default=lambda x: f"<{type(x).__name__}>")
                 for v in axis.values]  # fmt: skip
        strange = [t for v, t in zip(axis.values, texts, strict=True)
                   if not isinstance(v, str | int | float | bool)]  # fmt: skip
        if strange:
            raise ValueError(f"{name}={strange[0]}: expected a number, a word, true or false")
        if len(set(texts)) < len(texts):
            raise ValueError(f"{name}: {', '.join(texts)} has a value twice; give each once")
        if any(isinstance(v, float) and not np.isfinite(v) for v in axis.values):
            raise ValueError(f"{name}: {', '.join(texts)}: expected finite numbers")
    elif axis.kind in ("category", "static") or not (axis.low < axis.high):
        raise ValueError(
            f"{name}: low={axis.low:g} high={axis.high:g}: expected values, or low below high"
        )
    elif axis.log and axis.low <= 0.0:
        raise ValueError(f"{name}: a logarithmic range starts above 0, not at {axis.low:g}")
    return axis


def parse_axis(
    text: str,
    known: Callable[[str], tuple[str, Kind, Any]],
    unit_of: Callable[[str], str] = lambda leaf: "",
) -> Axis:
    """Read one `leaf=...`.

    Args:
        text: see the module's docstring.
        known: from a name to the leaf that it means, its kind and its default; raises ValueError.
        unit_of: the unit in which a leaf is swept.

    Raises:
        ValueError: names what cannot be read, or the unknown leaf and the known ones.

    Example:
        >>> parse_axis("gamma=1e-4:1e-2:log:3", lambda name: (name, "float", 0.0)).values
        (0.0001, 0.001, 0.01)
    """
    name, equals, body = text.partition("=")
    if not equals or not name.strip() or not body.strip():
        raise ValueError(
            f"axis {text!r}: expected leaf=values, for example gamma=1e-4:1e-1:log:16 or "
            "tau_z=5,25,100"
        )
    leaf, kind, default = known(name.strip())
    unit = unit_of(leaf)

    def number(part: str) -> float:
        return parse_number(part, unit, f"axis {leaf}")

    if kind in ("static", "category"):
        values = tuple(_word(leaf, part, default) for part in body.split(","))
        return _checked(Axis(leaf, unit, kind, values))
    if ":" not in body:
        return _checked(Axis(leaf, unit, kind, tuple(number(part) for part in body.split(","))))
    return _range(leaf, unit, kind, body, number)


def _word(leaf: str, part: str, default: Any) -> Any:
    """A value of a static axis, of the type of the option that it replaces."""
    try:
        value = json.loads(part)
    except json.JSONDecodeError:
        value = part
    if isinstance(default, float) and type(value) is int:
        value = float(value)
    if isinstance(default, str) and not isinstance(value, str):
        value = part
    if default is not None and type(value) is not type(default):
        raise ValueError(f"axis {leaf}={part}: expected a {type(default).__name__}")
    return value


def _range(
    leaf: str, unit: str, kind: Kind, body: str, number: Callable[[str], float]
) -> Axis:  # fmt: skip
    parts = [part.strip() for part in body.split(":")]
    low, high = number(parts[0]), number(parts[1])
    rest: Sequence[str] = parts[2:]
    words = [part for part in rest if part in ("log", "lin", "int")]
    counts = [part for part in rest if part.isdigit()]
    if len(words) + len(counts) < len(rest) or len(counts) > 1 or len(set(words)) < len(words):
        raise ValueError(
            f"axis {leaf}: cannot read {body!r}; expected low:high[:log|lin|int][:count], for "
            "example 1e-4:1e-1:log:16"
        )
    if not low < high:
        raise ValueError(f"axis {leaf}: {parts[0]} is not below {parts[1]}")
    log, whole = "log" in words, "int" in words or kind == "int"
    axis = _checked(Axis(leaf, unit, "int" if whole else "float", (), low, high, log))
    if not counts:
        return axis
    if int(counts[0]) < 2:
        raise ValueError(f"axis {leaf}: {counts[0]} value(s) between two ends; give at least 2")
    spaced = np.geomspace if log else np.linspace
    # 12 digits: 1e-3 shall be written and compared as 1e-3.
    values = tuple(float(f"{v:.12g}") for v in spaced(low, high, int(counts[0])))
    if whole:
        values = tuple(dict.fromkeys(round(v) for v in values))
    return axis._replace(values=values)
