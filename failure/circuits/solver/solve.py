"""Newton with an implicit derivative, DC with continuation, transient on a fixed grid."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from failure.circuits.solver.mna import (
    Stamps,
    Values,
    assemble,
    batch_size,
    capacitance,
    conductance,
    eliminate,
    keys,
    known_voltages,
    residual,
    stamps,
)
from failure.circuits.solver.netlist import CurrentSource, Inductor, Load, Switch, VoltageSource
from failure.circuits.solver.system import System

__all__ = ["CONVERGED", "NOT_CONVERGED", "Grid", "Solution", "dc", "grid", "newton", "transient"]

CONVERGED = 0
NOT_CONVERGED = 1

V_TOL = 1e-7
"""A Newton step below this [V] ends a DC solve; what is left is its square."""

V_TOL_STEP = 1e-4
"""The same within a transient step, where it leaves less than 1e-8 V (measured)."""

MAX_STEP = 0.3
"""Largest change of a voltage in one Newton step [V]."""


class Stages(NamedTuple):
    """Continuation: at each stage extra gmin [S], factor on the sources, where to start and stop.

    `restart` is 0 to go on from the stage before, 1 from the caller's start, 2 from zero; `end`
    marks a stage that solves the true equations. Tuples, so that it can be a static argument.
    """

    gmin: tuple[float, ...]
    scale: tuple[float, ...]
    restart: tuple[int, ...]
    end: tuple[bool, ...]
    tolerance: float


PLAIN = Stages((0.0,), (1.0,), (1,), (True,), V_TOL_STEP)
"""Newton alone, for a time step."""

CONTINUATION = Stages(
    gmin=(0.0, *(10.0**-k for k in range(2, 11)), 0.0, *(0.0,) * 20),
    scale=(1.0, *(1.0,) * 10, *(k / 20 for k in range(1, 21))),
    restart=(1, 1, *(0,) * 9, 2, *(0,) * 19),
    end=(True, *(False,) * 9, True, *(False,) * 19, True),
    tolerance=V_TOL,
)
"""Newton, then gmin stepping, then source stepping; ends as soon as all samples are solved."""


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def newton(
    system: System,
    max_iterations: int,
    stages: Stages,
    v0: Float[Array, "n b"],
    s: Stamps,
) -> tuple[Float[Array, "n b"], Float[Array, "b"]]:
    r"""Solve `residual(v, s) = 0` by damped Newton; differentiate by the implicit function theorem.

    .. math:: v \leftarrow v - \mathrm{clip}(J^{-1} F), \qquad
        \mathrm{d}v = -J^{-1}\, \partial_s F \, \mathrm{d}s

    A sample that has converged is frozen, so that its result does not depend on its neighbours.

    Args:
        system: compiled netlist.
        max_iterations: limit per stage.
        stages: continuation to go through until every sample has converged.
        v0: start; has no derivative.
        s: Stamps.
    Returns:
        (unknowns `[n, b]`, size of the last Newton step `[b]` [V]; above the tolerance or NaN: not
        converged).
    """
    nodes = system.n_nodes

    def solve(v: Array, s: Stamps) -> tuple[Array, Array]:
        def body(carry: tuple) -> tuple:
            k, v, last = carry
            f, jacobian = residual(system, v, s)
            step = eliminate(system, jacobian, f)
            size = jnp.max(jnp.abs(step[:nodes]), axis=0)
            damp = jnp.minimum(1.0, MAX_STEP / jnp.maximum(size, 1e-30))
            active = ~(last < stages.tolerance)
            v = v - jnp.where(active[None], damp[None] * step, 0.0)
            return k + 1, v, jnp.where(active, size, last)

        def go_on(carry: tuple) -> Array:
            k, _, last = carry
            return (k < max_iterations) & jnp.any(~(last < stages.tolerance))

        start = (jnp.zeros((), jnp.int32), v, jnp.full(v.shape[-1:], jnp.inf, v.dtype))
        _, v, last = jax.lax.while_loop(go_on, body, start)
        return v, last

    if len(stages.gmin) == 1:
        return solve(v0, s)

    diagonal = np.array([i == j and i < nodes for i, j in keys(system)])[:, None]
    gmins, scales = (jnp.asarray(a, v0.dtype) for a in (stages.gmin, stages.scale))
    restarts, ends = jnp.asarray(stages.restart), jnp.asarray(stages.end)

    def stage(carry: tuple) -> tuple:
        k, v, best, best_last = carry
        here = s._replace(
            linear=s.linear + jnp.where(diagonal, gmins[k], 0.0),
            const=s.const * scales[k],
            known=s.known * scales[k],
            load=s.load * scales[k],
        )
        restart = jnp.where(restarts[k] > 1, jnp.zeros_like(v0), v0)
        start = jnp.where(restarts[k] > 0, restart, v)
        new, last = solve(start, here)
        new = jnp.where(jnp.isfinite(new), new, start)
        take = ends[k] & ~(best_last < stages.tolerance)
        return (
            k + 1,
            new,
            jnp.where(take[None], new, best),
            jnp.where(take, last, best_last),
        )

    def more(carry: tuple) -> Array:
        k, _, _, best_last = carry
        return (k < len(stages.gmin)) & jnp.any(~(best_last < stages.tolerance))

    unsolved = jnp.full(v0.shape[-1:], jnp.inf, v0.dtype)
    start = (jnp.zeros((), jnp.int32), v0, v0, unsolved)
    _, _, v, last = jax.lax.while_loop(more, stage, start)
    return v, last


@newton.defjvp
def _newton_jvp(
    system: System, max_iterations: int, stages: Stages, primals: Any, tangents: Any
) -> Any:
    v0, s = primals
    _, ds = tangents
    v, last = newton(system, max_iterations, stages, v0, s)
    _, df = jax.jvp(lambda q: residual(system, v, q)[0], (s,), (ds,))
    _, jacobian = residual(system, v, s)
    dv = -eliminate(system, jacobian, df)
    return (v, last), (dv, jnp.zeros_like(last))


def _status(good: Array) -> Array:
    return jnp.where(good, CONVERGED, NOT_CONVERGED).astype(jnp.int32)


class Solution(NamedTuple):
    """Unknowns and a status per sample (0 converged, 1 not)."""

    v: Float[Array, "n b"]
    status: Int[Array, "b"]


def dc(
    system: System,
    values: Values,
    v0: Float[Array, "n #b"] | None = None,
    *,
    max_iterations: int = 40,
) -> Solution:
    """DC operating point by Newton; while a sample fails, gmin stepping, then source stepping.

    Args:
        system: compiled netlist.
        values: element values of a batch.
        v0: start, e.g. the nominal operating point; zero when it is left out.
        max_iterations: Newton limit per stage.
    Returns:
        Solution; gradients by the implicit function theorem.
    """
    shape = (system.n, batch_size(values))
    start = jnp.zeros((1, 1), values.volts.dtype) if v0 is None else v0
    start = jax.lax.stop_gradient(jnp.broadcast_to(start, shape))
    v, last = newton(system, max_iterations, CONTINUATION, start, stamps(system, values))
    return Solution(v, _status(last < V_TOL))


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
            raise ValueError(f"grid piece {(start, end, n, growth)} does not follow {times[-1]}")
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
            raise ValueError(f"no source, load or switch {name!r}; known: {', '.join(places)}")
    return places


def transient(
    system: System,
    values: Values,
    start: Solution,
    time: Grid,
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
        values: element values of a batch.
        start: state at `time.t[0]`, where capacitor currents are zero.
        time: Grid.
        waveforms: element name -> value at every time, `[t, b]` or `[t, 1]`.
        probes: unknowns or fixed nodes to record.
        max_iterations: Newton limit per step.
    Returns:
        (recorded `[probe, time, batch]`, Solution at the end; status 1 when any step did not
        converge).
    Raises:
        ValueError: unknown element or node.
    """
    places = _places(system, waveforms)
    rows = [system.index(p) for p in probes]
    batch = batch_size(values)
    dtype = start.v.dtype
    cap = capacitance(system, values)
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
        total = [jnp.zeros((batch,), dtype) for _ in range(system.n)]
        for (i, j), c in cap.items():
            total[i] = total[i] + c * full[j]
        return jnp.stack(total)

    def step(carry: tuple, xs: tuple) -> tuple:
        v, slope, known_old, q_old, i_old, status = carry
        now, alpha, beta, ratio = xs
        here = at(now)
        entries, const = conductance(system, here)
        entries = dict(entries)
        known = known_voltages(system, here, batch)
        for key, c in cap.items():
            entries[key] = entries[key] + alpha * c if key in entries else alpha * c
        const = dict(const)
        zero = jnp.zeros((batch,), dtype)
        for i in set(cap_rows):
            const[i] = const.get(i, zero) - alpha * q_old[i] - beta * i_old[i]
        full_old = jnp.concatenate([v, known_old])
        for row, e, k in inductors:
            # Row: v_p - v_n = L di/dt, with the same rule as the capacitors.
            drop = full_old[system.index(e.p)] - full_old[system.index(e.n)]
            henries = values.henries[k]
            entries[row, row] = -alpha * henries
            const[row] = alpha * henries * v[row] + beta * drop
        s = assemble(system, here, entries, const, known, batch)
        # No farther than one Newton step may go: ringing would be extrapolated out of the supplies.
        guess = v + jnp.clip(slope * ratio, -MAX_STEP, MAX_STEP)
        new, last = newton(system, max_iterations, PLAIN, jax.lax.stop_gradient(guess), s)
        q = charge(jnp.concatenate([new, known]))
        i = alpha * (q - q_old) - beta * i_old
        status = jnp.maximum(status, _status(last < V_TOL_STEP))
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
