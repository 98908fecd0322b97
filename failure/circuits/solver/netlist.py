"""Netlists: what is connected to what. Plain frozen data, no numbers of a sample in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from failure.circuits.solver.mosfet import Process

GROUND = "0"


@dataclass(frozen=True)
class Mosfet:
    """Transistor; nominal `width` and `length` [m]. The bulk carries no current."""

    name: str
    drain: str
    gate: str
    source: str
    bulk: str
    process: Process
    width: float
    length: float


@dataclass(frozen=True)
class Resistor:
    """`ohms` between `p` and `n`."""

    name: str
    p: str
    n: str
    ohms: float


@dataclass(frozen=True)
class Capacitor:
    """`farads` between `p` and `n`."""

    name: str
    p: str
    n: str
    farads: float


@dataclass(frozen=True)
class Inductor:
    """`henries` between `p` and `n`; a short circuit at DC."""

    name: str
    p: str
    n: str
    henries: float


@dataclass(frozen=True)
class VoltageSource:
    """`v_p - v_n = volts`. With `n` at ground the node `p` is known and costs no unknown."""

    name: str
    p: str
    n: str
    volts: float


@dataclass(frozen=True)
class CurrentSource:
    """`amps` flow from `p` through the source to `n`."""

    name: str
    p: str
    n: str
    amps: float


@dataclass(frozen=True)
class Load:
    """Current `amps * tanh(v / knee)`: a constant-current load that lets go as its supply falls."""

    name: str
    p: str
    n: str
    amps: float
    knee: float


@dataclass(frozen=True)
class Switch:
    """Conductance between `1 / ohms_off` (control 0) and `1 / ohms_on` (control 1), log-linear."""

    name: str
    p: str
    n: str
    ohms_on: float
    ohms_off: float
    control: float = 0.0


Element = Mosfet | Resistor | Capacitor | Inductor | VoltageSource | CurrentSource | Load | Switch


@dataclass(frozen=True)
class Netlist:
    """A circuit: its title and elements.

    Raises:
        ValueError: an element name is used twice, a value is not positive where it must be, or
            nothing is connected to ground.
    """

    title: str
    elements: tuple[Element, ...] = field(default=())

    def __post_init__(self) -> None:
        names = [e.name for e in self.elements]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"{self.title}: element names used twice: {', '.join(twice)}")
        for e in self.elements:
            for attribute in ("width", "length", "ohms", "farads", "henries", "knee", "ohms_on"):
                value = getattr(e, attribute, 1.0)
                if not value > 0.0:
                    raise ValueError(
                        f"{self.title}: {e.name}.{attribute}={value!r}: expected a positive number"
                    )
        if self.elements and GROUND not in self.nodes():
            raise ValueError(f'{self.title}: no element touches ground (node "{GROUND}")')

    def of(self, kind: type) -> list:
        """The elements of one class, in order."""
        return [e for e in self.elements if isinstance(e, kind)]

    def nodes(self) -> list[str]:
        """All node names in order of appearance, bulk nodes excluded."""
        seen: dict[str, None] = {}
        for e in self.elements:
            for node in _terminals(e):
                seen.setdefault(node)
        return list(seen)


def _terminals(e: Element) -> Iterator[str]:
    if isinstance(e, Mosfet):
        yield from (e.drain, e.gate, e.source)
    else:
        yield from (e.p, e.n)
