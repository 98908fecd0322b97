"""What describes one lattice: its configuration and its parameters."""

from __future__ import annotations

import dataclasses
import functools
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
from fusion.lattice.interior import Interior, interior
from fusion.lattice.relations import BUILDERS, Relation


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
        trapezoid_trust: triples `(main, conditional, direction)`: the range of outputs over the
            monotone main input widens (+1) or narrows (-1) with the free conditional input.
        dominance: pairs `(dominant, weak)` of monotone inputs: the slope in the first is at least
            as steep, per vertex.
        range_dominance: such pairs: the range of outputs over the first is at least as wide.
        joint_monotonicity: triples `(first, second, direction)`: outputs rise (+1) or fall (-1)
            where both inputs grow by the same amount.
        joint_unimodality: pairs `((inputs), direction)`: outputs rise (+1, valley) or fall (-1,
            peak) along each ray from the middle vertex of these free inputs of 3 or more vertices.

    Dominance and the joint constraints bound slopes, and need interpolation "hypercube".

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
    trapezoid_trust: tuple[tuple[int, int, int], ...] = ()
    dominance: tuple[tuple[int, int], ...] = ()
    range_dominance: tuple[tuple[int, int], ...] = ()
    joint_monotonicity: tuple[tuple[int, int, int], ...] = ()
    joint_unimodality: tuple[tuple[tuple[int, ...], int], ...] = ()

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
        require_range("output_range", self.output_range)
        if self.interpolation not in ("hypercube", "simplex"):
            raise refusal(
                "interpolation",
                self.interpolation,
                "'hypercube' or 'simplex'",
                "choose one",
            )
        require_count("n_iterations", self.n_iterations)
        self._check_relations()

    def _check_relations(self) -> None:
        for name in BUILDERS:
            if not isinstance(getattr(self, name), tuple):
                raise refusal(
                    name, getattr(self, name), "a tuple of constraints", "write () for none"
                )
        directions: dict[tuple[str, frozenset], int] = {}
        for relation in self.relations:
            pair, direction = frozenset(relation.axes), relation.value[-1]
            symmetric = relation.name in ("edgeworth_trust", "joint_monotonicity")
            if symmetric and directions.setdefault((relation.name, pair), direction) != direction:
                raise refusal(
                    relation.name, getattr(self, relation.name),
                    f"one direction for inputs {relation.axes}, not opposite directions",
                    "keep one of the two",
                )  # fmt: skip
            if self.interpolation == "simplex" and relation.name in _OF_SLOPES:
                raise refusal(
                    "interpolation", self.interpolation, f"'hypercube' beside {relation.name}, "
                    "which bounds slopes of the multilinear function only", "write 'hypercube'",
                )  # fmt: skip
        if self.relations:
            _ = self.interior

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

    @property
    def steps(self) -> tuple[np.ndarray, ...]:
        """For each input and each step from a vertex to the next -1 (falls), 0 or 1 (rises)."""
        made = []
        for axis, (size, sign) in enumerate(zip(self.sizes, self.signs, strict=True)):
            turn = self.unimodality[axis] if self.unimodality else 0
            after = np.arange(size - 1) >= self.centre(axis)
            made.append(np.where(after, turn, -turn) if turn else np.full(size - 1, sign))
        return tuple(made)

    @property
    def relations(self) -> tuple[Relation, ...]:
        """The constraints between inputs, as rows of inequalities."""
        return _relations(self)

    @property
    def interior(self) -> Interior:
        """A lattice inside all constraints but the bounds, and what they force to be equal."""
        return _interior(self)


_OF_SLOPES = ("dominance", "joint_monotonicity", "joint_unimodality")


@functools.lru_cache(maxsize=128)
def _relations(config: LatticeConfig) -> tuple[Relation, ...]:
    return tuple(
        build(name, entry, config.sizes, config.signs)
        for name, build in BUILDERS.items()
        for entry in getattr(config, name)
    )


@functools.lru_cache(maxsize=128)
def _interior(config: LatticeConfig) -> Interior:
    relations = config.relations
    found = interior(config.sizes, config.steps, relations)
    if found is not None:
        return found
    # Name a constraint without which there is room, the last one given if there are several.
    culprit = relations[-1]
    for relation in reversed(relations):
        rest = [other for other in relations if other is not relation]
        if interior(config.sizes, config.steps, rest) is not None:
            culprit = relation
            break
    raise refusal(
        culprit.name, culprit.value, "a constraint that leaves room to the others; with them it "
        "leaves only lattices that are flat somewhere",
        "drop it, or one of those that it contradicts",
    )  # fmt: skip
