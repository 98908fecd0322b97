"""The buck converter at light load: pulse-frequency modulation by an event-driven cycle map.

The output falls until the comparator finds it below the reference; the high side then conducts for
a fixed time, the low side until the coil current is nearly gone, and both stay open until the next
trip. Transistors decide the trip voltage of the comparator (one DC solve with the loop closed
around it), the delays and the on resistances (the transient of `blocks.edges`); between events
the circuit is linear and moves by its matrix exponential.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from failure.circuits.buck import schematic
from failure.circuits.buck.blocks import edges
from failure.circuits.buck.cycle import expm, until, walk
from failure.circuits.protocol import Spec
from failure.circuits.solver.netlist import Mosfet, Netlist, VoltageSource
from failure.circuits.solver.newton import dc
from failure.circuits.solver.system import System, compile_netlist
from failure.status import Status

LOAD = 10e-3
"""Light load [A]."""

T_ON = 150e-9
"""What the timer of a pulse asks for [s]."""

V_ZERO = 2e-3
"""Drop over the low side at which its zero-current detector trips [V]."""

V_DIODE = 0.7
"""Forward voltage of the body diodes, which carry what current is left [V]."""

N_PULSES = 3
"""Pulses that are computed; the first starts just above the trip, every later one is alike."""

SPECS = (
    Spec("light_load_accuracy", "V", "max", "distance of the mean output from the reference"),
    Spec("light_load_ripple", "V", "max", "output, largest less smallest within a pulse period"),
)

_IN_LOOP = ("MC1", "MC2", "MC3", "MC4", "MC5", "MC6", "MC7", "MC8", "MC9", "MD5", "MD6")
LOOP_MOSFETS: tuple[Mosfet, ...] = tuple(m for m in schematic.MOSFETS if m.name in _IN_LOOP)

COMPARATOR = Netlist(
    "comparator of the pulse-frequency mode",
    (
        VoltageSource("Vdd", "vdd", "0", schematic.V_DD),
        VoltageSource("Vnb", "nb", "0", schematic.V_BIAS),
        VoltageSource("Vramp", "ramp", "0", schematic.V_REF),
        # Closes the loop: the input settles where the output is half way, which is the trip.
        VoltageSource("Vloop", "comp", "dx", schematic.V_REF - 0.5 * schematic.V_DD),
        *LOOP_MOSFETS,
    ),
)


@lru_cache(maxsize=4)
def _comparator(model: str) -> tuple[System, np.ndarray]:
    """Compiled comparator and its nominal operating point, where Newton starts."""
    system = compile_netlist(COMPARATOR, model)
    with jax.ensure_compile_time_eval(), jax.enable_x64(True):
        u = jnp.zeros((len(LOOP_MOSFETS), 2, 1))
        start = jnp.full((system.n, 1), 1.2).at[system.n_nodes :].set(0.0)
        found = jax.jit(lambda: dc(system, schematic.variation(system, LOOP_MOSFETS, u), start))()
        nominal, status = np.asarray(found.v), np.asarray(found.status)
    if status[0]:
        raise RuntimeError(f"{COMPARATOR.title}: the nominal circuit has no operating point")
    return system, nominal


def trip_offset(
    u: Float[Array, "11 2 b"], *, model: str = "ekv"
) -> tuple[Float[Array, "b"], Int[Array, "b"]]:
    """By how much the feedback input lies below the reference when the comparator trips.

    Args:
        u: parameters of the comparator's transistors (`LOOP_MOSFETS`) in sigma.
        model: MOSFET model.
    Returns:
        (offset [V], status).
    """
    system, nominal = _comparator(model)
    found = dc(system, schematic.variation(system, LOOP_MOSFETS, u), jnp.asarray(nominal))
    return schematic.V_REF - found.v[system.index("comp")], found.status


class Pulse(NamedTuple):
    """What a pulse depends on; leaves `[b]`, volts, seconds, ohms, amperes."""

    v_trip: Float[Array, "b"]
    """Output at which the comparator trips."""
    delay: Float[Array, "b"]
    """From a trip, of the comparator or of the zero-current detector, to the switching node."""
    t_on: Float[Array, "b"]
    """How long the node is high."""
    r_high: Float[Array, "b"]
    r_low: Float[Array, "b"]
    load: Float[Array, "b"]


def _matrix(
    v_switch: Float[Array, "b"], r_switch: Float[Array, "b"], load: Float[Array, "b"]
) -> tuple[Float[Array, "4 4 b"], Float[Array, "4 b"]]:
    r"""Generator of (coil current, capacitor voltage, integral of output, 1); row of the output.

    .. math:: L \dot i = v_s - (R_s + R_L) i - v_o, \quad C \dot v_C = i - I, \quad
        v_o = v_C + R_e (i - I)
    """
    zero, one = jnp.zeros_like(load), jnp.ones_like(load)
    out = jnp.stack([schematic.R_ESR * one, one, zero, -schematic.R_ESR * load])
    coil = jnp.stack([-(r_switch + schematic.R_COIL), zero, zero, v_switch]) - out
    cap = jnp.stack([one, zero, zero, -load])
    rows = [coil / schematic.INDUCTANCE, cap / schematic.CAPACITANCE, out, jnp.zeros_like(out)]
    return jnp.stack(rows), out


def pfm_cycle(
    pulse: Pulse, v: Float[Array, "b"], *, points: int = 8
) -> tuple[Float[Array, "b"], Float[Array, "b"], Float[Array, "b"]]:
    """One period, from the moment both switches are open and the coil is empty to the next such.

    Args:
        pulse: Pulse.
        v: voltage of the output capacitor.
        points: samples of the output in each of the two conducting segments.
    Returns:
        (capacitor voltage at the end, mean output, largest less smallest output).
    """
    load = pulse.load
    zero, one = jnp.zeros_like(v), jnp.ones_like(v)
    # Open: the load empties the capacitor at a constant rate.
    out = v - schematic.R_ESR * load
    rate = load / schematic.CAPACITANCE
    t_open = jnp.maximum((out - pulse.v_trip) / rate, 0.0) + pulse.delay
    lowest = out - rate * t_open
    area = 0.5 * (out + lowest) * t_open
    x = jnp.stack([zero, v - rate * t_open, area, one])
    # High side, for the time of the timer.
    high, row = _matrix(schematic.V_DD * one, pulse.r_high, load)
    x, first = walk(high, row, x, pulse.t_on, points=points)
    # Low side, until the drop over it says that the current is nearly gone, and the delay.
    low, _ = _matrix(zero, pulse.r_low, load)
    small = jnp.stack([one, zero, zero, -V_ZERO / pulse.r_low])
    fall = x[1] / schematic.INDUCTANCE
    t_low = until(low, small, x, jnp.maximum(x[0] - V_ZERO / pulse.r_low, 0.0) / fall) + pulse.delay
    x, second = walk(low, row, x, t_low, points=points)
    # Both open with a little current left: a body diode takes it, to ground or to the supply.
    v_diode = jnp.where(x[0] > 0.0, -V_DIODE, schematic.V_DD + V_DIODE)
    diode, _ = _matrix(v_diode, zero, load)
    current = jnp.stack([one, zero, zero, zero])
    t_diode = until(diode, current, x, schematic.INDUCTANCE * x[0] / (x[1] - v_diode), iterations=2)
    x = jnp.sum(expm(diode * t_diode[None, None]) * x[None], axis=1)
    period = t_open + pulse.t_on + t_low + t_diode
    return x[1], x[2] / period, jnp.maximum(first, second) - lowest


def solve_dcdc_light(
    x: Float[Array, "d b"],
    *,
    model: str = "ekv",
    refine: int = 1,
    points: int = 8,
    load: float | Float[Array, ""] = LOAD,
) -> tuple[Float[Array, "m b"], Int[Array, "b"]]:
    """Specifications of a batch of samples, batch last.

    Args:
        x: parameters in sigma, transistor-major (length, width), as for the PWM mode.
        model: MOSFET model.
        refine: divides the time steps of the edge transient.
        points: output samples in each conducting segment.
        load: [A].
    Returns:
        (specs `[2, b]` in the order of `SPECS`, status `[b]`).
    """
    u = x.reshape(len(schematic.MOSFETS), 2, x.shape[-1])
    chosen = np.array([k for k, m in enumerate(schematic.MOSFETS) if m.name in _IN_LOOP])
    offset, status = trip_offset(u[chosen], model=model)
    edge = edges(u[len(schematic.AMPLIFIER_MOSFETS) :], model=model, refine=refine)
    # The ramp of the edge test needs offset / slope longer than a comparator without offset.
    delay = edge.rise - offset / schematic.RAMP_SLOPE
    one = jnp.ones_like(offset)
    pulse = Pulse(
        v_trip=schematic.V_REF - offset,
        delay=delay,
        t_on=T_ON + edge.fall - delay,
        r_high=edge.r_high,
        r_low=edge.r_low,
        load=load * one,
    )
    # Beside the steady state: from far below the trip a pulse does not reach it.
    v = pulse.v_trip + 2e-3
    mean, ripple = v, v
    for _ in range(N_PULSES):
        v, mean, ripple = pfm_cycle(pulse, v, points=points)
    specs = jnp.stack([jnp.abs(mean - schematic.V_REF), ripple])
    status = jnp.maximum(status, edge.status)
    return specs, jnp.where(jnp.all(jnp.isfinite(specs), axis=0), status, Status.NOT_FINITE)
