"""The LDO regulator as a circuit for a search."""

from __future__ import annotations

from functools import lru_cache, partial

from failure.circuits.ldo.reference import ldo_reference
from failure.circuits.ldo.regulator import FINE, SPECS, solve_ldo
from failure.circuits.ldo.schematic import NETLIST, QUANTITIES
from failure.circuits.protocol import Circuit, varied_circuit
from failure.circuits.solver.netlist import Mosfet


@lru_cache(maxsize=4)
def make_ldo(model: str = "ekv") -> Circuit:
    """The LDO regulator: 60 parameters, quiescent current, undershoot and load regulation.

    Args:
        model: MOSFET model, "ekv" (smooth, default) or "level1".
    Returns:
        Circuit.

    Example:
        >>> make_ldo().spec_names
        ('quiescent_current', 'undershoot', 'load_regulation')
    """
    return varied_circuit(
        "ldo", model, [m.name for m in NETLIST.of(Mosfet)], QUANTITIES, SPECS,
        partial(solve_ldo, model=model),
        reference=partial(ldo_reference, model=model),
        again=partial(solve_ldo, model=model, time=FINE),
        short=partial(solve_ldo, model=model, dense=True),
    )  # fmt: skip
