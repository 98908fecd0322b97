"""The buck converter as drawn: constants, transistors, the two blocks that are simulated."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from failure.circuits.solver.mosfet import NMOS, PMOS, mos_params
from failure.circuits.solver.netlist import CurrentSource, Mosfet, Netlist, VoltageSource
from failure.circuits.solver.system import System
from failure.circuits.solver.values import Values, nominal_values

V_DD, V_REF, V_BIAS = 2.5, 1.2, 0.72
INDUCTANCE, R_COIL, CAPACITANCE, R_ESR = 1e-6, 0.03, 10e-6, 0.03
R_COMP, R_ZERO, C_ZERO = 5e3, 20e3, 1e-12
LOAD_HEAVY, LOAD_LIGHT = 0.2, 0.1
"""Load before and after the step [A]."""

PERIOD = 250e-9
RAMP_LOW, RAMP_HIGH, RAMP_RISE, RAMP_TOP, RAMP_FALL = 0.8, 1.6, 235e-9, 7.5e-9, 7.5e-9
"""The ramp [V] and the lengths of its rise, its top and its fall [s]."""

N_BEFORE, N_AFTER = 100, 60
"""Periods before and after the load step."""

QUANTITIES = (("length", "relative", 0.01), ("width", "relative", 0.01))

RAMP_SLOPE = (RAMP_HIGH - RAMP_LOW) / RAMP_RISE
"""Rise of the ramp [V/s]."""


def _n(name: str, d: str, g: str, s: str, width: int | float, length: float = 0.35) -> Mosfet:
    return Mosfet(name, d, g, s, "0", NMOS, width * 1e-6, length * 1e-6)


def _p(name: str, d: str, g: str, s: str, width: int | float, length: float = 0.35) -> Mosfet:
    return Mosfet(name, d, g, s, "vdd", PMOS, width * 1e-6, length * 1e-6)


AMPLIFIER_MOSFETS = (
    _n("MA1", "ea1", "fb", "et", 20, 0.5),
    _n("MA2", "comp", "ref", "et", 20, 0.5),
    _p("MA3", "ea1", "ea1", "vdd", 20, 0.5),
    _p("MA4", "comp", "ea1", "vdd", 20, 0.5),
    _n("MA5", "et", "nb", "0", 20, 0.5),
)
POWER_MOSFETS = (
    _n("MC1", "c1", "comp", "ct", 20),
    _n("MC2", "c2", "ramp", "ct", 20),
    _p("MC3", "c1", "c1", "vdd", 16),
    _p("MC4", "c2", "c1", "vdd", 16),
    _n("MC5", "ct", "nb", "0", 60, 0.5),
    _p("MC6", "c3", "c2", "vdd", 40),
    _n("MC7", "c3", "nb", "0", 40, 0.5),
    _p("MC8", "pw", "c3", "vdd", 24),
    _n("MC9", "pw", "c3", "0", 10),
    _p("MD1", "gp", "dx", "vdd", 400),
    _n("MD2", "gp", "dx", "0", 160),
    _p("MD3", "gn", "dx", "vdd", 160),
    _n("MD4", "gn", "dx", "0", 160),
    _p("MD5", "dx", "pw", "vdd", 80),
    _n("MD6", "dx", "pw", "0", 32),
    _p("MSP", "sw", "gp", "vdd", 20000),
    _n("MSN", "sw", "gn", "0", 10000),
)
MOSFETS = (*AMPLIFIER_MOSFETS, *POWER_MOSFETS)

_SUPPLIES = (VoltageSource("Vdd", "vdd", "0", V_DD), VoltageSource("Vnb", "nb", "0", V_BIAS))

V_COMP = 1.24
"""Compensator voltage about which the blocks are measured [V]."""

AMPLIFIER = Netlist(
    "error amplifier",
    (
        *_SUPPLIES,
        VoltageSource("Vref", "ref", "0", V_REF),
        VoltageSource("Vfb", "fb", "0", V_REF),
        VoltageSource("Vcomp", "comp", "0", V_COMP),
        *AMPLIFIER_MOSFETS,
    ),
)
POWER = Netlist(
    "comparator, drivers, switches",
    (
        *_SUPPLIES,
        VoltageSource("Vcomp", "comp", "0", V_COMP),
        VoltageSource("Vramp", "ramp", "0", V_COMP - 0.05),
        CurrentSource("IL", "sw", "0", 0.12),
        *POWER_MOSFETS,
    ),
)


def variation(system: System, mosfets: tuple[Mosfet, ...], u: Float[Array, "k 2 b"]) -> Values:
    """Element values of a block; `u` in sigma: length, width of each transistor."""

    def column(values: list[float]) -> Array:
        return jnp.array(values, u.dtype).reshape(-1, 1)

    ones = jnp.ones_like(u[:, 0])
    mos = mos_params(
        column([m.process.polarity for m in mosfets]) * ones,
        column([m.process.mobility for m in mosfets]),
        column([m.process.early for m in mosfets]),
        column([m.process.overlap for m in mosfets]),
        width=column([m.width for m in mosfets]) * (1.0 + QUANTITIES[1][2] * u[:, 1]),
        length=column([m.length for m in mosfets]) * (1.0 + QUANTITIES[0][2] * u[:, 0]),
        vto=column([m.process.vto for m in mosfets]) * ones,
        tox=column([m.process.tox for m in mosfets]),
    )
    return nominal_values(system)._replace(mos=mos)
