"""Designs: which settings a sweep visits. Grid, random draws, or a Sobol sequence.

An axis is written `leaf=...`:

    tau_z=5,25,100            these values
    tau_z=5ms,0.025s          with units
    gamma=1e-4:1e-1:log:16    16 values from 1e-4 to 1e-1, evenly spaced in the logarithm
    k=0:2:lin:5  or  k=0:2:5  5 values, evenly spaced
    gamma=1e-4:1e-1:log       a range (random and Sobol designs)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from snn_fusion_failure.sweeps.leaves import parse_number, resolve

__all__ = ["Axis", "Design", "design", "parse_axis"]

Kind = Literal["grid", "random", "sobol"]


class Axis(NamedTuple):
    """One leaf and what it may be: a list of values, or a range when `values` is empty."""

    leaf: str
    unit: str
    values: tuple[float, ...]
    low: float = 0.0
    high: float = 0.0
    log: bool = False

    def at(self, share: np.ndarray) -> np.ndarray:
        """Points at a share in [0, 1) of the way through the range or the list."""
        if self.values:
            index = np.minimum((share * len(self.values)).astype(int), len(self.values) - 1)
            return np.asarray(self.values)[index]
        if self.log:
            return np.exp(np.log(self.low) + share * (np.log(self.high) - np.log(self.low)))
        return self.low + share * (self.high - self.low)


class Design(NamedTuple):
    """Settings in rows, axes in columns.

    Attributes:
        kind: "grid", "random" or "sobol".
        axes: what was asked for.
        values: `[settings, axes]` in the axes' units.
        shape: of the grid; `(settings,)` for the other designs.
    """

    kind: str
    axes: tuple[Axis, ...]
    values: np.ndarray
    shape: tuple[int, ...]

    @property
    def n(self) -> int:
        """Number of settings."""
        return len(self.values)


def parse_axis(text: str, known: Sequence[str], unit_of: Callable[[str], str]) -> Axis:
    """Read one `leaf=...`.

    Args:
        text: see the module's docstring.
        known: leaf names of the study.
        unit_of: the unit in which a leaf is swept.

    Raises:
        ValueError: names what cannot be read, or the unknown leaf and the known ones.

    Example:
        >>> parse_axis("gamma=1e-4:1e-2:log:3", ["gamma"], lambda leaf: "").values
        (0.0001, 0.001, 0.01)
    """
    name, equals, body = text.partition("=")
    if not equals or not name.strip() or not body.strip():
        raise ValueError(
            f"axis {text!r}: expected leaf=values, for example gamma=1e-4:1e-1:log:16 or "
            "tau_z=5,25,100"
        )
    leaf = resolve(name.strip(), known)
    unit = unit_of(leaf)

    def number(part: str) -> float:
        return parse_number(part, unit, f"axis {leaf}")

    if ":" not in body:
        values = tuple(number(part) for part in body.split(","))
        if len(set(values)) < len(values):
            raise ValueError(f"axis {leaf}: {body!r} has a value twice")
        return Axis(leaf, unit, values)
    parts = [part.strip() for part in body.split(":")]
    low, high = number(parts[0]), number(parts[1])
    rest = parts[2:]
    scale = rest.pop(0) if rest and rest[0] in ("log", "lin") else "lin"
    count = rest.pop(0) if rest else None
    if rest or (count is not None and not count.isdigit()):
        raise ValueError(
            f"axis {leaf}: cannot read {body!r}; expected low:high[:log|lin][:count], for example "
            "1e-4:1e-1:log:16"
        )
    if not low < high:
        raise ValueError(f"axis {leaf}: {parts[0]} is not below {parts[1]}")
    if scale == "log" and low <= 0.0:
        raise ValueError(f"axis {leaf}: a logarithmic range starts above 0, not at {low:g}")
    if count is None:
        return Axis(leaf, unit, (), low, high, scale == "log")
    if int(count) < 2:
        raise ValueError(f"axis {leaf}: {count} value(s) between two ends; give at least 2")
    spaced = np.geomspace if scale == "log" else np.linspace
    # 12 digits: 1e-3 shall be written and compared as 1e-3.
    values = tuple(float(f"{v:.12g}") for v in spaced(low, high, int(count)))
    return Axis(leaf, unit, values, low, high, scale == "log")


def design(kind: Kind, axes: Sequence[Axis], *, samples: int = 0, seed: int = 0) -> Design:
    """All settings of a sweep.

    Args:
        kind: "grid" (the product of all axes), "random" or "sobol" (scrambled).
        axes: at least one, each leaf once.
        samples: settings of a random or Sobol design; the first n of a longer one are the same.
        seed: of the random or scrambled points.

    Raises:
        ValueError: no axis, a leaf twice, a range in a grid, no samples.

    Example:
        >>> axes = [Axis("a", "", (1.0, 2.0)), Axis("b", "", (3.0, 4.0, 5.0))]
        >>> design("grid", axes).values[:2].tolist()
        [[1.0, 3.0], [1.0, 4.0]]
    """
    if not axes:
        raise ValueError("no axis to sweep: give at least one leaf=values")
    names = [axis.leaf for axis in axes]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{', '.join(twice)} is given twice; one axis per leaf")
    if kind == "grid":
        for axis in axes:
            if not axis.values:
                raise ValueError(
                    f"axis {axis.leaf}: a grid needs a count, {axis.low:g}:{axis.high:g}:"
                    f"{'log' if axis.log else 'lin'}:N"
                )
        mesh = np.meshgrid(*(np.asarray(a.values) for a in axes), indexing="ij")
        shape = tuple(len(a.values) for a in axes)
        return Design(kind, tuple(axes), np.stack([m.ravel() for m in mesh], 1), shape)
    if samples < 1:
        raise ValueError(f"samples = {samples}: a {kind} design needs --samples N")
    # Points are made to be drawn from: a count written for a grid has no meaning here.
    open_axes = [a._replace(values=()) if a.low < a.high else a for a in axes]
    share = _shares(kind, len(axes), samples, seed)
    columns = [axis.at(share[:, i]) for i, axis in enumerate(open_axes)]
    return Design(kind, tuple(open_axes), np.stack(columns, 1), (samples,))


def _shares(kind: str, dim: int, n: int, seed: int) -> np.ndarray:
    """Points of the unit cube, `[n, dim]`."""
    if kind == "random":
        return np.random.default_rng(seed).random((n, dim))
    from scipy.stats import qmc

    # A Sobol sequence is balanced at powers of two only; the surplus is not used.
    power = max(0, int(np.ceil(np.log2(n))))
    points: Any = qmc.Sobol(dim, scramble=True, rng=seed).random_base2(power)
    return np.asarray(points)[:n]
