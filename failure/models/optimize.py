"""Quasi-Newton descent with one function value per turn, on a box, a ball or the whole space."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from failure.models.domains import Domain, project


class BFGSResult(NamedTuple):
    """Where `bfgs` stopped; `hessian_inverse` warm-starts the next call."""

    x: Float[Array, " d"]
    value: Float[Array, ""]
    grad: Float[Array, " d"]
    hessian_inverse: Float[Array, "d d"]
    n_evals: Int[Array, ""]
    converged: Bool[Array, ""]
    aux: Any


class _State(NamedTuple):
    x: Array
    value: Array
    grad: Array
    h: Array
    fresh: Array
    direction: Array
    step: Array
    n_evals: Array
    stalls: Array
    converged: Array
    aux: Any


def _tangent(domain: Domain, x: Array, v: Array) -> Array:
    """The part of the move `v` that does not leave the set at `x`."""
    blocked = ((x <= domain.lower) & (v < 0)) | ((x >= domain.upper) & (v > 0))
    v = jnp.where(blocked, jnp.zeros_like(v), v)
    norm2 = x @ x
    outward = v @ x
    on_sphere = (norm2 >= domain.radius**2 * (1.0 - 1e-9)) & (outward > 0)
    radial = jnp.where(on_sphere, outward / jnp.maximum(norm2, 1e-30), jnp.zeros_like(outward))
    return v - radial * x


def bfgs(
    value_and_grad: Callable[[Array], tuple[Array, Array, Any]],
    x0: Float[Array, " d"],
    domain: Domain,
    *,
    max_evals: int,
    hessian_inverse: Float[Array, "d d"] | None = None,
    fresh: Bool[Array, ""] | None = None,
    max_move: float = jnp.inf,
    gtol: float = 1e-5,
    ftol: float = 1e-10,
) -> BFGSResult:
    r"""Minimise by projected BFGS with backtracking.

    .. math::
        d = -P H P \nabla f, \qquad
        H \leftarrow (I - \rho s y^\top) H (I - \rho y s^\top) + \rho s s^\top

    with :math:`P` the projection on the feasible moves and :math:`\rho = 1 / s^\top y`. Every
    turn of the loop spends exactly one evaluation, on a new step or on a shorter one, so under
    `vmap` no lane waits for another's line search. The dense `H` beats a limited memory at
    the sizes here (up to a few hundred unknowns).

    Args:
        value_and_grad: `x -> (value, gradient, aux)`; `aux` of the best point comes back.
        x0: start, inside the domain.
        domain: the feasible set.
        max_evals: evaluations at most, the one at `x0` included.
        hessian_inverse: `H` of an earlier call, to go on from, or (with `fresh`) a metric that
            makes the coordinates comparable; the identity without.
        fresh: whether to rescale `H` at the first step; true without `hessian_inverse`. Traced,
            so that cold and warm starts are one program.
        max_move: longest step per coordinate.
        gtol: stop when the projected gradient is below it (infinity norm).
        ftol: stop after two accepted steps in a row whose relative gain is below it.

    Returns:
        BFGSResult; `converged` is false when `max_evals` ended the descent.

    Source: Nocedal and Wright (2006), Equation 6.17 and Algorithm 3.1; Bertsekas (1982) for the
    two-metric projection. Deviation: no curvature condition in the line search; pairs with
    :math:`s^\top y \le 10^{-10} |s||y|` are skipped instead.
    """
    dim = x0.shape[0]
    metric = jnp.eye(dim, dtype=x0.dtype) if hessian_inverse is None else hessian_inverse
    zero, one = jnp.zeros((), x0.dtype), jnp.ones((), x0.dtype)

    def aim(x: Array, grad: Array, h: Array) -> tuple[Array, Array]:
        descent = _tangent(domain, x, -grad)
        direction = _tangent(domain, x, h @ descent)
        slope = grad @ direction
        good = slope < -1e-12 * jnp.linalg.norm(grad) * jnp.linalg.norm(direction)
        direction = jnp.where(good, direction, descent)
        longest = jnp.max(jnp.abs(direction))
        limit = jnp.where(longest > max_move, max_move / jnp.maximum(longest, 1e-30), one)
        return direction * limit, jnp.max(jnp.abs(descent))

    # The first turn evaluates x0 itself (a step of length zero from an infinite value): the
    # objective is then compiled once, not twice.
    aux_shape = jax.eval_shape(value_and_grad, x0)[2]
    state = _State(
        x=x0,
        value=jnp.full((), jnp.inf, x0.dtype),
        grad=jnp.zeros_like(x0),
        h=metric,
        fresh=jnp.asarray(hessian_inverse is None) if fresh is None else fresh,
        direction=jnp.zeros_like(x0),
        step=one,
        n_evals=jnp.int32(0),
        stalls=jnp.int32(0),
        converged=jnp.asarray(False),
        aux=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), aux_shape),
    )

    def turn(s: _State) -> _State:
        x_new = project(domain, s.x + s.step * s.direction)
        value_new, grad_new, aux_new = value_and_grad(x_new)
        move = x_new - s.x
        slope = s.grad @ move
        finite = jnp.isfinite(value_new) & jnp.all(jnp.isfinite(grad_new))
        accept = finite & (value_new <= s.value + 1e-4 * slope)
        change = grad_new - s.grad
        curvature = move @ change
        pair = accept & (
            curvature > 1e-10 * jnp.linalg.norm(move) * jnp.linalg.norm(change) + 1e-300**0.5
        )
        rho = jnp.where(pair, 1.0 / jnp.where(pair, curvature, one), zero)
        first = curvature / jnp.maximum(change @ (metric @ change), 1e-30)
        h0 = jnp.where(s.fresh & pair, first * metric, s.h)
        h_change = h0 @ change
        outer = move[:, None] * h_change[None, :]
        h_new = (
            h0
            - rho * (outer + outer.T)
            + (rho * rho * (change @ h_change) + rho) * (move[:, None] * move[None, :])
        )
        h_new = jnp.where(pair, h_new, s.h)
        grad_norm = jnp.linalg.norm(jnp.where(accept, grad_new, s.grad))
        # Shorter step: minimum of the parabola through value, slope and the refused value.
        bend = value_new - s.value - slope
        shrink = jnp.where(finite & (bend > 0), -0.5 * slope / jnp.where(bend > 0, bend, one), zero)
        step_refused = s.step * jnp.clip(shrink, 0.1, 0.5)
        # A refused step of negligible length: forget the curvature once, then give up.
        tiny = ~accept & (s.step < 1e-6)
        restart = tiny | (s.fresh & ~pair)
        h_next = jnp.where(restart, metric / jnp.maximum(grad_norm, 1.0), h_new)
        x = jnp.where(accept, x_new, s.x)
        grad = jnp.where(accept, grad_new, s.grad)
        renew = accept | tiny
        direction_new, size_new = aim(x, grad, h_next)
        gain = s.value - value_new
        small = accept & (gain <= ftol * (1.0 + jnp.abs(s.value)))
        stalls = jnp.where(small | tiny, s.stalls + 1, jnp.where(accept, 0, s.stalls))
        return _State(
            x,
            jnp.where(accept, value_new, s.value),
            grad,
            h_next,
            restart,
            jnp.where(renew, direction_new, s.direction),
            jnp.where(renew, one, step_refused),
            s.n_evals + 1,
            stalls,
            (accept & (size_new < gtol)) | (stalls >= 2),
            jax.tree.map(lambda new, old: jnp.where(accept, new, old), aux_new, s.aux),
        )

    def going(s: _State) -> Array:
        return ~s.converged & (s.n_evals < max_evals)

    end = jax.lax.while_loop(going, turn, state)
    return BFGSResult(end.x, end.value, end.grad, end.h, end.n_evals, end.converged, end.aux)


def polish(
    value: Callable[[Array], Array], x0: Float[Array, " d"], domain: Domain, *, steps: int
) -> tuple[Float[Array, " d"], Float[Array, ""]]:
    r"""Finish a descent by Newton steps on the coordinates that no bound holds.

    .. math:: p = -|H_{FF}|^{-1} g_F, \qquad x \leftarrow P(x + t p)

    with :math:`F` the coordinates that are not pressed against a bound and :math:`|H|` the Hessian
    with the absolute values of its eigenvalues; :math:`t` is the best of eight lengths, none
    included, so the value never rises. Meant for the last digits: a Hessian costs d gradients.

    Args:
        value: what is minimised, twice differentiable.
        x0: start, inside the domain.
        domain: the feasible set; on a sphere the projection replaces the constraint.
        steps: Newton steps.

    Returns:
        `(x, value)`.

    Source: Bertsekas (1982), two-metric projection; Nocedal and Wright (2006), Section 3.4.
    """
    lengths = jnp.asarray([1.0, 2.0, 0.5, 0.25, 0.1, 0.03, 0.01, 0.0], x0.dtype)

    def step(x: Array, _: None) -> tuple[Array, None]:
        grad, hessian = jax.grad(value)(x), jax.hessian(value)(x)
        blocked = ((x <= domain.lower) & (grad > 0)) | ((x >= domain.upper) & (grad < 0))
        free = (~blocked).astype(x.dtype)
        inner = hessian * (free[:, None] * free[None, :]) + jnp.diag(1.0 - free)
        inner = jnp.where(jnp.isfinite(inner), inner, jnp.zeros_like(inner))
        bend, axes = jnp.linalg.eigh(inner)
        bend = jnp.maximum(jnp.abs(bend), 1e-8 * jnp.max(jnp.abs(bend)) + 1e-30)
        move = -free * (axes @ ((axes.T @ (free * grad)) / bend))
        trials = jax.vmap(project, (None, 0))(domain, x[None] + lengths[:, None] * move[None])
        values = jax.vmap(value)(trials)
        # Length zero is x itself, which a projection may move by a rounding error.
        trials = trials.at[-1].set(x)
        return trials[jnp.argmin(jnp.where(jnp.isfinite(values), values, jnp.inf))], None

    x, _ = jax.lax.scan(step, x0, None, length=steps)
    return x, value(x)
