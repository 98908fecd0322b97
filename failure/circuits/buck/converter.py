"""Buck converter of 22 transistors under variation of channel length and width.

Transistor level where transistors decide: the error amplifier by DC, the comparator, drivers and
power switches by one short transient through both edges. What these give (transconductance,
offset, delays, on resistances) goes into the cycle map of `cycle`.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from failure.circuits.buck.cycle import Stage, pwm_cycle, stage_matrix
from failure.circuits.protocol import Circuit, Spec, in_chunks
from failure.circuits.solver.mna import Values, nominal_values, source_current
from failure.circuits.solver.mosfet import NMOS, PMOS, mos_params
from failure.circuits.solver.netlist import CurrentSource, Mosfet, Netlist, VoltageSource
from failure.circuits.solver.solve import Grid, dc, grid, transient
from failure.circuits.solver.system import System, compile_netlist

__all__ = ["AMPLIFIER", "POWER", "SPECS", "make_dcdc", "solve_dcdc"]

V_DD, V_REF, V_BIAS = 2.5, 1.2, 0.72
INDUCTANCE, R_COIL, CAPACITANCE, R_ESR = 1e-6, 0.03, 10e-6, 0.03
R_COMP, R_ZERO, C_ZERO = 5e3, 20e3, 1e-12
LOAD_HEAVY, LOAD_LIGHT = 0.2, 0.1
"""Load before and after the step [A]."""

PERIOD = 250e-9
RAMP_LOW, RAMP_HIGH, RAMP_RISE, RAMP_TOP, RAMP_FALL = 0.8, 1.6, 235e-9, 7.5e-9, 7.5e-9
"""The ramp [V] and the lengths of its rise, its top and its fall [s]."""

N_BEFORE, N_AFTER = 100, 60
"""Periods before and after the load step."""

QUANTITIES = (("length", "relative", 0.01), ("width", "relative", 0.01))

SPECS = (
    Spec("output_accuracy", "V", "max", "distance of the mean output from the reference, 0.2 A"),
    Spec("overshoot", "V", "max", "peak of the output after the load step, over the reference"),
)


def _n(name: str, d: str, g: str, s: str, width: int | float, length: float = 0.35) -> Mosfet:
    return Mosfet(name, d, g, s, "0", NMOS, width * 1e-6, length * 1e-6)


def _p(name: str, d: str, g: str, s: str, width: int | float, length: float = 0.35) -> Mosfet:
    return Mosfet(name, d, g, s, "vdd", PMOS, width * 1e-6, length * 1e-6)


AMPLIFIER_MOSFETS = (
    _n("MA1", "ea1", "fb", "et", 20, 0.5),
    _n("MA2", "comp", "ref", "et", 20, 0.5),
    _p("MA3", "ea1", "ea1", "vdd", 20, 0.5),
    _p("MA4", "comp", "ea1", "vdd", 20, 0.5),
    _n("MA5", "et", "nb", "0", 20, 0.5),
)
POWER_MOSFETS = (
    _n("MC1", "c1", "comp", "ct", 20),
    _n("MC2", "c2", "ramp", "ct", 20),
    _p("MC3", "c1", "c1", "vdd", 16),
    _p("MC4", "c2", "c1", "vdd", 16),
    _n("MC5", "ct", "nb", "0", 60, 0.5),
    _p("MC6", "c3", "c2", "vdd", 40),
    _n("MC7", "c3", "nb", "0", 40, 0.5),
    _p("MC8", "pw", "c3", "vdd", 24),
    _n("MC9", "pw", "c3", "0", 10),
    _p("MD1", "gp", "dx", "vdd", 400),
    _n("MD2", "gp", "dx", "0", 160),
    _p("MD3", "gn", "dx", "vdd", 160),
    _n("MD4", "gn", "dx", "0", 160),
    _p("MD5", "dx", "pw", "vdd", 80),
    _n("MD6", "dx", "pw", "0", 32),
    _p("MSP", "sw", "gp", "vdd", 20000),
    _n("MSN", "sw", "gn", "0", 10000),
)
MOSFETS = (*AMPLIFIER_MOSFETS, *POWER_MOSFETS)

_SUPPLIES = (VoltageSource("Vdd", "vdd", "0", V_DD), VoltageSource("Vnb", "nb", "0", V_BIAS))

V_COMP = 1.24
"""Compensator voltage about which the blocks are measured [V]."""

AMPLIFIER = Netlist(
    "error amplifier",
    (
        *_SUPPLIES,
        VoltageSource("Vref", "ref", "0", V_REF),
        VoltageSource("Vfb", "fb", "0", V_REF),
        VoltageSource("Vcomp", "comp", "0", V_COMP),
        *AMPLIFIER_MOSFETS,
    ),
)
POWER = Netlist(
    "comparator, drivers, switches",
    (
        *_SUPPLIES,
        VoltageSource("Vcomp", "comp", "0", V_COMP),
        VoltageSource("Vramp", "ramp", "0", V_COMP - 0.05),
        CurrentSource("IL", "sw", "0", 0.12),
        *POWER_MOSFETS,
    ),
)

RAMP_SLOPE = (RAMP_HIGH - RAMP_LOW) / RAMP_RISE
_T1, _T2, _T3, _T4, _T5 = 30e-9, 32e-9, 34e-9, 41.5e-9, 46e-9
"""Edge test: slow rise through V_COMP, quick rise to the top, top, fall, settled."""
_EDGE_T = (0.0, _T1, _T2, _T3, _T4, _T5)
_EDGE_V = (
    V_COMP - 15e-9 * RAMP_SLOPE,
    V_COMP + 15e-9 * RAMP_SLOPE,
    RAMP_HIGH,
    RAMP_HIGH,
    RAMP_LOW,
    RAMP_LOW,
)
_VALLEY, _PEAK = 0.12, 0.28
"""Inductor current at the two edges under the heavy load [A]."""


def edge_grid(refine: int = 1) -> Grid:
    """Grid of the edge test; `refine` divides every step.

    Where nothing switches the steps are backward Euler: the trapezoidal rule would carry the
    ringing of an edge through the plateau, at whose end the on resistance is read.
    """
    pieces = (
        (0.0, 8e-9, 6, True),
        (8e-9, 26e-9, 180, False),
        (26e-9, _T1, 4, True),
        (_T1, _T3, 8, True),
        (_T3, _T4 + 1e-9, 120, False),
        (_T4 + 1e-9, _T5, 12, True),
    )
    joined = grid(*((start, end, n * refine, 1.0) for start, end, n, _ in pieces))
    euler = np.concatenate([np.full(n * refine, slow) for _, _, n, slow in pieces])
    return joined._replace(euler=euler)


def variation(system: System, mosfets: tuple[Mosfet, ...], u: Float[Array, "k 2 b"]) -> Values:
    """Element values of a block; `u` in sigma: length, width of each transistor."""

    def column(values: list[float]) -> Array:
        return jnp.array(values, u.dtype).reshape(-1, 1)

    ones = jnp.ones_like(u[:, 0])
    mos = mos_params(
        column([m.process.polarity for m in mosfets]) * ones,
        column([m.process.mobility for m in mosfets]),
        column([m.process.early for m in mosfets]),
        column([m.process.overlap for m in mosfets]),
        width=column([m.width for m in mosfets]) * (1.0 + QUANTITIES[1][2] * u[:, 1]),
        length=column([m.length for m in mosfets]) * (1.0 + QUANTITIES[0][2] * u[:, 0]),
        vto=column([m.process.vto for m in mosfets]) * ones,
        tox=column([m.process.tox for m in mosfets]),
    )
    return nominal_values(system)._replace(mos=mos)


class Amplifier(NamedTuple):
    """Error amplifier about its working point; leaves `[b]`."""

    i_offset: Float[Array, "b"]
    gm: Float[Array, "b"]
    go: Float[Array, "b"]
    status: Int[Array, "b"]


@lru_cache(maxsize=4)
def _systems(model: str) -> tuple[System, System]:
    return compile_netlist(AMPLIFIER, model), compile_netlist(POWER, model)


def amplifier(u: Float[Array, "5 2 b"], *, model: str = "ekv") -> Amplifier:
    """Offset current, transconductance and output conductance by three DC points.

    Args:
        u: parameters of the five transistors in sigma.
        model: MOSFET model.
    Returns:
        Amplifier.
    """
    system, _ = _systems(model)
    batch = u.shape[-1]
    values = variation(system, AMPLIFIER_MOSFETS, jnp.tile(u, (1, 1, 3)))
    d_fb, d_comp = 10e-3, 30e-3
    shift = np.zeros((5, 3))
    shift[3, 1], shift[4, 2] = d_fb, d_comp
    volts = values.volts + jnp.asarray(np.repeat(shift, batch, axis=1), u.dtype)
    values = values._replace(volts=volts)
    start = jnp.full((system.n, 1), 0.5, u.dtype).at[system.index("ea1")].set(1.7)
    solution = dc(system, values, start)
    # The source holds the output, so what it delivers is minus the current of the amplifier.
    i = -source_current(system, solution.v, values, "Vcomp").reshape(3, batch)
    status = jnp.max(solution.status.reshape(3, batch), axis=0)
    return Amplifier(i[0], (i[1] - i[0]) / d_fb, -(i[2] - i[0]) / d_comp, status)


class Edges(NamedTuple):
    """What the short transient through both edges gives; leaves `[b]`."""

    rise: Float[Array, "b"]
    """From the meeting of ramp and compensator voltage to the rise of the node [s]."""
    fall: Float[Array, "b"]
    """From the start of the ramp's fall to the fall of the node, compensator at `V_COMP` [s]."""
    r_high: Float[Array, "b"]
    r_low: Float[Array, "b"]
    status: Int[Array, "b"]


