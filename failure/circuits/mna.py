"""Modified nodal analysis: from a netlist to a batched residual and its sparse Jacobian.

Unknowns are the node voltages that no grounded voltage source fixes, then the branch currents of
inductors and floating voltage sources. The batch is the last axis of every array. The Jacobian is
a dictionary of its structurally nonzero entries, each `[batch]`; elimination runs without pivoting
in minimum-degree order and is unrolled when it is traced, so that XLA sees straight-line code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from failure.circuits.mosfet import MODELS, MosParams, drain_current, mos_params
from failure.circuits.netlist import (
    GROUND,
    Capacitor,
    CurrentSource,
    Inductor,
    Load,
    Mosfet,
    Netlist,
    Resistor,
    Switch,
    VoltageSource,
)

__all__ = [
    "GMIN",
    "Stamps",
    "System",
    "Values",
    "compile_netlist",
    "eliminate",
    "nominal_values",
    "residual",
    "source_current",
    "stamps",
]

GMIN = 1e-12
"""Conductance from every unknown node to ground [S]."""

Entries = dict[tuple[int, int], Array]


class Values(NamedTuple):
    """Element values; leaves `[n_elements_of_that_kind, batch]`, or `[..., 1]` when common."""

    mos: MosParams
    ohms: Float[Array, "r b"]
    farads: Float[Array, "c b"]
    henries: Float[Array, "l b"]
    volts: Float[Array, "v b"]
    amps: Float[Array, "i b"]
    load: Float[Array, "o b"]
    control: Float[Array, "s b"]


@dataclass(frozen=True, eq=False)
class System:
    """A compiled netlist: index maps only, no numbers of a sample."""

    netlist: Netlist
    model: str
    unknowns: tuple[str, ...]
    """Node names, then `element#branch` for the branch currents."""
    known: tuple[str, ...]
    """Fixed nodes (grounded sources), then ground."""
    order: tuple[int, ...]
    """Elimination order of the unknowns."""
    fixed_by: Mapping[str, int]
    """Fixed node -> index of its voltage source."""

    @property
    def n(self) -> int:
        """Number of unknowns."""
        return len(self.unknowns)

    def index(self, node: str) -> int:
        """Position of a node in the vector `[unknowns, known]`.

        Raises:
            ValueError: no such node.
        """
        names = (*self.unknowns, *self.known)
        if node not in names:
            raise ValueError(f"no node {node!r} in {self.netlist.title}; known: {', '.join(names)}")
        return names.index(node)


def compile_netlist(netlist: Netlist, model: str = "ekv") -> System:
    """Number the unknowns of a netlist and choose the elimination order.

    Args:
        netlist: the circuit.
        model: MOSFET model, "ekv" or "level1".
    Returns:
        System.
    Raises:
        ValueError: unknown model, two grounded sources on one node, or a node whose only
            connections are inductors, floating sources or gates, so that nothing pins it at DC.
    """
    if model not in MODELS:
        raise ValueError(f"unknown MOSFET model {model!r}; known: {', '.join(MODELS)}")
    fixed: dict[str, int] = {}
    branches = [f"{e.name}#branch" for e in netlist.of(Inductor)]
    for k, source in enumerate(netlist.of(VoltageSource)):
        if source.n == GROUND:
            if source.p in fixed:
                raise ValueError(f"{netlist.title}: two voltage sources fix node {source.p!r}")
            fixed[source.p] = k
        else:
            branches.append(f"{source.name}#branch")
    free = [n for n in netlist.nodes() if n != GROUND and n not in fixed]
    system = System(netlist, model, (*free, *branches), (*fixed, GROUND), (), fixed)
    return System(netlist, model, system.unknowns, system.known, _order(system), fixed)


def _order(system: System) -> tuple[int, ...]:
    """Minimum-degree order in which every pivot is structurally nonzero."""
    graph: dict[int, set[int]] = {i: set() for i in range(system.n)}
    grounded = set()
    for (i, j), dc in _pattern(system).items():
        if i == j:
            if dc:
                grounded.add(i)
        elif j < system.n:
            graph[i].add(j)
            graph[j].add(i)
    order: list[int] = []
    while graph:
        ready = [i for i in graph if i in grounded]
        if not ready:
            names = ", ".join(system.unknowns[i] for i in graph)
            raise ValueError(
                f"{system.netlist.title}: nothing but inductors, capacitors, gates or floating "
                f"sources holds {names}; add a resistance"
            )
        pivot = min(ready, key=lambda i: (len(graph[i]), i))
        near = graph.pop(pivot)
        for i in near:
            graph[i] |= near - {i}
            graph[i].discard(pivot)
        # A branch row has no diagonal of its own; eliminating one of its nodes gives it one.
        grounded |= near
        order.append(pivot)
    return tuple(order)


def _pattern(system: System) -> dict[tuple[int, int], bool]:
    """Structural nonzeros -> whether the entry is nonzero at DC by more than gmin."""
    pattern: dict[tuple[int, int], bool] = {}

    def put(row: str, column: str, dc: bool) -> None:
        i, j = system.index(row), system.index(column)
        if i < system.n:
            pattern[i, j] = pattern.get((i, j), False) or dc

    for e in system.netlist.elements:
        if isinstance(e, Mosfet):
            for row in (e.drain, e.source):
                put(row, e.drain, row == e.drain)
                put(row, e.source, row == e.source)
                put(row, e.gate, False)
                put(e.gate, row, False)  # gate capacitances
            put(e.gate, e.gate, False)
        elif isinstance(e, Resistor | Switch | Load | Capacitor):
            for row in (e.p, e.n):
                for column in (e.p, e.n):
                    put(row, column, not isinstance(e, Capacitor))
        branch = f"{e.name}#branch"
        if branch in system.unknowns:
            for node in (e.p, e.n):
                put(node, branch, False)
                put(branch, node, False)
    return pattern


def nominal_values(system: System) -> Values:
    """Values of the netlist as drawn, leaves `[n, 1]`, float64 inside `jax.enable_x64`."""

    def column(kind: type, attribute: str) -> Array:
        return jnp.array([getattr(e, attribute) for e in system.netlist.of(kind)]).reshape(-1, 1)

    def process(attribute: str) -> Array:
        return jnp.array(
            [getattr(e.process, attribute) for e in system.netlist.of(Mosfet)]
        ).reshape(-1, 1)

    mos = mos_params(
        process("polarity"),
        process("mobility"),
        process("early"),
        process("overlap"),
        width=column(Mosfet, "width"),
        length=column(Mosfet, "length"),
        vto=process("vto"),
        tox=process("tox"),
    )
    return Values(
        mos=mos,
        ohms=column(Resistor, "ohms"),
        farads=column(Capacitor, "farads"),
        henries=column(Inductor, "henries"),
        volts=column(VoltageSource, "volts"),
        amps=column(CurrentSource, "amps"),
        load=column(Load, "amps"),
        control=column(Switch, "control"),
    )


class Stamps(NamedTuple):
    """The part of the equations that Newton does not change; the batch is last.

    `linear` holds the entries `(i, j)` of `keys`, `const` the constant current of each row.
    """

    linear: Float[Array, "nnz b"]
    const: Float[Array, "n b"]
    known: Float[Array, "k b"]
    mos: MosParams
    load: Float[Array, "o b"]


def _add(entries: Entries, i: int, j: int, value: Array) -> None:
    entries[i, j] = entries[i, j] + value if (i, j) in entries else value


def _pair(entries: Entries, system: System, p: str, n: str, g: Array) -> None:
    """Stamp a conductance between two nodes, rows of known nodes left out."""
    i, j = system.index(p), system.index(n)
    for row, column, sign in ((i, i, 1.0), (i, j, -1.0), (j, j, 1.0), (j, i, -1.0)):
        if row < system.n:
            _add(entries, row, column, sign * g)


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
    n_nodes = len([u for u in system.unknowns if "#" not in u])
    for i in range(n_nodes):
        _add(entries, i, i, jnp.full_like(values.mos.beta[0], GMIN))
    for k, r in enumerate(system.netlist.of(Resistor)):
        _pair(entries, system, r.p, r.n, 1.0 / values.ohms[k])
    for k, s in enumerate(system.netlist.of(Switch)):
        on, off = np.log(1.0 / s.ohms_on), np.log(1.0 / s.ohms_off)
        _pair(entries, system, s.p, s.n, jnp.exp(off + (on - off) * values.control[k]))
    for k, c in enumerate(system.netlist.of(CurrentSource)):
        for node, sign in ((c.p, 1.0), (c.n, -1.0)):
            i = system.index(node)
            if i < system.n:
                const[i] = const.get(i, 0.0) + sign * values.amps[k]
    one = jnp.ones_like(values.mos.beta[0])
    sources = [(k, v) for k, v in enumerate(system.netlist.of(VoltageSource))]
    for k, b in [(None, e) for e in system.netlist.of(Inductor)] + sources:
        name = f"{b.name}#branch"
        if name not in system.unknowns:
            continue
        row = system.index(name)
        for node, sign in ((b.p, 1.0), (b.n, -1.0)):
            i = system.index(node)
            if i < system.n:
                _add(entries, i, row, sign * one)
            _add(entries, row, i, sign * one)
        if k is not None:
            const[row] = -values.volts[k]
    return entries, const


def keys(system: System) -> list[tuple[int, int]]:
    """Order in which `Stamps.linear` lists the entries among unknowns."""
    found = {k for k in _pattern(system) if k[1] < system.n}
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
    entries, const = conductance(system, values)
    known = known_voltages(system, values, batch)
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


def batch_size(values: Values) -> int:
    """The common length of the last axis."""
    leaves = [*values.mos, *values[1:]]
    return max(leaf.shape[-1] for leaf in leaves if leaf.shape[0])


def residual(
    system: System, v: Float[Array, "n b"], s: Stamps
) -> tuple[Float[Array, "n b"], Entries]:
    """Sum of the currents that leave each node, and its Jacobian.

    Args:
        system: compiled netlist.
        v: unknowns.
        s: Stamps.
    Returns:
        (F `[n, b]`, entries `(i, j) -> [b]`).
    """
    full = jnp.concatenate([v, s.known])
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
            _add(entries, i, j, g)

    mosfets = system.netlist.of(Mosfet)
    if mosfets:
        d, g, t = (
            np.array([system.index(getattr(m, a)) for m in mosfets])
            for a in ("drain", "gate", "source")
        )
        current, gm, gds = drain_current(system.model, full[d], full[g], full[t], s.mos)
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


def eliminate(system: System, entries: Entries, rhs: Float[Array, "n b"]) -> Float[Array, "n b"]:
    """Solve the sparse system for one right-hand side, batch last, without pivoting.

    Args:
        system: gives the order.
        entries: `(i, j) -> [b]`.
        rhs: right-hand sides.
    Returns:
        Solution `[n, b]`.
    Deviation: LU with partial pivoting is safer; nodal matrices with gmin on the diagonal do not
        need it here, and a small pivot shows up as a sample that does not converge.
    """
    a = dict(entries)
    b = [rhs[i] for i in range(system.n)]
    done: set[int] = set()
    inverse: dict[int, Array] = {}
    for p in system.order:
        done.add(p)
        below = sorted(i for (i, j) in a if j == p and i not in done)
        right = sorted(j for (i, j) in a if i == p and j not in done)
        inverse[p] = 1.0 / a[p, p]
        for i in below:
            factor = a[i, p] * inverse[p]
            for j in right:
                _add(a, i, j, -factor * a[p, j])
            b[i] = b[i] - factor * b[p]
    x: dict[int, Array] = {}
    position = {p: k for k, p in enumerate(system.order)}
    for p in reversed(system.order):
        value = b[p]
        for j in sorted(j for (i, j) in a if i == p and position[j] > position[p]):
            value = value - a[p, j] * x[j]
        x[p] = value * inverse[p]
    return jnp.stack([x[i] for i in range(system.n)])


def source_current(
    system: System, v: Float[Array, "n b"], values: Values, name: str
) -> Float[Array, "b"]:
    """DC current that a grounded voltage source delivers into the circuit [A].

    Raises:
        ValueError: no such grounded voltage source.
    """
    at = {s.name: s.p for s in system.netlist.of(VoltageSource) if s.n == GROUND}
    if name not in at:
        raise ValueError(f"no grounded voltage source {name!r}; known: {', '.join(at)}")
    node = at[name]
    batch = batch_size(values)
    full = jnp.concatenate([v, known_voltages(system, values, batch)])
    total = jnp.zeros((batch,), v.dtype)
    for k, r in enumerate(system.netlist.of(Resistor)):
        drop = full[system.index(r.p)] - full[system.index(r.n)]
        total = total + ((r.p == node) - (r.n == node)) * drop / values.ohms[k]
    for k, c in enumerate(system.netlist.of(CurrentSource)):
        total = total + ((c.p == node) - (c.n == node)) * values.amps[k]
    for b in system.netlist.elements:
        branch = f"{b.name}#branch"
        if branch in system.unknowns:
            total = total + ((b.p == node) - (b.n == node)) * full[system.index(branch)]
    for k, load in enumerate(system.netlist.of(Load)):
        drop = full[system.index(load.p)] - full[system.index(load.n)]
        sign = (load.p == node) - (load.n == node)
        total = total + sign * values.load[k] * jnp.tanh(drop / load.knee)
    for k, m in enumerate(system.netlist.of(Mosfet)):
        if node in (m.drain, m.source):
            vd, vg, vs = (full[system.index(t)] for t in (m.drain, m.gate, m.source))
            params = MosParams(*(leaf[k] for leaf in values.mos))
            current, _, _ = drain_current(system.model, vd, vg, vs, params)
            total = total + ((m.drain == node) - (m.source == node)) * current
    return total
