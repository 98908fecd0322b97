"""Where failures are looked for, and in which sense a specification is bad."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp

from failure.models.domains import Domain, ball, box

KINDS = ("box", "ball")
SENSES = ("max", "min")


@dataclass(frozen=True)
class Task:
    """The feasible set of the parameters, in sigma.

    Attributes:
        kind: "box", every parameter within `size`; "ball", `|x| <= size`.
        size: half width or radius [sigma].
        dim: number of parameters, D.

    Raises:
        ValueError: unknown kind, a size that is not positive, no dimension.

    Example:
        >>> Task("ball", 6.0, 60).dim
        60
    """

    kind: str
    size: float
    dim: int

    def __post_init__(self) -> None:
        """Refuse a set that is none."""
        if self.kind not in KINDS:
            raise ValueError(f"kind={self.kind!r}: expected 'box' or 'ball'")
        if not (self.size > 0 and math.isfinite(self.size)):
            raise ValueError(f"size={self.size}: expected a positive number of sigma")
        if self.dim < 1:
            raise ValueError(f"dim={self.dim}: expected at least 1 parameter")


def sign_of(sense: str) -> float:
    """Factor that makes larger worse: 1 for sense "max", -1 for "min".

    Raises:
        ValueError: another sense.

    Example:
        >>> sign_of("min")
        -1.0
    """
    if sense not in SENSES:
        raise ValueError(
            f"sense={sense!r}: expected 'max' (larger is worse) or 'min' (smaller is worse)"
        )
    return 1.0 if sense == "max" else -1.0


def task_domain(task: Task) -> Domain:
    """The feasible set of x as the domain of an optimiser."""
    if task.kind == "ball":
        return ball(task.dim, task.size)
    limit = jnp.full((task.dim,), float(task.size))
    return box(-limit, limit)


def unit_scale(task: Task) -> float:
    r"""Parameters per unit coordinate: :math:`x = c\,u` with variance 1/12 of `u`.

    A coordinate of a uniform point has variance :math:`b^2/3` in a box of half width b and
    :math:`r^2/(D+2)` in a ball of radius r.

    Example:
        >>> unit_scale(Task("box", 3.0, 60)), round(unit_scale(Task("ball", 6.0, 60)), 3)
        (6.0, 2.64)
    """
    if task.kind == "box":
        return 2.0 * task.size
    return task.size * math.sqrt(12.0 / (task.dim + 2))
