"""Transient analysis on a fixed grid of steps: trapezoidal, or backward Euler where asked for."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from failure.circuits.solver import incidence
from failure.circuits.solver.mna import (
    GMIN,
    assemble,
    assemble_full,
    capacitance,
    conductance,
    known_voltages,
)
from failure.circuits.solver.netlist import CurrentSource, Inductor, Load, Switch, VoltageSource
from failure.circuits.solver.newton import (
    MAX_STEP,
    PLAIN,
    V_TOL_STEP,
    Solution,
    newton,
    status_of,
)
from failure.circuits.solver.system import System
from failure.circuits.solver.values import Values, batch_size


class Grid(NamedTuple):
    """Times of a transient [s]; per step: backward Euler or not, first of a piece or not."""

    t: np.ndarray
    euler: np.ndarray
    begins: np.ndarray


def grid(*pieces: tuple[float, float, int, float], euler_steps: int = 0) -> Grid:
    """Join pieces `(t_start, t_end, n_steps, growth)` of geometrically growing steps.

    Args:
        pieces: `growth` is the ratio of the last to the first step of the piece.
        euler_steps: backward-Euler steps at the start of each piece; sources that jump there need
            two, corners of piecewise-linear sources none.
    Returns:
        Grid with `sum(n_steps) + 1` times.
    Raises:
        ValueError: pieces do not join, or have no length or no steps.
    """
    times: list[float] = [pieces[0][0]]
    euler: list[bool] = []
    begins: list[bool] = []
    for start, end, n, growth in pieces:
        if abs(start - times[-1]) > 1e-15 or not end > start or n < 1:
            raise ValueError(
                f"pieces={(start, end, n, growth)}: expected a piece with steps that starts at "
                f"{times[-1]}, where the last one ends"
            )
        h = growth ** (np.arange(n) / max(n - 1, 1))
        times.extend(start + (end - start) * np.cumsum(h) / h.sum())
        times[-1] = end
        euler.extend(k < euler_steps for k in range(n))
        begins.extend(k == 0 for k in range(n))
    return Grid(np.array(times), np.array(euler), np.array(begins))


_KINDS = {
    VoltageSource: "volts",
    CurrentSource: "amps",
    Load: "load",
    Switch: "control",
}


def _places(system: System, waveforms: dict[str, Array]) -> dict[str, tuple[str, int]]:
    """Where in `Values` each source is: name -> (field, row)."""
    places = {}
    for kind, attribute in _KINDS.items():
        for row, e in enumerate(system.netlist.of(kind)):
            places[e.name] = (attribute, row)
    for name in waveforms:
        if name not in places:
            raise ValueError(
                f"waveforms={name!r}: expected a source, load or switch; known: {', '.join(places)}"
            )
    return places


def transient(
    system: System,
    time: Grid,
    values: Values,
    start: Solution,
    waveforms: dict[str, Float[Array, "t #b"]],
    *,
    probes: tuple[str, ...],
    max_iterations: int = 60,
) -> tuple[Float[Array, "p t b"], Solution]:
    r"""Transient from a DC point on a fixed grid.

    .. math:: \dot q = i: \quad i_{k+1} = \tfrac{2}{h}(q_{k+1} - q_k) - i_k \text{ (trapezoidal)},
        \quad i_{k+1} = \tfrac{1}{h}(q_{k+1} - q_k) \text{ (backward Euler)}

    Args:
        system: compiled netlist.
        time: Grid.
        values: element values of a batch.
        start: state at `time.t[0]`, where capacitor currents are zero.
        waveforms: element name -> value at every time, `[t, b]` or `[t, 1]`.
        probes: unknowns or fixed nodes to record.
        max_iterations: Newton limit per step.
    Returns:
        (recorded `[probe, time, batch]`, Solution at the end; status `NOT_CONVERGED` when
        any step did not converge).
    Raises:
        ValueError: unknown element or node.
    """
    places = _places(system, waveforms)
    rows = [system.index(p) for p in probes]
    batch = batch_size(values)
    dtype = start.v.dtype
    cap = {} if system.dense else capacitance(system, values)
    cap_full = incidence.capacitance(system, values) if system.dense else None
    cap_rows = [i for i, _ in cap]
    inductors = [
        (system.index(f"{e.name}#branch"), e, k) for k, e in enumerate(system.netlist.of(Inductor))
    ]
    h = np.diff(time.t)
    wave = {name: jnp.broadcast_to(w, (len(time.t), w.shape[-1])) for name, w in waveforms.items()}

    def at(now: dict[str, Array]) -> Values:
        changed = values
        for name, value in now.items():
            attribute, row = places[name]
            field = getattr(changed, attribute)
            field = jnp.broadcast_to(field, (field.shape[0], max(field.shape[1], value.shape[0])))
            new: Any = {attribute: field.at[row].set(value)}
            changed = changed._replace(**new)
        return changed

    def charge(full: Array) -> Array:
        if cap_full is not None:
            return jnp.sum(cap_full * full[None], axis=1)
        total = [jnp.zeros((batch,), dtype) for _ in range(system.n)]
        for (i, j), c in cap.items():
            total[i] = total[i] + c * full[j]
        return jnp.stack(total)

    def step(carry: tuple, xs: tuple) -> tuple:
        v, slope, known_old, q_old, i_old, status = carry
        now, alpha, beta, ratio = xs
        here = at(now)
        known = known_voltages(system, here, batch)
        full_old = jnp.concatenate([v, known_old])

        def coil(e: Inductor, k: int, row: int) -> tuple[Array, Array]:
            # Row: v_p - v_n = L di/dt, with the same rule as the capacitors.
            drop = full_old[system.index(e.p)] - full_old[system.index(e.n)]
            henries = values.henries[k]
            return -alpha * henries, alpha * henries * v[row] + beta * drop

        if cap_full is not None:
            matrix, constant = incidence.conductance(system, here, GMIN)
            matrix = matrix + alpha * cap_full
            constant = constant - alpha * q_old - beta * i_old
            for row, e, k in inductors:
                own, past = coil(e, k, row)
                matrix = matrix.at[row, row].set(own)
                constant = constant.at[row].set(past)
            s = assemble_full(system, here, matrix, constant, known)
        else:
            entries, const = conductance(system, here)
            for key, c in cap.items():
                entries[key] = entries[key] + alpha * c if key in entries else alpha * c
            zero = jnp.zeros((batch,), dtype)
            for i in set(cap_rows):
                const[i] = const.get(i, zero) - alpha * q_old[i] - beta * i_old[i]
            for row, e, k in inductors:
                entries[row, row], const[row] = coil(e, k, row)
            s = assemble(system, here, entries, const, known, batch)
        # No farther than one Newton step may go: ringing would be extrapolated out of the supplies.
        guess = v + jnp.clip(slope * ratio, -MAX_STEP, MAX_STEP)
        new, last = newton(system, max_iterations, PLAIN, s, jax.lax.stop_gradient(guess))
        q = charge(jnp.concatenate([new, known]))
        i = alpha * (q - q_old) - beta * i_old
        status = jnp.maximum(status, status_of(last < V_TOL_STEP))
        full = jnp.concatenate([new, known])
        out = jnp.stack([full[r] for r in rows])
        return (new, new - v, known, q, i, status), out

    first = {name: w[0] for name, w in wave.items()}
    known = known_voltages(system, at(first), batch)
    full = jnp.concatenate([start.v, known])
    q = charge(full)
    carry = (start.v, jnp.zeros_like(start.v), known, q, jnp.zeros_like(q), start.status)
    euler = jnp.asarray(time.euler)
    hs = jnp.asarray(h, dtype)
    alpha = jnp.where(euler, 1.0, 2.0) / hs
    beta = jnp.where(euler, 0.0, 1.0).astype(dtype)
    # Linear prediction from the last step, none across the start of a piece.
    ratio = np.concatenate([[0.0], h[1:] / h[:-1]]) * ~time.begins
    later = {name: w[1:] for name, w in wave.items()}
    outs: Array
    end, outs = jax.lax.scan(step, carry, (later, alpha, beta, jnp.asarray(ratio, dtype)))
    initial = jnp.stack([full[r] for r in rows])
    recorded = jnp.concatenate([initial[None], outs]).transpose(1, 0, 2)
    return recorded, Solution(end[0], end[5])
