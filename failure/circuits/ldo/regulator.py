"""Low-dropout regulator of 20 transistors under variation of length, threshold and oxide."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from failure.circuits.ldo.schematic import (
    I_HEAVY,
    I_LIGHT,
    KNEE,
    NETLIST,
    T_END,
    T_RISE,
    T_STEP,
    variation,
)
from failure.circuits.protocol import Spec
from failure.circuits.solver.mna import source_current
from failure.circuits.solver.netlist import (
    Netlist,
)
from failure.circuits.solver.newton import Solution, dc
from failure.circuits.solver.system import System, compile_netlist
from failure.circuits.solver.transient import Grid, grid, transient
from failure.circuits.solver.values import Values, nominal_values
from failure.status import Status

T_DAMPED = 40e-9
"""From here on the steps of the shipped grid are longer than 4 ns [s]."""


SPECS = (
    Spec("quiescent_current", "A", "max", "supply current at the light load, load excluded"),
    Spec("undershoot", "V", "max", "output before the load step less its minimum after it"),
    Spec("load_regulation", "%", "max", "fall of the output from light to heavy load, DC"),
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
    short: System
    light: np.ndarray
    heavy: np.ndarray


def _loaded(values: Values, amps: float | Array) -> Values:
    return values._replace(load=jnp.full_like(values.load, amps))


@lru_cache(maxsize=8)
def _setup(model: str, netlist: Netlist = NETLIST) -> _Setup:
    """Compiled netlist and its nominal operating points, where Newton starts."""
    system = compile_netlist(netlist, model)
    short = dataclasses.replace(system, dense=True)
    with jax.ensure_compile_time_eval(), jax.enable_x64(True):
        values = nominal_values(system)

        def solve(amps: Array, start: Array) -> Solution:
            return dc(short, _loaded(values, amps), start)

        # It runs twice: what the compiler would optimise is not worth its time.
        point = jax.jit(solve, compiler_options={"xla_backend_optimization_level": 0})
        first = point(jnp.asarray(I_LIGHT), jnp.zeros((system.n, 1)))
        second = point(jnp.asarray(I_HEAVY), first.v)
        light, heavy = np.asarray(first.v), np.asarray(second.v)
        status = np.asarray(first.status + second.status)
    if status[0]:
        raise RuntimeError(f"{netlist.title}: the nominal circuit has no operating point")
    return _Setup(system, short, light, heavy)


def solve_ldo(
    x: Float[Array, "d b"],
    *,
    model: str = "ekv",
    time: Grid = TIME,
    netlist: Netlist = NETLIST,
    dense: bool = False,
) -> tuple[Float[Array, "m b"], Int[Array, "b"]]:
    """Specifications of a batch of samples, batch last.

    Args:
        x: parameters in sigma.
        model: MOSFET model.
        time: grid of the transient.
        netlist: the circuit as drawn.
        dense: a program that is quicker to compile and slower to run, for gradients.
    Returns:
        (specs `[3, b]` in the order of `SPECS`, status `[b]`: `NOT_CONVERGED` also where the steps
        do not resolve the dip to `RESOLVED`).
    """
    usual, short, light0, heavy0 = _setup(model, netlist)
    system = short if dense else usual
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
