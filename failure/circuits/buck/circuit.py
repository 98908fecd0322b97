"""The buck converter as circuits for a search: `dcdc` at heavy load, `dcdc_light` at light load."""

from __future__ import annotations

from functools import lru_cache, partial

from failure.circuits.buck import converter, light_load
from failure.circuits.buck.light_reference import light_reference
from failure.circuits.buck.reference import dcdc_reference
from failure.circuits.buck.schematic import MOSFETS, QUANTITIES
from failure.circuits.protocol import Circuit, varied_circuit

_NAMES = [m.name for m in MOSFETS]


@lru_cache(maxsize=4)
def make_dcdc(model: str = "ekv") -> Circuit:
    """The buck converter: 44 parameters, output accuracy and overshoot.

    Args:
        model: MOSFET model, "ekv" (smooth, default) or "level1".
    Returns:
        Circuit.

    Example:
        >>> make_dcdc().spec_names
        ('output_accuracy', 'overshoot')
    """
    return varied_circuit(
        "dcdc", model, _NAMES, QUANTITIES, converter.SPECS,
        partial(converter.solve_dcdc, model=model),
        reference=dcdc_reference,
        short=partial(converter.solve_dcdc, model=model, dense=True),
    )  # fmt: skip


@lru_cache(maxsize=4)
def make_dcdc_light(model: str = "ekv") -> Circuit:
    """The buck converter in pulse-frequency mode: 44 parameters, accuracy and ripple at 10 mA.

    Args:
        model: MOSFET model, "ekv" (smooth, default) or "level1".
    Returns:
        Circuit.

    Example:
        >>> make_dcdc_light().spec_names
        ('light_load_accuracy', 'light_load_ripple')
    """
    return varied_circuit(
        "dcdc_light", model, _NAMES, QUANTITIES, light_load.SPECS,
        partial(light_load.solve_dcdc_light, model=model),
        reference=light_reference,
    )  # fmt: skip
