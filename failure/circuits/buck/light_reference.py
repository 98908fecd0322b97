"""The buck converter at light load by ngspice: comparator, drivers and switches of transistors.

The controller is ideal, as it is in the cycle map, and is written as behavioural sources: two
latches (high side, low side), a timer, a detector of zero current with a blanking time. What the
map leaves out is here: the comparator follows an output that falls by a millivolt in a microsecond,
body diodes are those of the transistors, and edges take their time. A switch that is closed while
both sides are open damps the ringing of the coil.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from failure.circuits.buck import light_load, schematic
from failure.circuits.buck.reference import OUTPUT_FILTER, SUPPLIES, values_of
from failure.circuits.solver import ngspice
from failure.circuits.solver.decks import sample_decks
from failure.circuits.solver.netlist import CurrentSource, Mosfet, Netlist

_DRIVES = {"MD1": "dh", "MD2": "dh", "MD3": "dl", "MD4": "dl"}
"""Drivers whose input is the controller's, one for each side."""

BLANKING = 20e-9
"""The zero-current detector does not look at an edge [s]."""

_LATCH = 50e-12
"""Time constant of the ideal controller's latches [s]."""


def _rewired(m: Mosfet) -> Mosfet:
    gate = _DRIVES.get(m.name, {"comp": "out", "ramp": "ref"}.get(m.gate, m.gate))
    return Mosfet(m.name, m.drain, gate, m.source, m.bulk, m.process, m.width, m.length)


FULL = Netlist(
    "buck converter, pulse-frequency mode",
    (
        *SUPPLIES,
        *(_rewired(m) for m in schematic.POWER_MOSFETS),
        *OUTPUT_FILTER,
        CurrentSource("Iload", "out", "0", light_load.LOAD),
    ),
)
"""The converter without its coil and controller, which the deck adds with their own syntax."""


def _controller() -> list[str]:
    """Latches `qh`, `ql`, timers `tm`, `tb` that reach 1, and what they drive."""
    half = 0.5 * schematic.V_DD
    trip = f"(v(ql)<0.5 && v(dx)>{half!r}) ? 1 : 0"
    empty = f"(v(qh)<0.5 && v(tb)>1 && v(sw)>{-light_load.V_ZERO!r}) ? 0 : 1"
    g = 1e-12 / _LATCH
    return [
        # The high side is held until the low side's latch has taken over.
        f"Bqh 0 qh I={g!r}*((v(qh)>0.5 ? (v(ql)>0.5 ? 0 : 1) : ({trip})) - v(qh))",
        f"Bql 0 ql I={g!r}*((v(ql)>0.5 ? ({empty}) : (v(tm)>1 ? 1 : 0)) - v(ql))",
        f"Btm 0 tm I=v(qh)>0.5 ? {1e-12 / light_load.T_ON!r} : {-g!r}*v(tm)",
        f"Btb 0 tb I=v(ql)>0.5 ? {1e-12 / BLANKING!r} : {-g!r}*v(tb)",
        *(f"C{node} {node} 0 1e-12" for node in ("qh", "ql", "tm", "tb")),
        f"Bdh dh 0 V={schematic.V_DD!r}*v(qh)",
        f"Bdl dl 0 V={schematic.V_DD!r}*(1-v(ql))",
        "Bdamp sw out I=(v(sw)-v(out))*max(0,1-v(qh)-v(ql))/50",
        f"L1 sw lx {schematic.INDUCTANCE!r} ic=0",
    ]


def _trip_offsets(x: np.ndarray) -> np.ndarray:
    """By how much each sample's output lies below the reference at the trip [V]."""
    u = np.asarray(x, np.float64).reshape(len(x), -1, 2).transpose(1, 2, 0)
    chosen = [schematic.MOSFETS.index(m) for m in light_load.LOOP_MOSFETS]
    with jax.enable_x64(True):
        offset, _ = jax.jit(lambda u: light_load.trip_offset(u, model="level1"))(
            jnp.asarray(u[chosen])
        )
        return np.asarray(offset)


def light_decks(
    x: np.ndarray,
    *,
    max_step: float = 0.5e-9,
    reltol: float = 1e-4,
    load: float = light_load.LOAD,
) -> list[str]:
    """ngspice input files of samples `x [n, 44]` in sigma, level 1.

    Args:
        x: samples.
        max_step: largest time step [s].
        reltol: relative tolerance of ngspice.
        load: [A].
    Returns:
        One text per sample; each prints `vmean`, `vmax` and `vmin` of the third pulse period.
    """
    values, stretch = values_of(FULL, x)
    # Near the steady state: from farther away the third pulse would still be on the way to it.
    start = schematic.V_REF - _trip_offsets(x) + 3e-3
    # Charge of a pulse over the load, and room for what the comparator and a heavy pulse add.
    period = 40e-9 / load + 1e-6
    control = [
        f"tran {max_step!r} {6.0 * period!r} 0 {max_step!r} uic",
        "meas tran t3 when v(qh)=0.5 rise=3",
        "meas tran t4 when v(qh)=0.5 rise=4",
        "meas tran vmean avg v(out) from=$&t3 to=$&t4",
        "meas tran vmax max v(out) from=$&t3 to=$&t4",
        "meas tran vmin min v(out) from=$&t3 to=$&t4",
        "print vmean",
        "print vmax",
        "print vmin",
    ]
    decks = sample_decks(
        "BUCK AT LIGHT LOAD", FULL, values, control,
        stretch=stretch,
        model="level1",
        waves={"Iload": ((0.0, load), (1.0, load))},
        own=_controller(),
        options=f"reltol={reltol!r}",
        extra=".ic v(out)=@ v(oe)=0 v(lx)=@ v(sw)=@ v(gp)=2.5 v(gn)=0 v(qh)=0 v(ql)=0",
    )  # fmt: skip
    return [deck.replace("@", f"{v:.6f}") for deck, v in zip(decks, start, strict=True)]


def light_reference(
    x: np.ndarray,
    *,
    workers: int = 2,
    timeout: float = 300.0,
    max_step: float = 0.5e-9,
    load: float = light_load.LOAD,
) -> tuple[np.ndarray, np.ndarray]:
    """Specifications of samples by ngspice, every transistor switching.

    Args:
        x: `[n, 44]` in sigma.
        workers: processes at a time.
        timeout: limit of each [s].
        max_step: largest time step [s].
        load: [A].
    Returns:
        (specs `[n, 2]` as `light_load.SPECS`, status `[n]`).
    Raises:
        NgspiceError: not installed.
    """
    decks = light_decks(x, max_step=max_step, load=load)
    numbers, status = ngspice.run_many(
        decks, ("vmean", "vmax", "vmin"), workers=workers, timeout=timeout
    )
    mean, high, low = numbers.T
    return np.stack([np.abs(mean - schematic.V_REF), high - low], axis=1), status
