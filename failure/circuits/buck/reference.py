"""The buck converter by ngspice: all 22 transistors switching for 160 periods."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from failure.circuits.buck import schematic
from failure.circuits.solver import ngspice
from failure.circuits.solver.decks import sample_decks
from failure.circuits.solver.netlist import (
    Capacitor,
    CurrentSource,
    Mosfet,
    Netlist,
    Resistor,
    VoltageSource,
)
from failure.circuits.solver.system import compile_netlist
from failure.circuits.solver.values import Values

SUPPLIES = (
    VoltageSource("Vdd", "vdd", "0", schematic.V_DD),
    VoltageSource("Vnb", "nb", "0", schematic.V_BIAS),
    VoltageSource("Vref", "ref", "0", schematic.V_REF),
)
OUTPUT_FILTER = (
    Resistor("Rcoil", "lx", "out", schematic.R_COIL),
    Capacitor("Cout", "out", "oe", schematic.CAPACITANCE),
    Resistor("Resr", "oe", "0", schematic.R_ESR),
)

FULL = Netlist(
    "buck converter",
    (
        *SUPPLIES,
        *schematic.MOSFETS,
        *OUTPUT_FILTER,
        # The probe of the feedback pin: its 0.1 ns is left out of the cycle map.
        Resistor("Rfb", "out", "fb", 1e3),
        Capacitor("Cfb", "fb", "0", 1e-13),
        Resistor("Rcomp", "comp", "ref", schematic.R_COMP),
        Capacitor("Czero", "comp", "cz", schematic.C_ZERO),
        Resistor("Rzero", "cz", "fb", schematic.R_ZERO),
        CurrentSource("Iload", "out", "0", schematic.LOAD_HEAVY),
    ),
)
"""The converter without its coil and ramp, which the deck adds with their own syntax."""

_T_STEP = schematic.N_BEFORE * schematic.PERIOD
_T_END = (schematic.N_BEFORE + schematic.N_AFTER) * schematic.PERIOD


def values_of(netlist: Netlist, x: np.ndarray) -> tuple[Values, np.ndarray]:
    """Values of a netlist's elements at samples of all 22 transistors, and its transistors' sizes.

    Args:
        netlist: with some of `schematic.MOSFETS`, by name.
        x: `[n, 44]` in sigma.
    Returns:
        (Values, `[2, m, n]`: width and length of each transistor over what is drawn).
    """
    u = np.asarray(x, np.float64).reshape(len(x), -1, 2).transpose(1, 2, 0)
    names, mosfets = [m.name for m in schematic.MOSFETS], netlist.of(Mosfet)
    u = u[[names.index(m.name) for m in mosfets]]
    with jax.enable_x64(True):
        values = schematic.variation(
            compile_netlist(netlist, "level1"), tuple(mosfets), jnp.asarray(u)
        )
    (_, _, s_length), (_, _, s_width) = schematic.QUANTITIES
    stretch = np.stack([1.0 + s_width * u[:, 1], 1.0 + s_length * u[:, 0]])
    return jax.tree.map(np.asarray, values), stretch


def dcdc_decks(
    x: np.ndarray,
    *,
    model: str = "level1",
    max_step: float = 1e-9,
    reltol: float = 1e-4,
    loads: tuple[float, float] = (schematic.LOAD_HEAVY, schematic.LOAD_LIGHT),
) -> list[str]:
    """ngspice input files of samples `x [n, 44]` in sigma.

    Args:
        x: samples.
        model: "level1" (ngspice's own) or "ekv" (behavioural sources).
        max_step: largest time step [s].
        reltol: relative tolerance of ngspice.
        loads: before and after the step [A].
    Returns:
        One text per sample; each prints `vmean` and `vpeak`.
    """
    values, stretch = values_of(FULL, x)
    before, after = loads
    load = ((0.0, before), (_T_STEP, before), (_T_STEP + 1e-9, after), (1.0, after))
    own = [
        f"Vramp ramp 0 PULSE({schematic.RAMP_LOW!r} {schematic.RAMP_HIGH!r} 0 "
        f"{schematic.RAMP_RISE!r} {schematic.RAMP_FALL!r} {schematic.RAMP_TOP!r} "
        f"{schematic.PERIOD!r})",
        f"L1 sw lx {schematic.INDUCTANCE!r} ic={before!r}",
    ]
    control = [
        f"tran {max_step!r} {_T_END!r} 0 {max_step!r} uic",
        f"meas tran vmean avg v(out) from={_T_STEP - 8 * schematic.PERIOD!r} to={_T_STEP!r}",
        f"meas tran vpeak max v(out) from={_T_STEP!r} to={_T_END!r}",
        "print vmean",
        "print vpeak",
    ]
    return sample_decks(
        "BUCK", FULL, values, control,
        stretch=stretch,
        model=model,
        waves={"Iload": load},
        own=own,
        options=f"reltol={reltol!r}",
        extra=".ic v(out)=1.2 v(comp)=1.2 v(lx)=1.2 v(fb)=1.2 v(oe)=0 v(cz)=1.2",
    )  # fmt: skip


def dcdc_reference(
    x: np.ndarray,
    *,
    model: str = "level1",
    workers: int = 2,
    timeout: float = 300.0,
    max_step: float = 1e-9,
    loads: tuple[float, float] = (schematic.LOAD_HEAVY, schematic.LOAD_LIGHT),
) -> tuple[np.ndarray, np.ndarray]:
    """Specifications of samples by ngspice, every transistor in every period.

    Args:
        x: `[n, 44]` in sigma.
        model: "level1" or "ekv".
        workers: processes at a time.
        timeout: limit of each [s].
        max_step: largest time step [s].
        loads: before and after the step [A].
    Returns:
        (specs `[n, 2]` as `converter.SPECS`, status `[n]`).
    Raises:
        NgspiceError: not installed.
    """
    decks = dcdc_decks(x, model=model, max_step=max_step, loads=loads)
    numbers, status = ngspice.run_many(decks, ("vmean", "vpeak"), workers=workers, timeout=timeout)
    mean, peak = numbers.T
    return np.stack([np.abs(mean - schematic.V_REF), peak - schematic.V_REF], axis=1), status
