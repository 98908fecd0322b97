"""What describes one lattice: its configuration and its parameters."""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from fusion.lattice.checks import (
    refusal,
    require_count,
    require_range,
    require_signs,
    require_static,
)


class LatticeParams(NamedTuple):
    """`vertices` `[*sizes]`: the output at each vertex, axis d is input d."""

    vertices: Float[Array, "*sizes"]


@dataclasses.dataclass(frozen=True)
class LatticeConfig:
    """One lattice. Input d runs over `[0, sizes[d] - 1]`; inputs outside are clipped.

    Attributes:
        sizes: vertices along each input, at least 2.
        monotonicity: -1, 0 or +1 for each input; `None` is all free.
        unimodality: for each input 0 (free), +1 (valley: falls to the middle vertex
            `sizes[d] // 2`, rises after it) or -1 (peak); not beside monotonicity of that input.
        edgeworth_trust: triples `(main, conditional, direction)`: the slope in the main input
            grows (+1) or shrinks (-1) with the conditional input.
        output_range: `(low, high)`, either of which may be `None`.
        interpolation: "hypercube" (multilinear, over all corners of a cell) or "simplex" (over
            `rank + 1` corners).
        n_iterations: passes of Dykstra's algorithm where there is more than one family of
            constraints; what is left after them is repaired exactly. 10 is enough in training,
            where each step starts next to the feasible set.

    Raises:
        ValueError: sizes or constraints mean nothing or contradict each other.
        TypeError: a field is of a wrong type, such as a list for a tuple.

    Example:
        >>> LatticeConfig((2, 3), monotonicity=(1, 0)).rank
        2
    """

    sizes: tuple[int, ...]
    monotonicity: tuple[int, ...] | None = None
    unimodality: tuple[int, ...] | None = None
    edgeworth_trust: tuple[tuple[int, int, int], ...] = ()
    output_range: tuple[float | None, float | None] = (None, None)
    interpolation: Literal["hypercube", "simplex"] = "hypercube"
    n_iterations: int = 10

    def __post_init__(self) -> None:
        """Refuse sizes and constraints that mean nothing or contradict each other."""
        require_static(self)
        if not isinstance(self.sizes, tuple):
            raise TypeError(f"sizes={self.sizes!r}: expected a tuple; write ({self.sizes},)")
        if not self.sizes:
            raise refusal("sizes", self.sizes, "one size for each input", "write (2, 2) for two")
        for size in self.sizes:
            require_count("sizes", size, 2)
        require_signs("monotonicity", self.monotonicity, self.rank)
        require_signs("unimodality", self.unimodality, self.rank)
        for axis in range(self.rank):
            if self.signs[axis] and self.unimodality and self.unimodality[axis]:
                raise refusal(
                    "unimodality",
                    self.unimodality,
                    f"0 for input {axis}, which is both monotone and unimodal",
                    "set one of the two to 0",
                )
        self._check_trust()
        require_range("output_range", self.output_range)
        if self.interpolation not in ("hypercube", "simplex"):
            raise refusal(
                "interpolation",
                self.interpolation,
                "'hypercube' or 'simplex'",
                "choose one",
            )
        require_count("n_iterations", self.n_iterations)

    def _check_trust(self) -> None:
        directions: dict[frozenset[int], int] = {}
        for trust in self.edgeworth_trust:
            good = isinstance(trust, tuple) and len(trust) == 3
            if (
                not good
                or not all(0 <= axis < self.rank for axis in trust[:2])
                or trust[0] == trust[1]
                or trust[2] not in (-1, 1)
            ):
                raise refusal(
                    "edgeworth_trust",
                    trust,
                    "(main, conditional, direction) with two different inputs of "
                    f"0..{self.rank - 1} and direction -1 or 1",
                    "name inputs by their position",
                )
            if directions.setdefault(frozenset(trust[:2]), trust[2]) != trust[2]:
                raise refusal(
                    "edgeworth_trust",
                    self.edgeworth_trust,
                    f"one direction for inputs {trust[0]} and {trust[1]}, not opposite directions",
                    "keep one of the two",
                )

    @property
    def rank(self) -> int:
        """Number of inputs."""
        return len(self.sizes)

    @property
    def signs(self) -> np.ndarray:
        """`[rank]` of -1, 0, 1."""
        return np.asarray(self.monotonicity or (0,) * self.rank, np.int64)

    def centre(self, axis: int) -> int:
        """The vertex where a unimodal input has its extreme."""
        return self.sizes[axis] // 2
