"""Blocks of the buck converter at transistor level: error amplifier by DC, edges by a transient."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from failure.circuits.buck.schematic import (
    AMPLIFIER,
    AMPLIFIER_MOSFETS,
    LOAD_HEAVY,
    POWER,
    POWER_MOSFETS,
    RAMP_HIGH,
    RAMP_LOW,
    RAMP_SLOPE,
    V_COMP,
    V_DD,
    variation,
)
from failure.circuits.solver.mna import source_current
from failure.circuits.solver.netlist import VoltageSource
from failure.circuits.solver.newton import dc
from failure.circuits.solver.system import System, compile_netlist
from failure.circuits.solver.transient import Grid, grid, transient

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
_SWING = 0.08
"""Inductor current at the two edges, below and above the load [A]."""


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


class Amplifier(NamedTuple):
    """Error amplifier about its working point; leaves `[b]`."""

    i_offset: Float[Array, "b"]
    gm: Float[Array, "b"]
    go: Float[Array, "b"]
    status: Int[Array, "b"]


@lru_cache(maxsize=4)
def _systems(model: str, dense: bool) -> tuple[System, System]:
    amplifier, power = (compile_netlist(n, model, dense=dense) for n in (AMPLIFIER, POWER))
    return amplifier, power


def amplifier(u: Float[Array, "5 2 b"], *, model: str = "ekv", dense: bool = False) -> Amplifier:
    """Offset current, transconductance and output conductance by three DC points.

    Args:
        u: parameters of the five transistors in sigma.
        model: MOSFET model.
        dense: see `System.dense`.
    Returns:
        Amplifier.
    """
    system, _ = _systems(model, dense)
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
    i = -source_current(system, values, solution.v, name="Vcomp").reshape(3, batch)
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


def edges(
    u: Float[Array, "17 2 b"],
    *,
    model: str = "ekv",
    refine: int = 1,
    dense: bool = False,
    load: float | Float[Array, ""] = LOAD_HEAVY,
) -> Edges:
    """Delays and on resistances by a transient of comparator, drivers and switches.

    The instant of an edge is that of the ideal step with the same volt-seconds.

    Args:
        u: parameters of the 17 transistors in sigma.
        model: MOSFET model.
        refine: divides every time step.
        dense: see `System.dense`.
        load: what the inductor carries on average [A].
    Returns:
        Edges.
    """
    _, system = _systems(model, dense)
    time = edge_grid(refine)
    values = variation(system, POWER_MOSFETS, u)
    ramp = np.interp(time.t, _EDGE_T, _EDGE_V)
    valley, peak = load - _SWING, load + _SWING
    coil = load + _SWING * np.interp(time.t, [_T1, _T3], [-1.0, 1.0])
    row = [v.name for v in POWER.of(VoltageSource)].index("Vramp")
    first = values._replace(
        volts=values.volts.at[row].set(float(ramp[0])), amps=jnp.full_like(values.amps, valley)
    )
    start = dc(system, first)
    waves = {
        "Vramp": jnp.asarray(ramp, u.dtype).reshape(-1, 1),
        "IL": jnp.asarray(coil, u.dtype).reshape(-1, 1),
    }
    (sw,), end = transient(system, time, first, start, waves, probes=("sw",))
    at_rise = int(np.searchsorted(time.t, _T1 - 1e-15))
    at_fall = int(np.searchsorted(time.t, _T3 - 1e-15))
    h = jnp.asarray(np.diff(time.t), u.dtype)[:, None]
    mean = 0.5 * (sw[1:] + sw[:-1]) * h
    low, high, top, bottom = sw[0], sw[at_rise], sw[at_fall], sw[-1]
    area = jnp.sum(mean[:at_rise], axis=0)
    rise = _T1 - (area - low * _T1) / (high - low) - 15e-9
    length = float(time.t[-1] - time.t[at_fall])
    fall = (jnp.sum(mean[at_fall:], axis=0) - bottom * length) / (top - bottom)
    return Edges(rise, fall, (V_DD - top) / peak, -bottom / peak, end.status)
