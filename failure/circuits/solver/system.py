"""Compiled netlists: which unknowns there are, which entries are nonzero, what goes first.

Unknowns are the node voltages that no grounded voltage source fixes, then the branch currents of
inductors and floating voltage sources.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from failure.circuits.solver.mosfet import MODELS
from failure.circuits.solver.netlist import (
    GROUND,
    Capacitor,
    Inductor,
    Load,
    Mosfet,
    Netlist,
    Resistor,
    Switch,
    VoltageSource,
)


def branches(netlist: Netlist) -> list[Inductor | VoltageSource]:
    """Elements whose current is an unknown: inductors, then floating voltage sources."""
    floating = [v for v in netlist.of(VoltageSource) if v.n != GROUND]
    return [*netlist.of(Inductor), *floating]


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
    dense: bool = False
    """Eliminate the full matrix: slower to run, several times quicker to compile."""

    @property
    def n(self) -> int:
        """Number of unknowns."""
        return len(self.unknowns)

    @property
    def n_nodes(self) -> int:
        """Number of unknown node voltages; they come first."""
        return self.n - len(branches(self.netlist))

    def index(self, node: str) -> int:
        """Position of a node in the vector `[unknowns, known]`.

        Raises:
            ValueError: no such node.
        """
        names = (*self.unknowns, *self.known)
        if node not in names:
            raise ValueError(
                f"node={node!r}: expected a node of {self.netlist.title}; known: {', '.join(names)}"
            )
        return names.index(node)


def compile_netlist(netlist: Netlist, model: str = "ekv", *, dense: bool = False) -> System:
    """Number the unknowns of a netlist and choose the elimination order.

    Args:
        netlist: the circuit.
        model: MOSFET model, "ekv" or "level1".
        dense: for programs that are compiled to run a few times, as gradients are.
    Returns:
        System.
    Raises:
        ValueError: unknown model, two grounded sources on one node, or a node whose only
            connections are inductors, floating sources or gates, so that nothing pins it at DC.
    """
    if model not in MODELS:
        raise ValueError(f"model={model!r}: expected one of {', '.join(map(repr, MODELS))}")
    fixed: dict[str, int] = {}
    for k, source in enumerate(netlist.of(VoltageSource)):
        if source.n == GROUND:
            if source.p in fixed:
                raise ValueError(f"{netlist.title}: two voltage sources fix node {source.p!r}")
            fixed[source.p] = k
    currents = [f"{b.name}#branch" for b in branches(netlist)]
    free = [n for n in netlist.nodes() if n != GROUND and n not in fixed]
    system = System(netlist, model, (*free, *currents), (*fixed, GROUND), (), fixed)
    return System(netlist, model, system.unknowns, system.known, _order(system), fixed, dense)


def _order(system: System) -> tuple[int, ...]:
    """Minimum-degree order in which every pivot is structurally nonzero."""
    graph: dict[int, set[int]] = {i: set() for i in range(system.n)}
    grounded = set()
    for (i, j), dc in pattern(system).items():
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


def pattern(system: System) -> dict[tuple[int, int], bool]:
    """Structural nonzeros, and whether each is nonzero at DC by more than gmin.

    Rows are unknowns, columns unknowns and known nodes.
    """
    found: dict[tuple[int, int], bool] = {}

    def put(row: str, column: str, dc: bool) -> None:
        i, j = system.index(row), system.index(column)
        if i < system.n:
            found[i, j] = found.get((i, j), False) or dc

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
    for b in branches(system.netlist):
        for node in (b.p, b.n):
            put(node, f"{b.name}#branch", False)
            put(f"{b.name}#branch", node, False)
    return found
