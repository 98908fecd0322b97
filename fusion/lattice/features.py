"""What is known of the inputs of a calibrated model, each alone and against each other."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from fusion.lattice.checks import refusal, require_signs, require_static
from fusion.lattice.relations import BUILDERS


@dataclasses.dataclass(frozen=True)
class Feature:
    """What is known of one input.

    Attributes:
        name: of the input.
        monotonicity: -1 (the output falls with it), 0 (free) or +1 (rises); numbers only.
        convexity: of its calibrator, -1, 0 or +1; numbers only.
        keypoints: positions of the calibrator's keypoints; numbers only.
        n_categories: categories `0..n_categories - 1`; None for a number.
        order: pairs `(low, high)` of categories whose outputs are ordered.

    Raises:
        ValueError, TypeError: directions of categories, or orders of numbers.

    Example:
        >>> Feature("age", monotonicity=1).n_categories is None
        True
    """

    name: str
    monotonicity: int = 0
    convexity: int = 0
    keypoints: tuple[float, ...] = (0.0, 1.0)
    n_categories: int | None = None
    order: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        """Refuse directions of categories and orders of numbers."""
        require_static(self)
        require_signs("monotonicity", (self.monotonicity,), 1)
        require_signs("convexity", (self.convexity,), 1)
        if self.n_categories is None and self.order:
            raise refusal("order", self.order, "() for a number", "give n_categories")
        if self.n_categories is not None and (self.monotonicity or self.convexity):
            raise refusal(
                "monotonicity", self.monotonicity, "0 for categories", "give order, pairs of them"
            )

    @property
    def sign(self) -> int:
        """1 where the model must rise with the calibrated input."""
        return int(self.monotonicity != 0 or bool(self.order))


def related_positions(
    features: Sequence[Feature], relations: Sequence[tuple[Any, ...]]
) -> dict[str, tuple[tuple[Any, ...], ...]]:
    """Relations between features by name as options of a lattice between inputs by position.

    Calibrated inputs rise with what the model rises with: where it falls with a conditional
    feature, the direction of a trust in the calibrated input is the opposite one.

    Raises:
        ValueError: an unknown constraint or feature.

    Example:
        >>> pair = Feature("a", 1), Feature("b", -1)
        >>> related_positions(pair, [("edgeworth_trust", "a", "b", 1)])
        {'edgeworth_trust': ((0, 1, -1),)}
    """
    places = {feature.name: i for i, feature in enumerate(features)}
    found: dict[str, list[tuple[Any, ...]]] = {}
    for entry in relations:
        name, inputs, direction = _parts(entry)
        if unknown := [each for each in inputs if each not in places]:
            raise refusal(
                "relations", entry, f"features of {', '.join(places)}, not {unknown[0]!r}",
                "check the spelling",
            )  # fmt: skip
        axes = tuple(places[each] for each in inputs)
        if name.endswith("_trust") and len(axes) == 2 and features[axes[1]].monotonicity < 0:
            direction = tuple(-d for d in direction)
        made = (axes, *direction) if name == "joint_unimodality" else (*axes, *direction)
        found.setdefault(name, []).append(made)
    return {name: tuple(entries) for name, entries in found.items()}


def together(
    features: Sequence[Feature], relations: Sequence[tuple[Any, ...]]
) -> tuple[tuple[int, ...], ...]:
    """Inputs by position that each relation holds together, for `random_features`.

    Example:
        >>> together((Feature("a", 1), Feature("b"), Feature("c", 1)), [("dominance", "c", "a")])
        ((2, 0),)
    """
    places = {feature.name: i for i, feature in enumerate(features)}
    related_positions(features, relations)
    return tuple(tuple(places[each] for each in _parts(entry)[1]) for entry in relations)


def _parts(entry: tuple[Any, ...]) -> tuple[str, tuple[str, ...], tuple[int, ...]]:
    """Constraint, features, and the direction where there is one."""
    name, *rest = entry if isinstance(entry, tuple) and entry else (None,)
    if name not in BUILDERS:
        raise refusal("relations", entry, f"one of {', '.join(BUILDERS)} first", "name it")
    grouped = name == "joint_unimodality"
    directed = name not in ("dominance", "range_dominance")
    inputs = rest[0] if grouped and rest else tuple(rest[:2])
    direction = tuple(rest[1 if grouped else 2 :])
    if (
        not (isinstance(inputs, tuple) and len(inputs) >= 2 and len(direction) == directed)
        or not all(isinstance(each, str) for each in inputs)
        or not all(each in (-1, 1) for each in direction)
    ):
        form = "a tuple of features" if grouped else "two features"
        raise refusal(
            "relations", entry, f"{name!r}, {form}{', direction -1 or 1' if directed else ''}",
            "name features as in `features`",
        )  # fmt: skip
    return name, inputs, direction
