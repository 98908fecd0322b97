"""Search spaces: how a point of the surrogate's space becomes a parameter variation.

A surrogate works on unit coordinates `u`, in which the initial design has variance 1/12 per
coordinate (that of a unit cube), whatever the task: then one lengthscale prior serves them all.
`decode` maps `u` to the parameters `x` in sigma.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from failure import bnn, revnet
from failure.models.optimize import Domain, ball, box, project, sample

__all__ = [
    "FullSpace",
    "RandomEmbedding",
    "ReversedFeatures",
    "Space",
    "Task",
    "decode",
    "encode",
    "initial_design",
    "random_embedding",
    "search_domain",
    "task_domain",
    "unit_scale",
]


class Task(NamedTuple):
    """Where failures are looked for: `kind` "box" (half width) or "ball" (radius), in sigma."""

    kind: str
    size: float
    dim: int


class FullSpace(NamedTuple):
    """Every parameter is a coordinate: `x = scale u`."""

    scale: Array


class RandomEmbedding(NamedTuple):
    """HDBO: `x = P(unit A z)`, `z = 2 sqrt(d) u` in `[-sqrt d, sqrt d]^d`."""

    matrix: Array
    unit: Array


class ReversedFeatures(NamedTuple):
    """Rev-ARGate: active features, the rest restored, then the RevNet run backwards.

    Attributes:
        network: RevNet weights.
        order: `[D]`, feature numbers, the active ones first.
        shift: `[d]`, middle of the range of the active features.
        scale: `[d]`, width of that range.
        x_scale: the RevNet sees `x / x_scale`.
        restoration: network from active to inactive features, or None for zeros.
    """

    network: revnet.RevNetParams
    order: Array
    shift: Array
    scale: Array
    x_scale: Array
    restoration: bnn.BNNParams | None


Space = FullSpace | RandomEmbedding | ReversedFeatures


def task_domain(task: Task) -> Domain:
    """The feasible set of x.

    Raises:
        ValueError: unknown kind, or a size that is not positive.
    """
    if task.kind not in ("box", "ball"):
        raise ValueError(f"task={task.kind!r}: expected 'box' or 'ball'")
    if not (task.size > 0 and math.isfinite(task.size)):
        raise ValueError(f"task size {task.size}: expected a positive number of sigma")
    if task.kind == "ball":
        return ball(task.dim, task.size)
    limit = jnp.full((task.dim,), float(task.size))
    return box(-limit, limit)


def unit_scale(task: Task) -> float:
    r"""Parameters per unit coordinate: :math:`x = c\,u` with variance 1/12 of `u`.

    A coordinate of a uniform point has variance :math:`b^2/3` in a box of half width b and
    :math:`r^2/(D+2)` in a ball of radius r.

    Example:
        >>> unit_scale(Task("box", 3.0, 60)), round(unit_scale(Task("ball", 6.0, 60)), 3)
        (6.0, 2.64)
    """
    if task.kind == "box":
        return 2.0 * task.size
    return task.size * math.sqrt(12.0 / (task.dim + 2))


def random_embedding(key: Key[Array, ""], task: Task, dim: int) -> RandomEmbedding:
    r"""Draw HDBO's embedding matrix, entries N(0, 1).

    .. math:: x = P_\Omega(b A z), \quad A \in \mathbb R^{D \times d}, \quad
        z \in [-\sqrt d, \sqrt d]^d

    `b` is the half width of the box, the unit in which REMBO's box is [-1, 1]; for the ball it
    is `sqrt(3)` standard deviations of a coordinate, so that both tasks clip alike.

    Raises:
        ValueError: `dim` is not in 1 ... D.

    Source: Shim (2020), Section 4.1; Wang et al. (2016), REMBO.
    """
    if not 1 <= dim <= task.dim:
        raise ValueError(f"embedding_dim={dim}: expected 1 ... {task.dim}")
    matrix = jax.random.normal(key, (task.dim, dim))
    return RandomEmbedding(matrix, jnp.asarray(unit_scale(task) / 2.0, matrix.dtype))


def search_domain(space: Space, task: Task) -> Domain:
    """The feasible set of `u`: the unit cube, or a ball for the full space of a ball task."""
    if isinstance(space, FullSpace) and task.kind == "ball":
        return ball(task.dim, task.size / unit_scale(task))
    if isinstance(space, FullSpace):
        dim = task.dim
    elif isinstance(space, RandomEmbedding):
        dim = space.matrix.shape[-1]
    else:
        dim = space.shift.shape[-1]
    half = jnp.full((dim,), 0.5)
    return box(-half, half)


def decode(
    space: Space, domain: Domain, u: Float[Array, " d"]
) -> tuple[Float[Array, " D"], Float[Array, ""]]:
    """Parameters of one unit point, and the share of coordinates that the task's set clipped.

    Args:
        space: the search space.
        domain: feasible set of x, from `task_domain`.
        u: unit coordinates.

    Returns:
        `(x, clipped share)`; x always lies in the domain.

    Source: Shim (2020), Sections 4.1 and 4.4. Deviation: a restored x may leave the box
    (features are unbounded); it is projected and the share reported.
    """
    if isinstance(space, FullSpace):
        raw = space.scale * u
    elif isinstance(space, RandomEmbedding):
        z = 2.0 * math.sqrt(u.shape[0]) * u
        raw = space.unit * (space.matrix @ z)
    else:
        active = space.shift + space.scale * u
        n_rest = space.order.shape[0] - active.shape[0]
        if space.restoration is None:
            rest = jnp.zeros((n_rest,), active.dtype)
        else:
            rest = bnn.predict(space.restoration, active[None])[0]
        features = jnp.zeros_like(space.order, active.dtype)
        features = features.at[space.order].set(jnp.concatenate([active, rest]))
        raw = space.x_scale * revnet.inverse(space.network, features)
    x = project(domain, raw)
    return x, jnp.mean((jnp.abs(x - raw) > 1e-9).astype(x.dtype))


def encode(space: Space, x: Float[Array, " D"]) -> Float[Array, " d"]:
    """Unit coordinates of given parameters: exact for the full space, the active part else.

    Raises:
        ValueError: a random embedding, which has no inverse.
    """
    if isinstance(space, FullSpace):
        return x / space.scale
    if isinstance(space, RandomEmbedding):
        raise ValueError("a random embedding has no inverse: draw the initial design in u")
    dim = space.shift.shape[0]
    features = revnet.forward(space.network, x / space.x_scale)
    return (features[space.order[:dim]] - space.shift) / space.scale


def initial_design(space: Space, task: Task, key: Key[Array, ""], n: int) -> Float[Array, "n d"]:
    """Uniform points of the space's own domain."""
    return sample(search_domain(space, task), key, n)
