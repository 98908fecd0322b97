"""Low-dropout regulator of 20 transistors under variation of length, threshold and oxide."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from failure.circuits.protocol import Spec
from failure.circuits.solver.mna import source_current
from failure.circuits.solver.mosfet import NMOS, PMOS, mos_params
from failure.circuits.solver.netlist import (
    Capacitor,
    CurrentSource,
    Load,
    Mosfet,
    Netlist,
    Resistor,
    VoltageSource,
)
from failure.circuits.solver.newton import dc
from failure.circuits.solver.system import System, compile_netlist
from failure.circuits.solver.transient import Grid, grid, transient
from failure.circuits.solver.values import Values, nominal_values
from failure.status import Status

KNEE = 1.0
"""Voltage scale of the load [V]: it draws `amps * tanh(v / KNEE)`, less as the output falls."""

I_LIGHT = 1e-3 / math.tanh(1.0 / KNEE)
I_HEAVY = 150e-3 / math.tanh(1.0 / KNEE)
"""Load before and after the step [A]: 1 mA and 150 mA at 1 V."""

T_STEP, T_RISE, T_END = 10e-9, 1e-9, 120e-9
"""Start and length of the load step, end of the transient [s]."""

T_DAMPED = 40e-9
"""From here on the steps of the shipped grid are longer than 4 ns [s]."""

QUANTITIES = (("length", "relative", 0.01), ("vth", "V", 5e-3), ("tox", "relative", 0.007))
"""Varied quantities of each transistor: name, unit of sigma, sigma."""

SPECS = (
    Spec("quiescent_current", "A", "max", "supply current at the light load, load excluded"),
    Spec("undershoot", "V", "max", "output before the load step less its minimum after it"),
    Spec("load_regulation", "%", "max", "fall of the output from light to heavy load, DC"),
)


def _n(name: str, d: str, g: str, s: str, width: int | float, length: float) -> Mosfet:
    return Mosfet(name, d, g, s, "0", NMOS, width * 1e-6, length * 1e-6)


def _p(name: str, d: str, g: str, s: str, width: int | float, length: float) -> Mosfet:
    return Mosfet(name, d, g, s, "vin", PMOS, width * 1e-6, length * 1e-6)


NETLIST = Netlist(
    "LDO",
    (
        VoltageSource("Vin", "vin", "0", 2.2),
        VoltageSource("Vref", "ref", "0", 1.0),
        CurrentSource("Iref", "vin", "nb", 150e-6),
        # Bias: reference diode, tail, p-side mirror, source of the buffer, keepers of the output.
        _n("MB1", "nb", "nb", "0", 27, 0.5),
        _n("MB2", "tail", "nb", "0", 280, 0.5),
        _n("MB3", "pb", "nb", "0", 27, 0.5),
        _p("MB4", "pb", "pb", "vin", 80, 0.5),
        _p("MB5", "gp", "pb", "vin", 820, 0.5),
        _n("MB6", "out", "x", "0", 40, 0.5),
        _n("MB7", "out", "nb", "0", 54, 0.5),
        # Error amplifier: current-mirror OTA, output loaded by two diodes.
        _n("M1", "d1", "out", "tail", 60, 0.35),
        _n("M2", "d2", "ref", "tail", 60, 0.35),
        _p("M3", "d1", "d1", "vin", 200, 0.35),
        _p("M4", "d2", "d2", "vin", 200, 0.35),
        _p("M5", "ga", "d1", "vin", 400, 0.35),
        _p("M6", "d7", "d2", "vin", 400, 0.35),
        _n("M7", "d7", "d7", "0", 200, 0.35),
        _n("M8", "ga", "d7", "0", 200, 0.35),
        _p("M9", "ga", "ga", "vin", 20, 0.35),
        _n("M10", "ga", "ga", "0", 4, 0.35),
        # Follower buffer, its current sensed by M13 and turned into a pull-down at the output.
        _p("M11", "x", "ga", "gp", 1500, 0.35),
        _n("M13", "x", "x", "0", 200, 0.5),
        _p("MP", "out", "gp", "vin", 6000, 0.35),
        Capacitor("Cout", "out", "oesr", 0.4e-9),
        Resistor("Resr", "oesr", "0", 0.1),
        Load("Bload", "out", "0", I_LIGHT, KNEE),
    ),
)


def time_grid(refine: int = 1) -> Grid:
    """Grid of the transient; `refine` divides every step.

    From `T_DAMPED` on the steps are backward Euler: some samples ring, and the trapezoidal rule
    turns a ringing that the long last steps cannot follow into a growing one.
    """
    joined = grid(
        (0.0, T_STEP, 1, 1.0),
        (T_STEP, T_STEP + T_RISE, 8 * refine, 1.0),
        (T_STEP + T_RISE, 14e-9, 24 * refine, 2.0),
        (14e-9, T_END, 20 * refine, 20.0),
    )
    return joined._replace(euler=joined.t[1:] > T_DAMPED)


TIME: Grid = time_grid()
"""Grid of the transient: finest in the load step and in the dip after it."""


FINE: Grid = time_grid(8)
"""Grid for the few samples whose dip the other one does not resolve."""

RESOLVED = 2e-3
"""Largest error of the minimum between two steps that is taken for resolved [V]."""


class _Setup(NamedTuple):
    system: System
    light: np.ndarray
    heavy: np.ndarray


def variation(
    system: System, x: Float[Array, "d b"], sigmas: tuple[float, float, float] | None = None
) -> Values:
    """Element values of samples given in sigma, transistor-major `(length, vth, tox)`."""
    sigma_l, sigma_v, sigma_t = sigmas or tuple(s for _, _, s in QUANTITIES)
    mosfets = system.netlist.of(Mosfet)
    u = x.reshape(len(mosfets), 3, x.shape[-1])

    def column(values: list[float]) -> Array:
        return jnp.array(values, x.dtype).reshape(-1, 1)

    mos = mos_params(
        column([m.process.polarity for m in mosfets]),
        column([m.process.mobility for m in mosfets]),
        column([m.process.early for m in mosfets]),
        column([m.process.overlap for m in mosfets]),
        width=column([m.width for m in mosfets]),
        length=column([m.length for m in mosfets]) * (1.0 + sigma_l * u[:, 0]),
        vto=column([m.process.vto for m in mosfets]) + sigma_v * u[:, 1],
        tox=column([m.process.tox for m in mosfets]) * (1.0 + sigma_t * u[:, 2]),
    )
    return nominal_values(system)._replace(mos=mos)


def _loaded(values: Values, amps: float) -> Values:
    return values._replace(load=jnp.full_like(values.load, amps))


@lru_cache(maxsize=8)
def _setup(model: str, netlist: Netlist = NETLIST) -> _Setup:
    """Compiled netlist and its nominal operating points, where Newton starts."""
    system = compile_netlist(netlist, model)
    with jax.ensure_compile_time_eval(), jax.enable_x64(True):
        values = nominal_values(system)

        @jax.jit
        def points() -> tuple[Array, Array, Array]:
            light = dc(system, _loaded(values, I_LIGHT))
            heavy = dc(system, _loaded(values, I_HEAVY), light.v)
            return light.v, heavy.v, light.status + heavy.status

        light, heavy, status = (np.asarray(a) for a in points())
    if status[0]:
        raise RuntimeError(f"{netlist.title}: the nominal circuit has no operating point")
    return _Setup(system, light, heavy)


def solve_ldo(
    x: Float[Array, "d b"], *, model: str = "ekv", time: Grid = TIME, netlist: Netlist = NETLIST
) -> tuple[Float[Array, "m b"], Int[Array, "b"]]:
    """Specifications of a batch of samples, batch last.

    Args:
        x: parameters in sigma.
        model: MOSFET model.
        time: grid of the transient.
        netlist: the circuit as drawn.
    Returns:
        (specs `[3, b]` in the order of `SPECS`, status `[b]`: `NOT_CONVERGED` also where the steps
        do not resolve the dip to `RESOLVED`).
    """
    system, light0, heavy0 = _setup(model, netlist)
    values = variation(system, x)
    at_light, at_heavy = _loaded(values, I_LIGHT), _loaded(values, I_HEAVY)
    light = dc(system, at_light, jnp.asarray(light0))

    amps = np.interp(time.t, [0.0, T_STEP, T_STEP + T_RISE], [I_LIGHT, I_LIGHT, I_HEAVY])
    wave = {"Bload": jnp.asarray(amps, x.dtype).reshape(-1, 1)}
    (out,), end = transient(system, time, at_light, light, wave, probes=("out",))
    # The DC point that belongs to this transient, should the circuit have more than one.
    near = jnp.where((end.status == 0)[None], end.v, jnp.asarray(heavy0))
    heavy = dc(system, at_heavy, near)
    row = system.index("out")
    before, after = light.v[row], heavy.v[row]
    i_load = I_LIGHT * jnp.tanh(before / KNEE)
    specs = jnp.stack(
        [
            source_current(system, at_light, light.v, name="Vin") - i_load,
            out[0] - lowest(time.t, out),
            100.0 * (before - after) / before,
        ]
    )
    # A ringing faster than the steps shows in the dip first: what it may be off is a status.
    dip = jnp.where(unresolved(time.t, out) > RESOLVED, Status.NOT_CONVERGED, Status.GOOD)
    return specs, jnp.maximum(jnp.maximum(end.status, heavy.status), dip.astype(jnp.int32))


def unresolved(t: np.ndarray, v: Float[Array, "t b"]) -> Float[Array, "b"]:
    r"""How far the minimum of a sampled curve may lie from its samples [V].

    .. math:: e = \tfrac18 h^2 |v''|

    with h the longer of the two steps at the lowest sample and the second divided difference there:
    what linear interpolation may be off, and the first thing that fails where a ringing is faster
    than the steps.
    """
    k = jnp.clip(jnp.argmin(v, axis=0), 1, v.shape[0] - 2)
    at = jnp.asarray(t, v.dtype)
    left, mid, right = (jnp.take_along_axis(v, (k + s)[None], axis=0)[0] for s in (-1, 0, 1))
    hl, hr = at[k] - at[k - 1], at[k + 1] - at[k]
    bend = 2.0 * ((right - mid) / hr - (mid - left) / hl) / (hl + hr)
    return jnp.abs(bend) * jnp.maximum(hl, hr) ** 2 / 8.0


def lowest(t: np.ndarray, v: Float[Array, "t b"]) -> Float[Array, "b"]:
    """Minimum over time of a sampled curve, refined by the parabola through three samples."""
    k = jnp.clip(jnp.argmin(v, axis=0), 1, v.shape[0] - 2)
    at = jnp.asarray(t, v.dtype)
    left, mid, right = (jnp.take_along_axis(v, (k + s)[None], axis=0)[0] for s in (-1, 0, 1))
    hl, hr = at[k] - at[k - 1], at[k + 1] - at[k]
    sl, sr = (mid - left) / hl, (right - mid) / hr
    bend = (sr - sl) / (hl + hr)
    slope = (sl * hr + sr * hl) / (hl + hr)
    inside = (sl < 0.0) & (sr > 0.0)
    gain = jnp.where(inside, slope * slope / (4.0 * jnp.where(inside, bend, 1.0)), 0.0)
    return jnp.min(v, axis=0) - gain
