"""Search spaces: how a point of the surrogate's space becomes a parameter variation.

A surrogate works on unit coordinates `u`, in which the initial design has variance 1/12 per
coordinate (that of a unit cube), whatever the task: then one lengthscale prior serves them all.
A space is a tree of arrays with three methods, so an own one needs no change elsewhere:

- `domain(task)`: the feasible set of `u`;
- `decode(domain, u)`: the parameters `x` in sigma, and the share of them that was clipped;
- `encode(x)`: the unit coordinates of given parameters.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from failure import bnn, revnet
from failure.models.domains import Domain, ball, box, project, sample
from failure.search.level_set_features import LevelSetFeatures
from failure.search.task import Task, unit_scale


@runtime_checkable
class SearchSpace(Protocol):
    """What a search needs of a space; every leaf is an array, so spaces of many seeds stack."""

    def domain(self, task: Task) -> Domain:
        """The feasible set of the unit coordinates."""

    def decode(
        self, domain: Domain, u: Float[Array, " d"]
    ) -> tuple[Float[Array, " D"], Float[Array, ""]]:
        """Parameters in `domain`, the feasible set of x, and the share that it clipped."""

    def encode(self, x: Float[Array, " D"]) -> Float[Array, " d"]:
        """Unit coordinates; ValueError where the space has no inverse."""


def _cube(dim: int) -> Domain:
    """The unit cube around the origin."""
    half = jnp.full((dim,), 0.5)
    return box(-half, half)


def _clip(domain: Domain, raw: Array) -> tuple[Array, Array]:
    """A point of the feasible set, and the share of coordinates that had to move."""
    x = project(domain, raw)
    return x, jnp.mean((jnp.abs(x - raw) > 1e-9).astype(x.dtype))


class FullSpace(NamedTuple):
    """Every parameter is a coordinate: `x = scale u`."""

    scale: Array

    def domain(self, task: Task) -> Domain:
        """The unit cube, or a ball for the ball."""
        if task.kind == "ball":
            return ball(task.dim, task.size / unit_scale(task))
        return _cube(task.dim)

    def decode(
        self, domain: Domain, u: Float[Array, " d"]
    ) -> tuple[Float[Array, " D"], Float[Array, ""]]:
        """`scale u`."""
        return _clip(domain, self.scale * u)

    def encode(self, x: Float[Array, " D"]) -> Float[Array, " d"]:
        """`x / scale`."""
        return x / self.scale


class RandomEmbedding(NamedTuple):
    """HDBO: `x = P(unit A z)`, `z = 2 sqrt(d) u` in `[-sqrt d, sqrt d]^d`."""

    matrix: Array
    unit: Array

    def domain(self, task: Task) -> Domain:
        """The unit cube."""
        return _cube(self.matrix.shape[-1])

    def decode(
        self, domain: Domain, u: Float[Array, " d"]
    ) -> tuple[Float[Array, " D"], Float[Array, ""]]:
        """The clipped linear map. Source: Shim (2020), Section 4.1."""
        z = 2.0 * math.sqrt(u.shape[0]) * u
        return _clip(domain, self.unit * (self.matrix @ z))

    def encode(self, x: Float[Array, " D"]) -> Float[Array, " d"]:
        """A random embedding has no inverse."""
        raise ValueError(
            "space=RandomEmbedding: expected a space with an inverse; draw the initial design in u"
        )


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

    def domain(self, task: Task) -> Domain:
        """The unit cube."""
        return _cube(self.shift.shape[-1])

    def decode(
        self, domain: Domain, u: Float[Array, " d"]
    ) -> tuple[Float[Array, " D"], Float[Array, ""]]:
        """Restore the inactive features and run the network backwards.

        Source: Shim (2020), Section 4.4. Deviation: a restored x may leave the box (features are
        unbounded); it is projected and the share reported.
        """
        active = self.shift + self.scale * u
        n_rest = self.order.shape[0] - active.shape[0]
        if self.restoration is None:
            rest = jnp.zeros((n_rest,), active.dtype)
        else:
            rest = bnn.predict(self.restoration, active[None])[0]
        features = jnp.zeros_like(self.order, active.dtype)
        features = features.at[self.order].set(jnp.concatenate([active, rest]))
        return _clip(domain, self.x_scale * revnet.inverse(self.network, features))

    def encode(self, x: Float[Array, " D"]) -> Float[Array, " d"]:
        """The active features."""
        features = revnet.forward(self.network, x / self.x_scale)
        return (features[self.order[: self.shift.shape[0]]] - self.shift) / self.scale


class ActiveSubspace(NamedTuple):
    r"""The directions in which the output changes most: :math:`x = P_\Omega(c\,B u)`.

    Attributes:
        basis: `[D, d]`, orthonormal columns, strongest direction first.
        scale: `c`, parameters per unit coordinate along a column.

    Source: Constantine (2015), Section 3.1; made by `failure.search.subspace`.
    """

    basis: Array
    scale: Array

    def domain(self, task: Task) -> Domain:
        """A ball for the ball; in the box a cube that reaches its corners."""
        dim = self.basis.shape[-1]
        if task.kind == "ball":
            return ball(dim, task.size / unit_scale(task))
        half = jnp.full((dim,), 0.5 * math.sqrt(task.dim))
        return box(-half, half)

    def decode(
        self, domain: Domain, u: Float[Array, " d"]
    ) -> tuple[Float[Array, " D"], Float[Array, ""]]:
        """`c B u`, projected on the set."""
        return _clip(domain, self.scale * (self.basis @ u))

    def encode(self, x: Float[Array, " D"]) -> Float[Array, " d"]:
        """Coordinates along the columns; what is across them is dropped."""
        return (x @ self.basis) / self.scale


SPACES: dict[str, tuple[Any, dict[str, Any]]] = {
    "FullSpace": (FullSpace, {}),
    "RandomEmbedding": (RandomEmbedding, {}),
    "ReversedFeatures": (
        ReversedFeatures,
        {"network": revnet.RevNetParams, "restoration": bnn.BNNParams},
    ),
    "ActiveSubspace": (ActiveSubspace, {}),
    "LevelSetFeatures": (LevelSetFeatures, {"network": revnet.RevNetParams}),
}
"""Name -> (class, classes of its fields that are trees themselves), for reading a saved space."""


def random_embedding(task: Task, dim: int, *, key: Key[Array, ""]) -> RandomEmbedding:
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


def initial_design(
    space: SearchSpace, task: Task, n: int, *, key: Key[Array, ""]
) -> Float[Array, "n d"]:
    """Uniform points of the space's own domain."""
    return sample(space.domain(task), n, key=key)


@jax.jit
def decode(space: Any, domain: Domain, u: Any) -> Any:
    """`u [S, q, d]` to `(x [S, q, D], clipped [S, q])`."""
    return jax.vmap(lambda s, block: jax.vmap(partial(s.decode, domain))(block))(space, u)


@jax.jit
def encode(space: Any, x: Any) -> Any:
    """`x [S, q, D]` to `u [S, q, d]`."""
    return jax.vmap(lambda s, block: jax.vmap(s.encode)(block))(space, x)
