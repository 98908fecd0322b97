"""The buck converter at light load: pulse-frequency modulation by an event-driven cycle map.

The output falls until the comparator finds it below the reference; the high side then conducts for
a fixed time, the low side until the coil current is nearly gone, and both stay open until the next
trip. Transistors decide the trip voltage of the comparator (one DC solve with the loop closed
around it), the delays and the on resistances (the transient of `converter.edges`); between events
the circuit is linear and moves by its matrix exponential.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from failure.circuits.buck import converter
from failure.circuits.buck.cycle import expm, until, walk
from failure.circuits.protocol import Circuit, Spec, in_chunks
from failure.circuits.solver.netlist import Mosfet, Netlist, VoltageSource
from failure.circuits.solver.solve import dc
from failure.circuits.solver.system import System, compile_netlist

__all__ = [
    "COMPARATOR",
    "SPECS",
    "Pulse",
    "make_dcdc_light",
    "pfm_cycle",
    "solve_dcdc_light",
    "trip_offset",
]

LOAD = 10e-3
"""Light load [A]."""

T_ON = 150e-9
"""What the timer of a pulse asks for [s]."""

V_ZERO = 2e-3
"""Drop over the low side at which its zero-current detector trips [V]."""

V_DIODE = 0.7
"""Forward voltage of the body diodes, which carry what current is left [V]."""

N_PULSES = 3
"""Pulses that are computed; the first starts anywhere, every later one is alike."""

SPECS = (
    Spec("light_load_accuracy", "V", "max", "distance of the mean output from the reference"),
    Spec("light_load_ripple", "V", "max", "output, largest less smallest within a pulse period"),
)

_IN_LOOP = ("MC1", "MC2", "MC3", "MC4", "MC5", "MC6", "MC7", "MC8", "MC9", "MD5", "MD6")
LOOP_MOSFETS: tuple[Mosfet, ...] = tuple(m for m in converter.MOSFETS if m.name in _IN_LOOP)

COMPARATOR = Netlist(
    "comparator of the pulse-frequency mode",
    (
        VoltageSource("Vdd", "vdd", "0", converter.V_DD),
        VoltageSource("Vnb", "nb", "0", converter.V_BIAS),
        VoltageSource("Vramp", "ramp", "0", converter.V_REF),
        # Closes the loop: the input settles where the output is half way, which is the trip.
        VoltageSource("Vloop", "comp", "dx", converter.V_REF - 0.5 * converter.V_DD),
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
        found = jax.jit(lambda: dc(system, converter.variation(system, LOOP_MOSFETS, u), start))()
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
    found = dc(system, converter.variation(system, LOOP_MOSFETS, u), jnp.asarray(nominal))
    return converter.V_REF - found.v[system.index("comp")], found.status


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
    out = jnp.stack([converter.R_ESR * one, one, zero, -converter.R_ESR * load])
    coil = jnp.stack([-(r_switch + converter.R_COIL), zero, zero, v_switch]) - out
    cap = jnp.stack([one, zero, zero, -load])
    rows = [coil / converter.INDUCTANCE, cap / converter.CAPACITANCE, out, jnp.zeros_like(out)]
    return jnp.stack(rows), out


def pfm_cycle(
    v: Float[Array, "b"], pulse: Pulse, *, points: int = 8
) -> tuple[Float[Array, "b"], Float[Array, "b"], Float[Array, "b"]]:
    """One period, from the moment both switches are open and the coil is empty to the next such.

    Args:
        v: voltage of the output capacitor.
        pulse: Pulse.
        points: samples of the output in each of the two conducting segments.
    Returns:
        (capacitor voltage at the end, mean output, largest less smallest output).
    """
    load = pulse.load
    zero, one = jnp.zeros_like(v), jnp.ones_like(v)
    # Open: the load empties the capacitor at a constant rate.
    out = v - converter.R_ESR * load
    rate = load / converter.CAPACITANCE
    t_open = jnp.maximum((out - pulse.v_trip) / rate, 0.0) + pulse.delay
    lowest = out - rate * t_open
    area = 0.5 * (out + lowest) * t_open
    x = jnp.stack([zero, v - rate * t_open, area, one])
    # High side, for the time of the timer.
    high, row = _matrix(converter.V_DD * one, pulse.r_high, load)
    x, first = walk(x, high, row, pulse.t_on, points)
    # Low side, until the drop over it says that the current is nearly gone, and the delay.
    low, _ = _matrix(zero, pulse.r_low, load)
    small = jnp.stack([one, zero, zero, -V_ZERO / pulse.r_low])
    fall = x[1] / converter.INDUCTANCE
    t_low = until(x, low, small, jnp.maximum(x[0] - V_ZERO / pulse.r_low, 0.0) / fall) + pulse.delay
    x, second = walk(x, low, row, t_low, points)
    # Both open with a little current left: a body diode takes it, to ground or to the supply.
    v_diode = jnp.where(x[0] > 0.0, -V_DIODE, converter.V_DD + V_DIODE)
    diode, _ = _matrix(v_diode, zero, load)
    current = jnp.stack([one, zero, zero, zero])
    t_diode = until(x, diode, current, converter.INDUCTANCE * x[0] / (x[1] - v_diode), iterations=2)
    x = jnp.sum(expm(diode * t_diode[None, None]) * x[None], axis=1)
    period = t_open + pulse.t_on + t_low + t_diode
    return x[1], x[2] / period, jnp.maximum(first, second) - lowest


def solve_dcdc_light(
    x: Float[Array, "d b"], *, model: str = "ekv", refine: int = 1, points: int = 8
) -> tuple[Float[Array, "m b"], Int[Array, "b"]]:
    """Specifications of a batch of samples, batch last.

    Args:
        x: parameters in sigma, transistor-major (length, width), as for the PWM mode.
        model: MOSFET model.
        refine: divides the time steps of the edge transient.
        points: output samples in each conducting segment.
    Returns:
        (specs `[2, b]` in the order of `SPECS`, status `[b]`).
    """
    u = x.reshape(len(converter.MOSFETS), 2, x.shape[-1])
    chosen = np.array([k for k, m in enumerate(converter.MOSFETS) if m.name in _IN_LOOP])
    offset, status = trip_offset(u[chosen], model=model)
    edge = converter.edges(u[len(converter.AMPLIFIER_MOSFETS) :], model=model, refine=refine)
    # The ramp of the edge test needs offset / slope longer than a comparator without offset.
    delay = edge.rise - offset / converter.RAMP_SLOPE
    one = jnp.ones_like(offset)
    pulse = Pulse(
        v_trip=converter.V_REF - offset,
        delay=delay,
        t_on=T_ON + edge.fall - delay,
        r_high=edge.r_high,
        r_low=edge.r_low,
        load=LOAD * one,
    )
    v = (converter.V_REF + 2e-3) * one
    mean, ripple = v, v
    for _ in range(N_PULSES):
        v, mean, ripple = pfm_cycle(v, pulse, points=points)
    specs = jnp.stack([jnp.abs(mean - converter.V_REF), ripple])
    status = jnp.maximum(status, edge.status)
    return specs, jnp.where(jnp.all(jnp.isfinite(specs), axis=0), status, 1)


def _run(x: Float[Array, "n d"], *, model: str) -> tuple[Array, Array]:
    return in_chunks(partial(solve_dcdc_light, model=model), x)


def _no_reference(x: np.ndarray, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    raise ValueError(
        "circuit 'dcdc_light' has no ngspice reference: its controller is an ideal state machine; "
        "its comparator and edges are those of 'dcdc', which has one"
    )


@lru_cache(maxsize=4)
def make_dcdc_light(model: str = "ekv") -> Circuit:
    """The buck converter in pulse-frequency mode: 44 parameters, accuracy and ripple at 10 mA.

    Args:
        model: MOSFET model, "ekv" (smooth, default) or "level1".
    Returns:
        Circuit.
    """
    return Circuit(
        name="dcdc_light" if model == "ekv" else f"dcdc_light_{model}",
        parameter_names=tuple(
            (m.name, q) for m in converter.MOSFETS for q, _, _ in converter.QUANTITIES
        ),
        sigma=tuple(s for _ in converter.MOSFETS for _, _, s in converter.QUANTITIES),
        parameter_units=tuple(u for _ in converter.MOSFETS for _, u, _ in converter.QUANTITIES),
        specs=SPECS,
        run=partial(_run, model=model),
        reference=_no_reference,
    )
