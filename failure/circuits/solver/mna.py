"""Modified nodal analysis: the batched residual of a compiled netlist and its sparse Jacobian.

The batch is the last axis of every array. The Jacobian is a dictionary of its structurally nonzero
entries, each `[batch]`; of a dense system (`System.dense`) it is one array, by `incidence`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from failure.circuits.solver import incidence
from failure.circuits.solver.elimination import Entries, add_entry
from failure.circuits.solver.mosfet import MosParams, drain_current
from failure.circuits.solver.netlist import (
    GROUND,
    Capacitor,
    CurrentSource,
    Load,
    Mosfet,
    Resistor,
    Switch,
    VoltageSource,
)
from failure.circuits.solver.system import System, branches, pattern
from failure.circuits.solver.values import Values, batch_size

GMIN = 1e-12
"""Conductance from every unknown node to ground [S]."""


class Stamps(NamedTuple):
    """The part of the equations that Newton does not change; the batch is last.

    `linear` holds the entries `(i, j)` of `keys`, of a dense system the matrix `[n, n, b]`; `const`
    the constant current of each row.
    """

    linear: Float[Array, "... b"]
    const: Float[Array, "n b"]
    known: Float[Array, "k b"]
    mos: MosParams
    load: Float[Array, "o b"]


def _pair(entries: Entries, system: System, p: str, n: str, g: Array) -> None:
    """Stamp a conductance between two nodes, rows of known nodes left out."""
    i, j = system.index(p), system.index(n)
    for row, column, sign in ((i, i, 1.0), (i, j, -1.0), (j, j, 1.0), (j, i, -1.0)):
        if row < system.n:
            add_entry(entries, row, column, sign * g)


def known_voltages(system: System, values: Values, batch: int) -> Float[Array, "k b"]:
    """Voltages of the fixed nodes and of ground."""
    rows = [jnp.broadcast_to(values.volts[k], (batch,)) for k in system.fixed_by.values()]
    return jnp.stack([*rows, jnp.zeros_like(rows[0]) if rows else jnp.zeros(batch)])


def capacitance(system: System, values: Values) -> Entries:
    """Capacitance matrix, columns over `[unknowns, known]`."""
    entries: Entries = {}
    for k, e in enumerate(system.netlist.of(Capacitor)):
        _pair(entries, system, e.p, e.n, values.farads[k])
    for k, m in enumerate(system.netlist.of(Mosfet)):
        _pair(entries, system, m.gate, m.source, values.mos.cgs[k])
        _pair(entries, system, m.gate, m.drain, values.mos.cgd[k])
    return entries


def conductance(system: System, values: Values) -> tuple[Entries, dict[int, Array]]:
    """Linear conductances and branch equations, and the constant term of each row."""
    entries: Entries = {}
    const: dict[int, Array] = {}
    one = jnp.ones((batch_size(values),), values.volts.dtype)
    for i in range(system.n_nodes):
        add_entry(entries, i, i, GMIN * one)
    for k, r in enumerate(system.netlist.of(Resistor)):
        _pair(entries, system, r.p, r.n, 1.0 / values.ohms[k])
    for k, s in enumerate(system.netlist.of(Switch)):
        on, off = float(np.log(1.0 / s.ohms_on)), float(np.log(1.0 / s.ohms_off))
        _pair(entries, system, s.p, s.n, jnp.exp(off + (on - off) * values.control[k]))
    for k, c in enumerate(system.netlist.of(CurrentSource)):
        for node, sign in ((c.p, 1.0), (c.n, -1.0)):
            i = system.index(node)
            if i < system.n:
                const[i] = const.get(i, 0.0 * one) + sign * values.amps[k]
    sources = system.netlist.of(VoltageSource)
    for b in branches(system.netlist):
        row = system.index(f"{b.name}#branch")
        for node, sign in ((b.p, 1.0), (b.n, -1.0)):
            i = system.index(node)
            if i < system.n:
                add_entry(entries, i, row, sign * one)
            add_entry(entries, row, i, sign * one)
        if isinstance(b, VoltageSource):
            const[row] = -values.volts[sources.index(b)]
    return entries, const


def keys(system: System) -> list[tuple[int, int]]:
    """Order in which `Stamps.linear` lists the entries among unknowns."""
    found = {k for k in pattern(system) if k[1] < system.n}
    found |= {(i, i) for i in range(system.n)}
    return sorted(found)


def stamps(system: System, values: Values) -> Stamps:
    """DC equations of a batch: capacitors open, inductors short.

    Args:
        system: compiled netlist.
        values: element values, at least one leaf with the full batch.
    Returns:
        Stamps.
    """
    batch = batch_size(values)
    known = known_voltages(system, values, batch)
    if system.dense:
        matrix, constant = incidence.conductance(system, values, GMIN)
        return assemble_full(system, values, matrix, constant, known)
    entries, const = conductance(system, values)
    return assemble(system, values, entries, const, known, batch)


def assemble(
    system: System,
    values: Values,
    entries: Entries,
    const: Mapping[int, Array],
    known: Float[Array, "k b"],
    batch: int,
) -> Stamps:
    """Split entries into the matrix among unknowns and the constant term."""
    zero = jnp.zeros((batch,), known.dtype)
    rows = [const.get(i, zero) + zero for i in range(system.n)]
    for (i, j), value in entries.items():
        if j >= system.n and j != system.n + len(system.known) - 1:
            rows[i] = rows[i] + value * known[j - system.n]
    linear = [entries.get(k, zero) + zero for k in keys(system)]
    return Stamps(jnp.stack(linear), jnp.stack(rows), known, values.mos, values.load)


def assemble_full(
    system: System,
    values: Values,
    matrix: Float[Array, "n m #b"],
    const: Float[Array, "n #b"],
    known: Float[Array, "k b"],
) -> Stamps:
    """`assemble` of a dense system."""
    n = system.n
    fixed = const + jnp.sum(matrix[:, n:] * known[None], axis=1)
    linear = matrix[:, :n] + jnp.zeros_like(fixed[:, None])
    return Stamps(linear, fixed, known, values.mos, values.load)


def residual(
    system: System, s: Stamps, v: Float[Array, "n b"]
) -> tuple[Float[Array, "n b"], Entries | Float[Array, "n n b"]]:
    """Sum of the currents that leave each node, and its Jacobian.

    Args:
        system: compiled netlist.
        s: Stamps.
        v: unknowns.
    Returns:
        (F `[n, b]`, entries `(i, j) -> [b]`, of a dense system the matrix).
    """
    full = jnp.concatenate([v, s.known])
    if system.dense:
        device = incidence.devices(system, s.mos, s.load, full)
        linear = jnp.sum(s.linear * v[None], axis=1)
        return s.const + linear + device.current, s.linear + device.slope
    rows = [s.const[i] for i in range(system.n)]
    entries: Entries = {}
    for k, (i, j) in enumerate(keys(system)):
        entries[i, j] = s.linear[k]
        rows[i] = rows[i] + s.linear[k] * v[j]

    def put(i: int, current: Array) -> None:
        if i < system.n:
            rows[i] = rows[i] + current

    def slope(i: int, j: int, g: Array) -> None:
        if i < system.n and j < system.n:
            add_entry(entries, i, j, g)

    mosfets = system.netlist.of(Mosfet)
    if mosfets:
        d, g, t = (
            np.array([system.index(getattr(m, a)) for m in mosfets])
            for a in ("drain", "gate", "source")
        )
        current, gm, gds = drain_current(system.model, s.mos, full[d], full[g], full[t])
        for k in range(len(mosfets)):
            i, j, o = int(d[k]), int(g[k]), int(t[k])
            put(i, current[k])
            put(o, -current[k])
            for row, sign in ((i, 1.0), (o, -1.0)):
                slope(row, j, sign * gm[k])
                slope(row, i, sign * gds[k])
                slope(row, o, -sign * (gm[k] + gds[k]))
    for k, load in enumerate(system.netlist.of(Load)):
        i, j = system.index(load.p), system.index(load.n)
        bend = jnp.tanh((full[i] - full[j]) / load.knee)
        amps = s.load[k]
        g_load = amps * (1.0 - bend * bend) / load.knee
        put(i, amps * bend)
        put(j, -amps * bend)
        for row, column, sign in ((i, i, 1.0), (i, j, -1.0), (j, j, 1.0), (j, i, -1.0)):
            slope(row, column, sign * g_load)
    return jnp.stack(rows), entries


def source_current(
    system: System, values: Values, v: Float[Array, "n b"], *, name: str
) -> Float[Array, "b"]:
    """DC current that a grounded voltage source delivers into the circuit [A].

    Raises:
        ValueError: no such grounded voltage source.
    """
    at = {s.name: s.p for s in system.netlist.of(VoltageSource) if s.n == GROUND}
    if name not in at:
        raise ValueError(
            f"name={name!r}: expected a grounded voltage source; known: {', '.join(at)}"
        )
    node = at[name]
    batch = batch_size(values)
    full = jnp.concatenate([v, known_voltages(system, values, batch)])
    total = jnp.zeros((batch,), v.dtype)
    for k, r in enumerate(system.netlist.of(Resistor)):
        drop = full[system.index(r.p)] - full[system.index(r.n)]
        total = total + ((r.p == node) - (r.n == node)) * drop / values.ohms[k]
    for k, c in enumerate(system.netlist.of(CurrentSource)):
        total = total + ((c.p == node) - (c.n == node)) * values.amps[k]
    for b in branches(system.netlist):
        sign = (b.p == node) - (b.n == node)
        total = total + sign * full[system.index(f"{b.name}#branch")]
    for k, load in enumerate(system.netlist.of(Load)):
        drop = full[system.index(load.p)] - full[system.index(load.n)]
        sign = (load.p == node) - (load.n == node)
        total = total + sign * values.load[k] * jnp.tanh(drop / load.knee)
    mosfets = system.netlist.of(Mosfet)
    near = np.array([k for k, m in enumerate(mosfets) if node in (m.drain, m.source)], int)
    if near.size:
        # All of them at once: one by one each would be a program of its own to the compiler.
        d, g, t = (
            np.array([system.index(getattr(mosfets[k], a)) for k in near])
            for a in ("drain", "gate", "source")
        )
        params = MosParams(*(leaf[near] for leaf in values.mos))
        current, _, _ = drain_current(system.model, params, full[d], full[g], full[t])
        signs = [(mosfets[k].drain == node) - (mosfets[k].source == node) for k in near]
        total = total + jnp.asarray(signs, v.dtype) @ current
    return total
