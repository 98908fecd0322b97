"""Designs: which settings a sweep visits. A grid, random draws or a Sobol sequence.

Axes that list every value (`Axis.every`) are crossed with whatever the others are; in a design of
samples the others are drawn, in a grid all are crossed.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from snn_fusion_failure.sweeps.axes import Axis

ADAPTIVE = ("tpe", "cma", "gp")
KINDS = ("grid", "random", "sobol", *ADAPTIVE)


class Design(NamedTuple):
    """Settings in rows, axes in columns.

    Attributes:
        kind: one of `KINDS`.
        axes: what was asked for.
        rows: values of the axes, in the axes' units; those of an adaptive design come later.
        samples: of a design that is not a grid.
        seed: of the random or scrambled points, or of the sampler.
    """

    kind: str
    axes: tuple[Axis, ...]
    rows: tuple[tuple[Any, ...], ...]
    samples: int = 0
    seed: int = 0

    @property
    def n(self) -> int:
        """Number of settings."""
        return len(self.rows)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the grid; `(settings,)` for the other designs."""
        if self.kind == "grid":
            return tuple(len(axis.values) for axis in self.axes)
        return (self.n,)

    def describe(self) -> dict[str, Any]:
        """JSON values that make it again."""
        return {
            "kind": self.kind, "axes": [axis._asdict() for axis in self.axes],
            "samples": self.samples, "seed": self.seed,
        }  # fmt: skip


def digest(leaves: Sequence[str], row: Sequence[Any]) -> tuple[int, int]:
    """Two 32-bit words that a setting's values determine, wherever it stands in a design.

    Keys of random numbers are folded from them, so that a grid can grow in any direction and every
    setting keeps its numbers.

    Example:
        >>> digest(["a", "b"], [1.0, 2.0]) == digest(["b", "a"], [2.0, 1.0])
        True
    """
    pairs = {leaf: value if isinstance(value, str | bool) else repr(float(value))
             for leaf, value in zip(leaves, row, strict=True)}  # fmt: skip
    data = hashlib.sha256(json.dumps(pairs, sort_keys=True).encode()).digest()
    return int.from_bytes(data[:4], "little"), int.from_bytes(data[4:8], "little")


def design(kind: str, axes: Sequence[Axis], *, samples: int = 0, seed: int = 0) -> Design:
    """All settings of a sweep.

    Args:
        kind: "grid" (the product of all axes), "random", "sobol" (scrambled), or an adaptive one,
            whose settings follow from results.
        axes: at least one, each leaf once.
        samples: settings of a design that is not a grid; the first n of a longer one are the same.
        seed: of the random or scrambled points, or of the sampler.

    Raises:
        ValueError: no axis, a leaf twice, a range in a grid, no samples.

    Example:
        >>> axes = [Axis("a", values=(1.0, 2.0)), Axis("b", values=(3.0, 4.0, 5.0))]
        >>> design("grid", axes).rows[:2]
        ((1.0, 3.0), (1.0, 4.0))
    """
    if kind not in KINDS:
        raise ValueError(f"design={kind!r}: expected one of {', '.join(KINDS)}")
    if not axes:
        raise ValueError("no axis to sweep: give at least one leaf=values")
    names = [axis.leaf for axis in axes]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{', '.join(twice)} is given twice; one axis per leaf")
    if kind == "grid":
        if samples:
            raise ValueError(
                f"samples={samples}: expected none in a grid, which visits every value; give "
                "ranges (low:high) to a random, Sobol or adaptive design"
            )
        listed = []
        for axis in axes:
            if axis.ranges and axis.kind == "int":
                axis = axis._replace(values=tuple(range(int(axis.low), int(axis.high) + 1)))
            if axis.ranges:
                raise ValueError(
                    f"axis {axis.leaf}: a grid needs a count, {axis.low:g}:{axis.high:g}:"
                    f"{'log' if axis.log else 'lin'}:N, or give samples"
                )
            listed.append(axis)
        rows = tuple(itertools.product(*(axis.values for axis in listed)))
        return Design(kind, tuple(listed), rows)
    if samples < 1:
        raise ValueError(f"samples={samples}: a {kind} design needs --samples N")
    # Points are made to be drawn from: a count written for a grid has no meaning here.
    open_axes = [
        a._replace(values=()) if a.low < a.high and not a.every else a for a in axes
    ]  # fmt: skip
    drawn = [axis for axis in open_axes if not axis.every]
    if not drawn:
        raise ValueError(
            f"samples={samples}: every axis lists all its values; leave samples out, or give a "
            "range"
        )
    if kind in ADAPTIVE:
        if len(drawn) < len(open_axes):
            raise ValueError(f"a {kind} design draws all axes; use choice() or a range for grid()")
        return Design(kind, tuple(open_axes), (), samples, seed)
    points = shares(kind, len(drawn), samples, seed)
    columns = {axis.leaf: axis.at(points[:, i]) for i, axis in enumerate(drawn)}
    listed_rows = itertools.product(*(axis.values for axis in open_axes if axis.every))
    crossed = [dict(zip([a.leaf for a in open_axes if a.every], row, strict=True))
               for row in listed_rows]  # fmt: skip
    rows = tuple(
        tuple(each[a.leaf] if a.every else columns[a.leaf][i] for a in open_axes)
        for i in range(samples)
        for each in crossed
    )
    # Few labels and many samples draw the same setting again: it is one setting.
    return Design(kind, tuple(open_axes), tuple(dict.fromkeys(rows)), samples, seed)


def shares(kind: str, dim: int, n: int, seed: int) -> np.ndarray:
    """Points of the unit cube, `[n, dim]`; the first of a longer list are the same."""
    if kind == "random":
        return np.random.default_rng(seed).random((n, dim))
    from scipy.stats import qmc

    # A Sobol sequence is balanced at powers of two only; the surplus is not used.
    power = max(0, int(np.ceil(np.log2(n))))
    points: Any = qmc.Sobol(dim, scramble=True, rng=seed).random_base2(power)
    return np.asarray(points)[:n]
