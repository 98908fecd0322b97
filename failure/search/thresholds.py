"""How far a specification can be pushed: multi-start gradient ascent, and a threshold from it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from failure.models.domains import project, sample
from failure.search.task import Task, sign_of, task_domain


class Reach(NamedTuple):
    """Nominal value, worst value found, where, and the threshold in between."""

    nominal: float
    worst: float
    x: np.ndarray
    threshold: float
    n_simulations: int


def reachable(
    run: Callable[[Any], tuple[Any, Any]],
    column: int,
    task: Task,
    *,
    sense: str = "max",
    share: float = 0.9,
    n_starts: int = 16,
    steps: int = 60,
    rate: float = 0.15,
    seed: int = 0,
) -> Reach:
    r"""The worst value that many gradient ascents find, and a threshold at a share of the way.

    .. math:: T = y(0) + \rho\,(y_{worst} - y(0))

    Adam in a box, normalised gradients with momentum in a ball; the rate falls linearly; samples
    that do not converge are ignored.
    This is not a search method: it costs thousands of simulations with gradients, and serves to
    set a threshold that is known to be reachable.

    Args:
        run: pure `x [n, D] -> (specs [n, m], status [n])`, differentiable.
        column: which specification.
        task: the feasible set.
        sense: "max" when larger is worse, "min" when smaller is.
        share: :math:`\rho`.
        n_starts: starts, the nominal point and random ones.
        steps: of every ascent.
        rate: first step, as a share of the set's size.
        seed: of the random starts.

    Raises:
        ValueError: `share` is not in (0, 1), an unknown sense, no start or step.
    """
    if not 0.0 < share < 1.0:
        raise ValueError(f"share={share}: expected a number between 0 and 1")
    for name, value in (("n_starts", n_starts), ("steps", steps)):
        if value < 1:
            raise ValueError(f"{name}={value}: expected at least 1")
    sign = sign_of(sense)
    with jax.enable_x64(True):
        domain = task_domain(task)
        starts = sample(domain, n_starts - 1, key=jax.random.key(seed))
        x0 = jnp.concatenate([jnp.zeros((1, task.dim)), starts])

        def output(x: Any) -> tuple[Any, Any]:
            specs, status = run(x)
            y = sign * specs[:, column]
            good = (status == 0) & jnp.isfinite(y)
            return jnp.sum(jnp.where(good, y, jnp.zeros_like(y))), jnp.where(good, y, -jnp.inf)

        slope = jax.value_and_grad(output, has_aux=True)
        size = task.size if task.kind == "box" else task.size / task.dim**0.5

        def step(carry: Any, t: Any) -> tuple[Any, Any]:
            x, m, v, best_x, best_y = carry
            (_, y), g = slope(x)
            g = jnp.nan_to_num(g)
            better = y > best_y
            best_x = jnp.where(better[:, None], x, best_x)
            best_y = jnp.where(better, y, best_y)
            m, v = 0.9 * m + 0.1 * g, 0.99 * v + 0.01 * g * g
            scale = rate * size * (1.0 - t / steps)
            if task.kind == "box":
                first, second = m / (1.0 - 0.9 ** (t + 1.0)), v / (1.0 - 0.99 ** (t + 1.0))
                # A floor relative to the largest slope: femtoamperes move as volts do.
                root = jnp.sqrt(second)
                floor = 1e-12 * jnp.max(root, axis=1, keepdims=True)
                move = first / jnp.maximum(root, jnp.maximum(floor, 1e-150))
            else:
                # Steps of equal size per coordinate would come to rest on the sphere where x is
                # parallel to the gradient's signs; the gradient's own direction is wanted.
                length = jnp.linalg.norm(m, axis=1, keepdims=True)
                move = m * (task.dim**0.5 / jnp.maximum(length, 1e-150))
            x = jax.vmap(project, (None, 0))(domain, x + scale * move)
            return (x, m, v, best_x, best_y), y

        @jax.jit
        def ascend(x: Any) -> Any:
            start = (x, jnp.zeros_like(x), jnp.zeros_like(x), x, jnp.full((n_starts,), -jnp.inf))
            return jax.lax.scan(step, start, jnp.arange(steps, dtype=x.dtype))

        (_, _, _, best_x, best_y), history = ascend(x0)
        best_x, best_y, history = np.asarray(best_x), np.asarray(best_y), np.asarray(history)
    top = int(np.argmax(best_y))
    nominal, worst = sign * float(history[0, 0]), sign * float(best_y[top])
    threshold = nominal + share * (worst - nominal)
    return Reach(nominal, worst, best_x[top], threshold, n_starts * steps)
