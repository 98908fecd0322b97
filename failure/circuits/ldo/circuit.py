"""The LDO regulator as a circuit for a search."""

from __future__ import annotations

from functools import lru_cache, partial

from jaxtyping import Array, Float

from failure.circuits.ldo.reference import ldo_reference
from failure.circuits.ldo.regulator import FINE, NETLIST, QUANTITIES, SPECS, TIME, solve_ldo
from failure.circuits.protocol import Circuit, in_chunks
from failure.circuits.solver.netlist import Mosfet
from failure.circuits.solver.transient import Grid


def _run(x: Float[Array, "n d"], *, model: str, time: Grid = TIME) -> tuple[Array, Array]:
    return in_chunks(partial(solve_ldo, model=model, time=time), x)


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
    mosfets = NETLIST.of(Mosfet)
    return Circuit(
        name="ldo" if model == "ekv" else f"ldo_{model}",
        parameter_names=tuple((m.name, q) for m in mosfets for q, _, _ in QUANTITIES),
        sigma=tuple(s for _ in mosfets for _, _, s in QUANTITIES),
        parameter_units=tuple(u for _ in mosfets for _, u, _ in QUANTITIES),
        specs=SPECS,
        run=partial(_run, model=model),
        again=partial(_run, model=model, time=FINE),
        reference=partial(ldo_reference, model=model),
    )