def edges(u: Float[Array, "17 2 b"], *, model: str = "ekv", refine: int = 1) -> Edges:
    """Delays and on resistances by a transient of comparator, drivers and switches.

    The instant of an edge is that of the ideal step with the same volt-seconds.

    Args:
        u: parameters of the 17 transistors in sigma.
        model: MOSFET model.
        refine: divides every time step.
    Returns:
        Edges.
    """
    _, system = _systems(model)
    time = edge_grid(refine)
    values = variation(system, POWER_MOSFETS, u)
    ramp = np.interp(time.t, _EDGE_T, _EDGE_V)
    coil = np.interp(time.t, [_T1, _T3], [_VALLEY, _PEAK])
    row = [v.name for v in POWER.of(VoltageSource)].index("Vramp")
    first = values._replace(volts=values.volts.at[row].set(float(ramp[0])))
    start = dc(system, first)
    waves = {
        "Vramp": jnp.asarray(ramp, u.dtype).reshape(-1, 1),
        "IL": jnp.asarray(coil, u.dtype).reshape(-1, 1),
    }
    (sw,), end = transient(system, first, start, time, waves, probes=("sw",))
    at_rise = int(np.searchsorted(time.t, _T1 - 1e-15))
    at_fall = int(np.searchsorted(time.t, _T3 - 1e-15))
    h = jnp.asarray(np.diff(time.t), u.dtype)[:, None]
    mean = 0.5 * (sw[1:] + sw[:-1]) * h
    low, high, top, bottom = sw[0], sw[at_rise], sw[at_fall], sw[-1]
    area = jnp.sum(mean[:at_rise], axis=0)
    rise = _T1 - (area - low * _T1) / (high - low) - 15e-9
    length = float(time.t[-1] - time.t[at_fall])
    fall = (jnp.sum(mean[at_fall:], axis=0) - bottom * length) / (top - bottom)
    return Edges(rise, fall, (V_DD - top) / _PEAK, -bottom / _PEAK, end.status)


