"""Features of a reversible network trained on gradients as a search space about the incumbent."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from failure import level_sets, revnet
from failure.models.domains import Domain, box, project
from failure.search.task import Task


class LevelSetFeatures(NamedTuple):
    r"""Active features about those of the incumbent, its inactive ones kept.

    .. math:: x = P_\Omega\big(g^{-1}(m + 2 r u,\; z^*_{inact})\big)

    Attributes:
        rotation, scale, network: of `failure.level_sets.LevelSets`.
        middle: `[d]`, m, active features of the incumbent.
        width: 2 r, of the trust region in units of the features.
        rest: `[D - d]`, the incumbent's inactive features.

    Source: Zhang, Zhang and Hinkle (2019) for the features; Eriksson et al. (2019) for a trust
    region about the incumbent.
    """

    rotation: Array
    scale: Array
    network: revnet.RevNetParams
    middle: Array
    width: float | Array
    rest: Array

    def _map(self) -> level_sets.LevelSets:
        return level_sets.LevelSets(self.rotation, self.scale, self.network)

    def domain(self, task: Task) -> Domain:
        """The unit cube, which is the trust region."""
        half = jnp.full((self.middle.shape[-1],), 0.5)
        return box(-half, half)

    def decode(
        self, domain: Domain, u: Float[Array, " d"]
    ) -> tuple[Float[Array, " D"], Float[Array, ""]]:
        """Move the active features, keep the others, run the network backwards."""
        z = jnp.concatenate([self.middle + self.width * u, self.rest])
        raw = level_sets.samples(self._map(), z[None])[0]
        x = project(domain, raw)
        return x, jnp.mean((jnp.abs(x - raw) > 1e-9).astype(x.dtype))

    def encode(self, x: Float[Array, " D"]) -> Float[Array, " d"]:
        """The active features."""
        z = level_sets.features(self._map(), x[None])[0]
        return (z[: self.middle.shape[0]] - self.middle) / self.width
