r"""The equations of a compiled netlist by incidence matrices: a program of a few dozen operations.

An element between nodes p and n has the column :math:`a = e_p - e_n`. Conductances then stamp
:math:`a\,g\,a^\top`, and a transistor with columns :math:`a_{ds}, a_{gs}` has the current
:math:`I(a_{gs}^\top v, a_{ds}^\top v)` along :math:`a_{ds}`. `mna` writes the same equations entry
by entry, which runs faster and takes several times longer to compile.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from failure.circuits.solver.mosfet import MosParams, drain_current
from failure.circuits.solver.netlist import (
    Capacitor,
    CurrentSource,
    Load,
    Mosfet,
    Resistor,
    Switch,
    VoltageSource,
)
from failure.circuits.solver.system import System, branches
from failure.circuits.solver.values import Values


def columns(system: System, kind: type, p: str = "p", n: str = "n") -> Float[np.ndarray, "m e"]:
    """Incidence of a kind of elements: +1 at terminal `p`, -1 at `n`; rows as `System.index`."""
    elements = system.netlist.of(kind)
    found = np.zeros((system.n + len(system.known), len(elements)))
    for k, e in enumerate(elements):
        found[system.index(getattr(e, p)), k] += 1.0
        found[system.index(getattr(e, n)), k] -= 1.0
    return found


def _spread(
    system: System, rows: np.ndarray, across: np.ndarray, g: Float[Array, "e #b"]
) -> Float[Array, "n m #b"]:
    """Matrix with entries :math:`\\sum_e r_{ie} c_{je} g_e`, rows of unknowns only."""
    shape = (system.n, len(across), rows.shape[1])
    tensor = rows[: system.n, None] * across[None]
    flat = jnp.asarray(tensor.reshape(shape[0] * shape[1], shape[2]), g.dtype) @ g
    return flat.reshape(*shape[:2], g.shape[-1])


def _times(a: Float[Array, "n m #b"], x: Float[Array, "m b"]) -> Float[Array, "n b"]:
    return jnp.sum(a * x[None], axis=1)


def capacitance(system: System, values: Values) -> Float[Array, "n m #b"]:
    """Capacitance matrix, columns over `[unknowns, known]`."""
    plain = columns(system, Capacitor)
    to_source = columns(system, Mosfet, "gate", "source")
    to_drain = columns(system, Mosfet, "gate", "drain")
    return (
        _spread(system, plain, plain, values.farads)
        + _spread(system, to_source, to_source, values.mos.cgs)
        + _spread(system, to_drain, to_drain, values.mos.cgd)
    )


def conductance(
    system: System, values: Values, gmin: float
) -> tuple[Float[Array, "n m #b"], Float[Array, "n #b"]]:
    """Linear conductances and branch equations, and the constant term of each row."""
    dtype = values.volts.dtype
    resistors, switches = columns(system, Resistor), columns(system, Switch)
    ends = system.netlist.of(Switch)
    off = np.array([np.log(1.0 / s.ohms_off) for s in ends]).reshape(-1, 1)
    on = np.array([np.log(1.0 / s.ohms_on) for s in ends]).reshape(-1, 1)
    control = jnp.exp(jnp.asarray(off, dtype) + jnp.asarray(on - off, dtype) * values.control)
    sources = system.netlist.of(VoltageSource)
    fixed = np.zeros((system.n, system.n + len(system.known), 1))
    placed = np.zeros((system.n, len(sources)))
    fixed[np.arange(system.n_nodes), np.arange(system.n_nodes), 0] = gmin
    for b in branches(system.netlist):
        row = system.index(f"{b.name}#branch")
        for node, sign in ((b.p, 1.0), (b.n, -1.0)):
            i = system.index(node)
            fixed[row, i, 0] += sign
            if i < system.n:
                fixed[i, row, 0] += sign
        if isinstance(b, VoltageSource):
            placed[row, sources.index(b)] = -1.0
    matrix = (
        jnp.asarray(fixed, dtype)
        + _spread(system, resistors, resistors, 1.0 / values.ohms)
        + _spread(system, switches, switches, control)
    )
    amps = jnp.asarray(columns(system, CurrentSource)[: system.n], dtype) @ values.amps
    return matrix, amps + jnp.asarray(placed, dtype) @ values.volts


class Device(NamedTuple):
    """Currents into the nodes and their slopes, of everything that is not linear."""

    current: Float[Array, "n b"]
    slope: Float[Array, "n n b"]


def devices(
    system: System, mos: MosParams, load: Float[Array, "o #b"], full: Float[Array, "m b"]
) -> Device:
    """Transistors and loads at the voltages `full` of all nodes."""
    dtype = full.dtype
    across = columns(system, Mosfet, "drain", "source")
    gate = columns(system, Mosfet, "gate", "source")
    vds, vgs = (jnp.asarray(a.T, dtype) @ full for a in (across, gate))
    current, gm, gds = drain_current(system.model, mos, vds, vgs, jnp.zeros_like(vds))
    n = system.n
    loads = columns(system, Load)
    knee = jnp.asarray([[e.knee] for e in system.netlist.of(Load)], dtype).reshape(-1, 1)
    bend = jnp.tanh((jnp.asarray(loads.T, dtype) @ full) / knee)
    amps = load + jnp.zeros_like(bend)
    total = jnp.asarray(across[:n], dtype) @ current + jnp.asarray(loads[:n], dtype) @ (amps * bend)
    slope = (
        _spread(system, across, gate[:n], gm)
        + _spread(system, across, across[:n], gds)
        + _spread(system, loads, loads[:n], amps * (1.0 - bend * bend) / knee)
    )
    return Device(total, slope)
