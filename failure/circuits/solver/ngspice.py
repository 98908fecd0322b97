"""ngspice as the trusted reference: write the netlist of one sample, run it, read the numbers.

Level 1 uses ngspice's own transistor (Meyer capacitances); "ekv" writes every transistor as a
behavioural current source with the capacitances of the JAX solver, so that the two programs solve
the same equations.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

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


class NgspiceError(RuntimeError):
    """ngspice is missing, ran out of time, failed, or printed no result."""


def available() -> bool:
    """Whether an `ngspice` executable is on the path."""
    return shutil.which("ngspice") is not None


def require() -> str:
    """Path of the executable.

    Raises:
        NgspiceError: not installed.
    """
    path = shutil.which("ngspice")
    if path is None:
        raise NgspiceError(
            "ngspice is not installed or not on PATH; install it (Debian, Ubuntu: "
            "apt-get install ngspice; conda: conda install -c conda-forge ngspice) or leave the "
            "ngspice check out"
        )
    return path


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


_NUMBER = re.compile(r"^\s*([\w().\[\]]+)\s*=\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*$")


def run(text: str, *, timeout: float = 60.0) -> dict[str, float]:
    """Run one deck and read every line `name = number`; the last one of a name wins.

    Args:
        text: the deck.
        timeout: limit [s].
    Returns:
        Numbers by name (lower case).
    Raises:
        NgspiceError: not installed, out of time, or ngspice reported an error.
    """
    path = require()
    with tempfile.TemporaryDirectory(prefix="ngspice_") as folder:
        file = Path(folder) / "deck.cir"
        file.write_text(text, encoding="utf-8")
        try:
            done = subprocess.run(
                [path, "-b", "-n", str(file)],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=timeout,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise NgspiceError(f"ngspice took more than {timeout} s; raise the limit") from error
    out = {}
    for line in done.stdout.splitlines():
        match = _NUMBER.match(line)
        if match:
            out[match[1].lower()] = float(match[2])
    if not out:
        tail = (done.stderr + done.stdout)[-400:].strip()
        raise NgspiceError(f"ngspice printed no result (exit status {done.returncode}): {tail}")
    return out


def run_many(
    decks: Sequence[str], names: Sequence[str], *, workers: int = 2, timeout: float = 60.0
) -> tuple[np.ndarray, np.ndarray]:
    """Run decks side by side.

    Args:
        decks: one text per sample.
        names: numbers to read from each.
        workers: processes at a time.
        timeout: limit of each [s].
    Returns:
        (numbers `[n, names]`, NaN where missing; status `[n]`, 1 where a run failed).
    Raises:
        NgspiceError: not installed.
    """
    require()

    def one(text: str) -> list[float]:
        try:
            found = run(text, timeout=timeout)
        except NgspiceError:
            found = {}
        return [found.get(n, float("nan")) for n in names]

    with ThreadPoolExecutor(max_workers=workers) as pool:
        numbers = np.array(list(pool.map(one, decks))).reshape(len(decks), len(names))
    return numbers, np.any(~np.isfinite(numbers), axis=1).astype(np.int32)
