"""Decks for ngspice: the netlist of one sample with its own numbers, and what to measure.

Level 1 uses ngspice's own transistor (Meyer capacitances); "ekv" writes every transistor as a
behavioural current source with the capacitances of the JAX solver, so that the two programs solve
the same equations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from failure.circuits.solver.mosfet import EPS_OX, SLOPE, SMOOTH_VDS, U_T, MosParams
from failure.circuits.solver.netlist import (
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
from failure.circuits.solver.values import Values

Wave = Sequence[tuple[float, float]]


def _pwl(wave: Wave) -> str:
    return "PWL(" + " ".join(f"{t:.12g} {v:.12g}" for t, v in wave) + ")"


def _ekv_source(m: Mosfet, p: float, beta: float, vto: float, lam: float) -> str:
    sign = "" if p > 0 else "-"
    scale = 0.5 / (SLOPE * U_T)
    i_s = 2.0 * SLOPE**2 * U_T**2 * beta

    def softplus(a: str, b: str) -> str:
        return f"ln(1+exp(({sign}(V({a})-V({b}))-({vto!r}))*{scale!r}))"

    square = SMOOTH_VDS**2
    vds = f"(V({m.drain})-V({m.source}))"
    return (
        f"B{m.name} {m.drain} {m.source} I={sign}({i_s!r})*"
        f"({softplus(m.gate, m.source)}-{softplus(m.gate, m.drain)})*"
        f"({softplus(m.gate, m.source)}+{softplus(m.gate, m.drain)})*"
        f"(1+({lam!r})*(sqrt({vds}*{vds}+{square!r})-{SMOOTH_VDS!r}))"
    )


def elements(
    netlist: Netlist,
    values: Values,
    sample: int,
    *,
    geometry: tuple[np.ndarray, np.ndarray],
    model: str = "level1",
    waves: Mapping[str, Wave] | None = None,
) -> list[str]:
    """Element lines of one sample.

    Args:
        netlist: the circuit.
        values: element values, leaves `[n, batch]` or `[n, 1]`.
        sample: column of the batch.
        geometry: (width, length) of the transistors `[n_mosfets, batch or 1]` [m].
        model: "level1" or "ekv".
        waves: element name -> piecewise-linear (time, value) of sources, loads and switches.
    Returns:
        Lines of the deck.
    """
    waves = waves or {}

    def at(leaf: Any, k: int) -> float:
        row = np.asarray(leaf)[k]
        return float(row[sample] if row.shape[0] > 1 else row[0])

    lines = []
    for k, m in enumerate(netlist.of(Mosfet)):
        p, beta, vto, lam, cgs, cgd = (at(leaf, k) for leaf in MosParams(*values.mos))
        if model == "ekv":
            lines.append(_ekv_source(m, p, beta, vto, lam))
            lines.append(f"CS{m.name} {m.gate} {m.source} {cgs!r}")
            lines.append(f"CD{m.name} {m.gate} {m.drain} {cgd!r}")
            continue
        w, length = at(geometry[0], k), at(geometry[1], k)
        kp = beta * length / w
        tox = EPS_OX * m.process.mobility / kp
        kind = "nmos" if p > 0 else "pmos"
        lines.append(
            f"{m.name} {m.drain} {m.gate} {m.source} {m.bulk} m{m.name} W={w!r} L={length!r}"
        )
        lines.append(
            f".model m{m.name} {kind} level=1 vto={p * vto!r} kp={kp!r} lambda={lam!r} "
            f"tox={tox!r} cgso={m.process.overlap!r} cgdo={m.process.overlap!r} gamma=0 phi=0.7"
        )
    passive: tuple[tuple[type, str, Any], ...] = (
        (Resistor, "R", values.ohms),
        (Capacitor, "C", values.farads),
        (Inductor, "L", values.henries),
    )
    for element, letter, leaf in passive:
        for k, e in enumerate(netlist.of(element)):
            lines.append(f"{letter}_{e.name} {e.p} {e.n} {at(leaf, k)!r}")
    sources: tuple[tuple[type, str, Any], ...] = (
        (VoltageSource, "V", values.volts),
        (CurrentSource, "I", values.amps),
    )
    for element, letter, leaf in sources:
        for k, e in enumerate(netlist.of(element)):
            tail = " " + _pwl(waves[e.name]) if e.name in waves else ""
            lines.append(f"{letter}_{e.name} {e.p} {e.n} DC {at(leaf, k)!r}{tail}")
    for k, e in enumerate(netlist.of(Load)):
        tail = " " + _pwl(waves[e.name]) if e.name in waves else ""
        lines.append(f"V_{e.name} {e.name}_c 0 DC {at(values.load, k)!r}{tail}")
        drop = f"(V({e.p})-V({e.n}))"
        lines.append(f"B_{e.name} {e.p} {e.n} I=V({e.name}_c)*tanh({drop}/{e.knee!r})")
    for k, e in enumerate(netlist.of(Switch)):
        tail = " " + _pwl(waves[e.name]) if e.name in waves else ""
        on, off = float(np.log(1.0 / e.ohms_on)), float(np.log(1.0 / e.ohms_off))
        lines.append(f"V_{e.name} {e.name}_c 0 DC {at(values.control, k)!r}{tail}")
        drop = f"(V({e.p})-V({e.n}))"
        law = f"exp({off!r}+({on - off!r})*V({e.name}_c))"
        lines.append(f"B_{e.name} {e.p} {e.n} I={drop}*{law}")
    return lines


def deck(
    title: str, lines: Sequence[str], control: Sequence[str], *, options: str = "", extra: str = ""
) -> str:
    """A complete input file.

    Args:
        title: first line.
        lines: element lines.
        control: commands of the control section; print results as `print name`.
        options: text after `.options`.
        extra: further dot lines, e.g. initial conditions.
    Returns:
        Text.
    """
    body = [title, *lines]
    if options:
        body.append(f".options {options}")
    if extra:
        body.append(extra)
    body += [".control", "set numdgt=14", *control, "quit", ".endc", ".end", ""]
    return "\n".join(body)


def sample_decks(
    title: str,
    netlist: Netlist,
    values: Values,
    control: Sequence[str],
    *,
    stretch: Float[np.ndarray, "2 m b"],
    model: str,
    waves: Mapping[str, Wave],
    own: Sequence[str] = (),
    options: str = "",
    extra: str = "",
) -> list[str]:
    """One deck per sample of a batch.

    Args:
        title: first line.
        netlist: the circuit as drawn.
        values: element values of the batch.
        control: commands of the control section.
        stretch: width and length of each transistor over what is drawn.
        model: "level1" or "ekv".
        waves: see `elements`.
        own: further element lines, before those of the netlist.
        options: text after `.options`.
        extra: further dot lines.
    Returns:
        Texts.
    """
    mosfets = netlist.of(Mosfet)
    width = np.array([[m.width] for m in mosfets]) * stretch[0]
    length = np.array([[m.length] for m in mosfets]) * stretch[1]

    def text(k: int) -> str:
        lines = elements(netlist, values, k, geometry=(width, length), model=model, waves=waves)
        return deck(title, [*own, *lines], control, options=options, extra=extra)

    return [text(k) for k in range(stretch.shape[2])]
