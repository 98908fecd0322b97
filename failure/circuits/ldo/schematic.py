"""The regulator as drawn: 20 transistors, what varies in them, the load step."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from failure.circuits.solver.mosfet import NMOS, PMOS, mos_params
from failure.circuits.solver.netlist import (
    Capacitor,
    CurrentSource,
    Load,
    Mosfet,
    Netlist,
    Resistor,
    VoltageSource,
)
from failure.circuits.solver.system import System
from failure.circuits.solver.values import Values, nominal_values

KNEE = 1.0
"""Voltage scale of the load [V]: it draws `amps * tanh(v / KNEE)`, less as the output falls."""

I_LIGHT = 1e-3 / math.tanh(1.0 / KNEE)

I_HEAVY = 150e-3 / math.tanh(1.0 / KNEE)
"""Load before and after the step [A]: 1 mA and 150 mA at 1 V."""

T_STEP, T_RISE, T_END = 10e-9, 1e-9, 120e-9
"""Start and length of the load step, end of the transient [s]."""

QUANTITIES = (("length", "relative", 0.01), ("vth", "V", 5e-3), ("tox", "relative", 0.007))
"""Varied quantities of each transistor: name, unit of sigma, sigma."""


def _n(name: str, d: str, g: str, s: str, width: int | float, length: float) -> Mosfet:
    return Mosfet(name, d, g, s, "0", NMOS, width * 1e-6, length * 1e-6)


def _p(name: str, d: str, g: str, s: str, width: int | float, length: float) -> Mosfet:
    return Mosfet(name, d, g, s, "vin", PMOS, width * 1e-6, length * 1e-6)


NETLIST = Netlist(
    "LDO",
    (
        VoltageSource("Vin", "vin", "0", 2.2),
        VoltageSource("Vref", "ref", "0", 1.0),
        CurrentSource("Iref", "vin", "nb", 150e-6),
        # Bias: reference diode, tail, p-side mirror, source of the buffer, keepers of the output.
        _n("MB1", "nb", "nb", "0", 27, 0.5),
        _n("MB2", "tail", "nb", "0", 280, 0.5),
        _n("MB3", "pb", "nb", "0", 27, 0.5),
        _p("MB4", "pb", "pb", "vin", 80, 0.5),
        _p("MB5", "gp", "pb", "vin", 820, 0.5),
        _n("MB6", "out", "x", "0", 40, 0.5),
        _n("MB7", "out", "nb", "0", 54, 0.5),
        # Error amplifier: current-mirror OTA, output loaded by two diodes.
        _n("M1", "d1", "out", "tail", 60, 0.35),
        _n("M2", "d2", "ref", "tail", 60, 0.35),
        _p("M3", "d1", "d1", "vin", 200, 0.35),
        _p("M4", "d2", "d2", "vin", 200, 0.35),
        _p("M5", "ga", "d1", "vin", 400, 0.35),
        _p("M6", "d7", "d2", "vin", 400, 0.35),
        _n("M7", "d7", "d7", "0", 200, 0.35),
        _n("M8", "ga", "d7", "0", 200, 0.35),
        _p("M9", "ga", "ga", "vin", 20, 0.35),
        _n("M10", "ga", "ga", "0", 4, 0.35),
        # Follower buffer, its current sensed by M13 and turned into a pull-down at the output.
        _p("M11", "x", "ga", "gp", 1500, 0.35),
        _n("M13", "x", "x", "0", 200, 0.5),
        _p("MP", "out", "gp", "vin", 6000, 0.35),
        Capacitor("Cout", "out", "oesr", 0.4e-9),
        Resistor("Resr", "oesr", "0", 0.1),
        Load("Bload", "out", "0", I_LIGHT, KNEE),
    ),
)


def variation(
    system: System, x: Float[Array, "d b"], sigmas: tuple[float, float, float] | None = None
) -> Values:
    """Element values of samples given in sigma, transistor-major `(length, vth, tox)`."""
    sigma_l, sigma_v, sigma_t = sigmas or tuple(s for _, _, s in QUANTITIES)
    mosfets = system.netlist.of(Mosfet)
    u = x.reshape(len(mosfets), 3, x.shape[-1])

    def column(values: list[float]) -> Array:
        return jnp.array(values, x.dtype).reshape(-1, 1)

    mos = mos_params(
        column([m.process.polarity for m in mosfets]),
        column([m.process.mobility for m in mosfets]),
        column([m.process.early for m in mosfets]),
        column([m.process.overlap for m in mosfets]),
        width=column([m.width for m in mosfets]),
        length=column([m.length for m in mosfets]) * (1.0 + sigma_l * u[:, 0]),
        vto=column([m.process.vto for m in mosfets]) + sigma_v * u[:, 1],
        tox=column([m.process.tox for m in mosfets]) * (1.0 + sigma_t * u[:, 2]),
    )
    return nominal_values(system)._replace(mos=mos)
