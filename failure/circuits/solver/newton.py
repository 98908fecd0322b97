"""Newton with an implicit derivative; DC operating points with continuation."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from failure.circuits.solver.elimination import eliminate, full_matrix
from failure.circuits.solver.mna import Stamps, keys, residual, stamps
from failure.circuits.solver.system import System
from failure.circuits.solver.values import Values, batch_size
from failure.status import Status

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
    s: Stamps,
    v0: Float[Array, "n b"],
) -> tuple[Float[Array, "n b"], Float[Array, "b"]]:
    r"""Solve `residual(s, v) = 0` by damped Newton; differentiate by the implicit function theorem.

    .. math:: v \leftarrow v - \mathrm{clip}(J^{-1} F), \qquad
        \mathrm{d}v = -J^{-1}\, \partial_s F \, \mathrm{d}s

    A sample that has converged is frozen, so that its result does not depend on its neighbours.

    Args:
        system: compiled netlist.
        max_iterations: limit per stage.
        stages: continuation to go through until every sample has converged.
        s: Stamps.
        v0: start; has no derivative.
    Returns:
        (unknowns `[n, b]`, size of the last Newton step `[b]` [V]; above the tolerance or NaN: not
        converged).
    """
    nodes = system.n_nodes

    def solve(v: Array, s: Stamps) -> tuple[Array, Array]:
        def body(carry: tuple) -> tuple:
            k, v, last = carry
            f, jacobian = residual(system, s, v)
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

    if system.dense:
        diagonal = np.diag(np.arange(system.n) < nodes)[:, :, None]
    else:
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
    s, v0 = primals
    ds, _ = tangents
    v, last = newton(system, max_iterations, stages, s, v0)
    _, df, jacobian = jax.jvp(lambda q: residual(system, q, v), (s,), (ds,), has_aux=True)
    # A dense solve, one per sample: its transpose is one call too, where the sparse elimination
    # backwards would be a program of many thousand operations that takes minutes to compile.
    matrix = full_matrix(system, jacobian, v.shape[-1]).transpose(2, 0, 1)
    dv = -jnp.linalg.solve(matrix, df.T[:, :, None])[:, :, 0].T
    return (v, last), (dv, jnp.zeros_like(last))


def status_of(good: Array) -> Int[Array, "b"]:
    """Status of samples that have converged or not."""
    return jnp.where(good, Status.GOOD, Status.NOT_CONVERGED).astype(jnp.int32)


class Solution(NamedTuple):
    """Unknowns and a `failure.Status` per sample."""

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
    v, last = newton(system, max_iterations, CONTINUATION, stamps(system, values), start)
    return Solution(v, status_of(last < V_TOL))
