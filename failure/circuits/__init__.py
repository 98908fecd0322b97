"""Circuits that are really simulated: a batched solver in JAX, two circuits, ngspice beside it."""

from __future__ import annotations

from collections.abc import Callable

from failure.circuits.buck.circuit import make_dcdc, make_dcdc_light
from failure.circuits.ldo.circuit import make_ldo
from failure.circuits.protocol import Circuit, Spec

__all__ = ["CIRCUITS", "Circuit", "Spec", "get", "make_dcdc", "make_dcdc_light", "make_ldo"]

CIRCUITS: dict[str, Callable[[], Circuit]] = {
    "dcdc": make_dcdc,
    "dcdc_light": make_dcdc_light,
    "ldo": make_ldo,
}
"""Name -> function that makes the circuit."""


def get(name: str) -> Circuit:
    """A circuit by name.

    Args:
        name: a key of `CIRCUITS`.

    Returns:
        Circuit; the same object at every call.

    Raises:
        ValueError: unknown name.

    Example:
        >>> get("ldo").n_dims, get("ldo").spec_names[0]
        (60, 'quiescent_current')
    """
    if name not in CIRCUITS:
        raise ValueError(f"circuit={name!r}: expected one of {', '.join(map(repr, CIRCUITS))}")
    return CIRCUITS[name]()