def solve_dcdc(
    x: Float[Array, "d b"], *, model: str = "ekv", refine: int = 1, points: int = 8
) -> tuple[Float[Array, "m b"], Int[Array, "b"]]:
    """Specifications of a batch of samples, batch last.

    Args:
        x: parameters in sigma, transistor-major (length, width).
        model: MOSFET model.
        refine: divides the time steps of the edge transient.
        points: output samples in each half period.
    Returns:
        (specs `[2, b]` in the order of `SPECS`, status `[b]`).
    """
    batch = x.shape[-1]
    u = x.reshape(len(MOSFETS), 2, batch)
    n_amp = len(AMPLIFIER_MOSFETS)
    amp = amplifier(u[:n_amp], model=model)
    edge = edges(u[n_amp:], model=model, refine=refine)
    one = jnp.ones((batch,), x.dtype)
    stage = Stage(
        INDUCTANCE * one, CAPACITANCE * one, R_COIL * one, R_ESR * one, R_COMP * one,
        R_ZERO * one, C_ZERO * one, amp.gm, amp.go, amp.i_offset, V_REF * one, V_COMP * one,
    )  # fmt: skip
    # The period runs from fall to fall; the ramp starts this long after the fall.
    t_ramp = PERIOD - (RAMP_RISE + RAMP_TOP + edge.fall)

    def periods(carry: tuple, load: float, count: int) -> tuple[tuple, tuple]:
        low = stage_matrix(stage, 0.0 * one, edge.r_low, load * one)
        high = stage_matrix(stage, V_DD * one, edge.r_high, load * one)

        def one_period(carry: tuple, _: None) -> tuple[tuple, tuple]:
            state, t = carry
            state, t, peak = pwm_cycle(
                state, t, low, high,
                ramp_start=RAMP_LOW * one, ramp_slope=RAMP_SLOPE, t_ramp=t_ramp,
                delay=edge.rise, period=PERIOD, points=points,
            )  # fmt: skip
            return (state, t), (state[3], peak)

        return jax.lax.scan(one_period, carry, None, length=count)

    start = jnp.stack([0.2 * one, V_REF * one, (V_COMP - V_REF) * one, 0.0 * one, one])
    carry, (integral, _) = periods((start, 0.5 * PERIOD * one), LOAD_HEAVY, N_BEFORE)
    mean = (integral[-1] - integral[-1 - 8]) / (8 * PERIOD)
    _, (_, peak) = periods(carry, LOAD_LIGHT, N_AFTER)
    specs = jnp.stack([jnp.abs(mean - V_REF), jnp.max(peak, axis=0) - V_REF])
    status = jnp.maximum(amp.status, edge.status)
    return specs, jnp.where(jnp.all(jnp.isfinite(specs), axis=0), status, 1)


def _run(x: Float[Array, "n d"], *, model: str) -> tuple[Array, Array]:
    return in_chunks(partial(solve_dcdc, model=model), x)


@lru_cache(maxsize=4)
def make_dcdc(model: str = "ekv") -> Circuit:
    """The buck converter: 44 parameters, output accuracy and overshoot.

    Args:
        model: MOSFET model, "ekv" (smooth, default) or "level1".
    Returns:
        Circuit.
    """
    from failure.circuits.buck.reference import dcdc_reference

    return Circuit(
        name="dcdc" if model == "ekv" else f"dcdc_{model}",
        parameter_names=tuple((m.name, q) for m in MOSFETS for q, _, _ in QUANTITIES),
        sigma=tuple(s for _ in MOSFETS for _, _, s in QUANTITIES),
        parameter_units=tuple(u for _ in MOSFETS for _, u, _ in QUANTITIES),
        specs=SPECS,
        run=partial(_run, model=model),
        reference=dcdc_reference,
    )
