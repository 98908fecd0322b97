"""Schematics of the bundled circuits, drawn from the netlists that are simulated.

Only the places of the elements are kept here; what is connected to what, and the widths, come from
the netlist. An element without a place, or a place without an element, is refused.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from snn_fusion_failure.documentation.svg import SOFT, Canvas

WIDE, HIGH = 108.0, 112.0
"""Size of a cell."""

LDO = {
    "Iref": (0, 0), "MB1": (0, 2),
    "MB4": (1, 0), "MB3": (1, 2),
    "M3": (2, 0), "M1": (2, 1), "MB2": (2, 2),
    "M4": (3, 0), "M2": (3, 1),
    "M6": (4, 0), "M7": (4, 2),
    "M5": (5, 0), "M8": (5, 2),
    "M9": (6, 0), "M10": (6, 2),
    "MB5": (7, 0), "M11": (7, 1), "M13": (7, 2),
    "MP": (8, 0), "MB6": (8, 2),
    "MB7": (9, 2), "Bload": (10, 2),
    "Cout": (11, 1), "Resr": (11, 2),
}  # fmt: skip
"""Element -> (column, row)."""

AMPLIFIER = {
    "MA3": (0, 0), "MA1": (0, 1), "MA5": (0, 2), "MA4": (1, 0), "MA2": (1, 1),
}  # fmt: skip
POWER = {
    "MC3": (0, 0), "MC1": (0, 1), "MC5": (0, 2), "MC4": (1, 0), "MC2": (1, 1),
    "MC6": (2, 0), "MC7": (2, 2), "MC8": (3, 0), "MC9": (3, 2), "MD5": (4, 0), "MD6": (4, 2),
    "MD1": (5, 0), "MD2": (5, 2), "MD3": (6, 0), "MD4": (6, 2), "MSP": (7, 0), "MSN": (7, 2),
    "IL": (8, 2),
}  # fmt: skip
SUPPLIES = frozenset({"Vin", "Vdd", "Vref", "Vnb", "Vfb", "Vcomp", "Vramp"})
"""Sources that are shown by the names of their nodes."""

Pins = list[tuple[str, float, float]]


def _supply(net: str) -> bool:
    return net in ("vin", "vdd")


def _mosfet(canvas: Canvas, e: Any, x: float, y: float) -> Pins:
    """A transistor with its gate to the left; the terminal at the higher potential is on top."""
    nmos = e.process.polarity > 0
    top, bottom = (e.drain, e.source) if nmos else (e.source, e.drain)
    gate, channel, middle = x - 17, x - 11, y + HIGH / 2
    canvas.line((x, y), (x, middle - 14), (channel, middle - 14))
    canvas.line((x, y + HIGH), (x, middle + 14), (channel, middle + 14))
    canvas.line((channel, middle - 18), (channel, middle + 18), width=2)
    canvas.line((gate, middle - 14), (gate, middle + 14), width=2)
    if nmos:
        canvas.line((x - 30, middle), (gate, middle))
        canvas.line((channel, middle + 14), (x, middle + 14), arrow=True, width=1)
    else:
        canvas.circle(gate - 4, middle, 3.5)
        canvas.line((x - 30, middle), (gate - 7.5, middle))
        canvas.line((x, middle - 14), (channel, middle - 14), arrow=True, width=1)
    canvas.text(x - 32, middle - 4, e.gate, size=10.5, anchor="end", colour="#0969da")
    canvas.text(x + 6, middle - 2, e.name, size=11.5, anchor="start", bold=True)
    size = f"{e.width * 1e6:g} / {e.length * 1e6:g}"
    canvas.text(x + 6, middle + 11, size, size=9, anchor="start", colour=SOFT)
    return [(top, x, y), (bottom, x, y + HIGH)]


def _value(e: Any) -> str:
    for name, unit in (("ohms", "ohm"), ("farads", "F"), ("amps", "A")):
        if hasattr(e, name):
            value = getattr(e, name)
            for factor, prefix in ((1.0, ""), (1e-3, "m"), (1e-6, "u"), (1e-9, "n"), (1e-12, "p")):
                if value >= factor:
                    return f"{value / factor:.3g} {prefix}{unit}"
    return ""


def _two_pin(canvas: Canvas, e: Any, x: float, y: float) -> Pins:
    """A resistor, a capacitor, or a source of current."""
    middle, kind = y + HIGH / 2, type(e).__name__
    if kind == "Capacitor":
        canvas.line((x, y), (x, middle - 4))
        canvas.line((x - 13, middle - 4), (x + 13, middle - 4), width=2)
        canvas.line((x - 13, middle + 4), (x + 13, middle + 4), width=2)
        canvas.line((x, middle + 4), (x, y + HIGH))
    else:
        canvas.line((x, y), (x, middle - 16))
        canvas.line((x, middle + 16), (x, y + HIGH))
        if kind == "Resistor":
            canvas.box(x - 7, middle - 16, 14, 32, radius=0)
        else:
            canvas.circle(x, middle, 16)
            canvas.line((x, middle - 10), (x, middle + 10), arrow=True)
    canvas.text(x + 20, middle - 2, e.name, size=11.5, anchor="start", bold=True)
    canvas.text(x + 20, middle + 11, _value(e), size=9, anchor="start", colour=SOFT)
    return [(e.p, x, y), (e.n, x, y + HIGH)]


def _join(canvas: Canvas, pins: Pins, taken: set[tuple[float, float]]) -> None:
    """Wires between pins of one node, along a row or through an empty cell; names of nodes."""
    for net, x, y in pins:
        if (net, x, y + HIGH) in pins and (x, y) not in taken and net != "0":
            canvas.line((x, y), (x, y + HIGH))
    heights: dict[tuple[str, float], list[float]] = {}
    for net, x, y in pins:
        heights.setdefault((net, y), []).append(x)
    for (net, y), xs in heights.items():
        if _supply(net) or net == "0":
            continue
        xs = sorted(set(xs))
        for before, at in zip([-WIDE * 9, *xs], xs, strict=False):
            if at - before <= WIDE + 1:
                canvas.line((before, y), (at, y))
            else:
                canvas.dot(at, y)
                canvas.text(at + 5, y - 4, net, size=10.5, anchor="start", colour="#0969da")
    for net, x, y in pins:
        if net == "0":
            for i, half in enumerate((9, 6, 3)):
                canvas.line((x - half, y + 3 * i), (x + half, y + 3 * i))
        elif _supply(net):
            canvas.line((x - 12, y), (x + 12, y), width=2)
            canvas.text(x, y - 5, net, size=10, colour=SOFT)


def draw_block(
    canvas: Canvas, elements: Any, places: Mapping[str, tuple[int, int]], x: float, y: float
) -> None:
    """The elements of a netlist at their places.

    Raises:
        ValueError: an element has no place, or the other way round.
    """
    names = {e.name for e in elements} - SUPPLIES
    if names != set(places):
        raise ValueError(
            f"places: {sorted(names ^ set(places))} stand in the netlist or here only; "
            "give every element a column and a row in schematics.py"
        )
    pins: Pins = []
    taken = set()
    for e in elements:
        if e.name in places:
            column, row = places[e.name]
            left, top = x + 62 + column * WIDE, y + row * HIGH
            draw = _mosfet if hasattr(e, "gate") else _two_pin
            pins += draw(canvas, e, left, top)
            taken.add((left, top))
    _join(canvas, pins, taken)


def _notes(canvas: Canvas, y: float, lines: str) -> None:
    canvas.text(20, y, lines, size=12, anchor="start", colour=SOFT)


def ldo() -> str:
    """The low-dropout regulator."""
    from failure.circuits.ldo.schematic import I_HEAVY, I_LIGHT, KNEE, NETLIST, T_STEP

    canvas = Canvas(1400, 490, "Low-dropout regulator: 20 transistors and their connections")
    canvas.text(20, 30, "Low-dropout regulator", size=18, anchor="start", bold=True)
    sources: dict[str, Any] = {e.name: e for e in NETLIST.elements}
    draw_block(canvas, NETLIST.elements, LDO, 10, 80)
    light, heavy = (1e3 * i * math.tanh(1.0 / KNEE) for i in (I_LIGHT, I_HEAVY))
    _notes(
        canvas, 448,
        f"vin = {sources['Vin'].volts:g} V, ref = {sources['Vref'].volts:g} V. Width / length in "
        "micrometres; names in blue are nodes, equal names are connected. Varied: length, "
        "threshold and oxide of each transistor.\n"
        f"At {T_STEP * 1e9:g} ns the load steps from {light:.3g} to {heavy:.3g} mA at 1 V.",
    )  # fmt: skip
    return canvas.render()


def buck() -> str:
    """The buck converter: two blocks at transistor level, joined by the cycle map."""
    from failure.circuits.buck import schematic as s

    canvas = Canvas(1130, 900, "Buck converter: error amplifier, comparator, drivers and switches")
    canvas.text(20, 30, "Buck converter", size=18, anchor="start", bold=True)
    canvas.text(20, 62, "Error amplifier (by DC)", size=13, anchor="start", bold=True)
    draw_block(canvas, s.AMPLIFIER.elements, AMPLIFIER, 10, 95)
    _stage(canvas, s)
    canvas.text(20, 480, "Comparator, drivers, switches (by a transient through both edges)",
                size=13, anchor="start", bold=True)  # fmt: skip
    draw_block(canvas, s.POWER.elements, POWER, 10, 515)
    _notes(
        canvas, 880,
        f"vdd = {s.V_DD:g} V, ref = {s.V_REF:g} V, nb = {s.V_BIAS:g} V. Width / length in "
        "micrometres; equal names are connected. Varied: length and width of each transistor.",
    )  # fmt: skip
    return canvas.render()


def _stage(canvas: Canvas, s: Any) -> None:
    """Power stage and compensator as the cycle map has them."""
    x, y = 400, 62
    canvas.text(x, y, "Cycle map: linear between switching instants", size=13, anchor="start",
                bold=True)  # fmt: skip
    canvas.box(x, 110, 130, 60, "switches\nsw", colour="yellow")
    canvas.line((x + 130, 140), (x + 180, 140))
    coil = f"{s.INDUCTANCE * 1e6:g} uH\n{s.R_COIL:g} ohm"
    canvas.box(x + 180, 118, 90, 44, coil, size=11)
    canvas.line((x + 270, 140), (x + 560, 140))
    canvas.text(x + 565, 132, "out", size=12, anchor="start", bold=True)
    canvas.dot(x + 350, 140)
    canvas.line((x + 350, 140), (x + 350, 172))
    cap = f"{s.CAPACITANCE * 1e6:g} uF\n{s.R_ESR:g} ohm"
    canvas.box(x + 305, 172, 90, 44, cap, size=11)
    canvas.line((x + 350, 216), (x + 350, 236))
    canvas.text(x + 350, 250, "0", size=11)
    canvas.dot(x + 470, 140)
    canvas.line((x + 470, 140), (x + 470, 172))
    load = f"load {s.LOAD_LIGHT:g} A,\nthen {s.LOAD_HEAVY:g} A"
    canvas.box(x + 420, 172, 100, 44, load, size=11)
    canvas.line((x + 470, 216), (x + 470, 236))
    canvas.text(x + 470, 250, "0", size=11)
    canvas.line((x + 560, 140), (x + 660, 140), (x + 660, 300), (x + 560, 300), arrow=True)
    canvas.box(x + 400, 275, 160, 50, "error amplifier\ngm, go, offset", colour="blue", size=12)
    canvas.line((x + 400, 300), (x + 300, 300), arrow=True)
    canvas.text(x + 350, 292, "comp", size=11, colour="#0969da")
    comp = (
        f"{s.R_COMP / 1e3:g} kohm to ref; {s.R_ZERO / 1e3:g} kohm + {s.C_ZERO * 1e12:g} pF to out"
    )
    canvas.text(x + 350, 345, comp, size=10.5, colour=SOFT)
    canvas.box(x + 150, 275, 150, 50, "comparator\nand drivers", colour="blue", size=12)
    ramp = f"ramp {s.RAMP_LOW:g} to {s.RAMP_HIGH:g} V, {1e-6 / s.PERIOD:g} MHz"
    canvas.text(x + 225, 345, ramp, size=10.5, colour=SOFT, anchor="end")
    canvas.line((x + 150, 300), (x + 65, 300), (x + 65, 170), arrow=True)
