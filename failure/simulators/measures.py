"""Specifications of measured values: limits on one or both sides, and their violation."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from failure.simulators.spice import parse_number

_NAME = r"[A-Za-z_][\w.:()\[\]#@]*"
_ONE = re.compile(rf"({_NAME})(<=|>=|<|>)(\S+)")
_TWO = re.compile(rf"(\S+?)<=?({_NAME})<=?(\S+)")


class Limit(NamedTuple):
    """A measured value and the range in which it passes; infinite where it has no limit."""

    name: str
    low: float
    high: float

    @property
    def text(self) -> str:
        """As it is written in a command."""
        if math.isinf(self.low):
            return f"{self.name}<={self.high:g}"
        if math.isinf(self.high):
            return f"{self.name}>={self.low:g}"
        return f"{self.low:g}<={self.name}<={self.high:g}"


def parse_limit(text: str) -> Limit:
    """`tset<=20u`, `gain>=60` or `0.4<=vout<=0.6`.

    Raises:
        ValueError: another form, or an empty range.

    Example:
        >>> parse_limit("tset<=20u")
        Limit(name='tset', low=-inf, high=2e-05)
    """
    plain = re.sub(r"\s+", "", text)
    one, two = _ONE.fullmatch(plain), _TWO.fullmatch(plain)
    try:
        if two:
            found = Limit(two[2].lower(), parse_number(two[1]), parse_number(two[3]))
        elif one and one[2].startswith("<"):
            found = Limit(one[1].lower(), -math.inf, parse_number(one[3]))
        elif one:
            found = Limit(one[1].lower(), parse_number(one[3]), math.inf)
        else:
            raise ValueError("no limit")
    except ValueError as error:
        raise ValueError(
            f"measure={text!r}: expected NAME<=NUMBER, NAME>=NUMBER or LOW<=NAME<=HIGH"
        ) from error
    if not found.low < found.high:
        raise ValueError(f"measure={text!r}: expected a range; its low limit is not below the high")
    return found


def one_sided(limit: Limit) -> list[Limit]:
    """A window as its two sides, which fail in regions of their own.

    Example:
        >>> [side.text for side in one_sided(parse_limit("-5<=offset<=5"))]
        ['offset>=-5', 'offset<=5']
    """
    if math.isinf(limit.low) or math.isinf(limit.high):
        return [limit]
    return [limit._replace(high=math.inf), limit._replace(low=-math.inf)]


def violation(
    limits: Sequence[Limit],
    nominal: Float[np.ndarray, "... m"],
    values: Float[np.ndarray, "... m"],
) -> Float[np.ndarray, "... m"]:
    r"""How far a value is beyond its limit, in units of the nominal distance to it.

    .. math:: g = \max\left(\frac{v - h}{h - v_0}, \frac{l - v}{v_0 - l}\right)

    so g is -1 for the nominal value (of a one-sided limit), 0 on the limit and above 0 where the
    specification fails, whatever the unit.

    Args:
        limits: of every measure; :math:`[l, h]`.
        nominal: values :math:`v_0` of the nominal circuit, inside their limits.
        values: v; NaN gives NaN.
    Raises:
        ValueError: the nominal circuit does not pass.

    Example:
        >>> violation([parse_limit("gain>=60")], np.array([80.0]), np.array([[70.0], [55.0]]))
        array([[-0.5 ],
               [ 0.25]])
    """
    columns = []
    for k, limit in enumerate(limits):
        v0, v = nominal[..., k], values[..., k]
        passes = (limit.low < v0) & (v0 < limit.high)
        if not np.all(passes):
            v0 = v0[~passes].flat[0] if np.ndim(v0) else v0
            raise ValueError(
                f"measure={limit.text!r}: expected a nominal circuit that passes; it has "
                f"{limit.name} = {v0:g}; widen the limit or mend the circuit"
            )
        sides = []
        if math.isfinite(limit.high):
            sides.append((v - limit.high) / (limit.high - v0))
        if math.isfinite(limit.low):
            sides.append((limit.low - v) / (v0 - limit.low))
        columns.append(np.maximum.reduce(sides))
    return np.stack(columns, axis=-1)
