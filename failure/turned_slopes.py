"""Differences taken again where the slope has turned, along the parameters that matter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from failure.descents import Descent, cosine_of

SHARE = 0.97
"""Differences are taken again along the parameters that hold this share of the squared slope.

Chosen among 0.9 to 0.99 on the regulator's undershoot and load regulation, seeds from 1000 on.
"""


class Slope(NamedTuple):
    """Where the steps ended and what the output does there.

    Attributes:
        point: `[D]`, near the threshold.
        value: output there.
        gradient: `[D]`.
        fresh: `[D]`, entries whose difference was taken here, not at nominal.
        turn: cosine of these entries with those at nominal; 1 where none was taken again.
    """

    point: Float[np.ndarray, " D"]
    value: float
    gradient: Float[np.ndarray, " D"]
    fresh: Bool[np.ndarray, " D"]
    turn: float


def again_where_it_matters(
    descent: Descent,
    nominal: Float[np.ndarray, " D"],
    u: Float[np.ndarray, " D"],
    y: float,
    g: Float[np.ndarray, " D"],
    *,
    share: float,
) -> Slope:
    r"""Differences at `u` along the parameters that hold `share` of the squared slope at nominal.

    All others keep their direction :math:`r` from nominal, and one simulation along it says how
    much of it there is now.

    .. math:: g = \sum_{j \in S} \frac{y(u + h e_j) - y(u)}{h}\, e_j
        + \frac{y(u + h r) - y(u)}{h}\, r
    """
    order = np.argsort(-np.abs(nominal))
    held = np.cumsum(nominal[order] ** 2) / float(nominal @ nominal)
    top = order[: int(np.searchsorted(held, share)) + 1]
    rest = np.array(nominal)
    rest[top] = 0.0
    moves = np.eye(len(u))[top]
    if np.any(rest):
        moves = np.concatenate([moves, rest[None] / np.linalg.norm(rest)])
    slopes = np.nan_to_num((descent.counted(u + descent.step * moves) - y) / descent.step)
    fresh = np.zeros(len(u), bool)
    fresh[top] = True
    turn = cosine_of(slopes[: len(top)], nominal[top])
    new = slopes @ moves
    return Slope(u, y, new if np.any(new) else g, fresh, turn)
