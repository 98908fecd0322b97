"""Short-term plasticity: a synapse that tires and recovers, or gains with use."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn._checks import concrete, default_float, require, require_positive
from jaxsnn.declared.membranes import Constant


class Resources(NamedTuple):
    """Share in use `u` and share at hand `x` [1], `[n_pre, 1]` or `[n_pre, n_post]`."""

    u: Float[Array, "n_pre k"]
    x: Float[Array, "n_pre k"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TsodyksMarkram:
    r"""Facilitation and depression; a spike carries the weight times `u x`.

    .. math:: \tau_f \dot u = -u, \quad \tau_d \dot x = 1 - x; \qquad
        \text{at a spike } u \mathrel{+}= U (1 - u), \; x \mathrel{-}= u x

    `u` rises before the release, `x` falls after it. Decays are exact.

    Source: Tsodyks, Pawelzik and Markram (1998), Neural Computation 10(4).

    Attributes:
        use: `U`, share that a first spike uses [1].
        tau_f: time constant of the facilitation [s].
        tau_d: time constant of the recovery [s].
    """

    use: Constant = 0.2
    tau_f: Constant = 0.5
    tau_d: Constant = 0.2

    def check(self) -> None:
        """Refuse shares outside of 0 to 1 and times that are not positive."""
        for name in ("tau_f", "tau_d"):
            require_positive(name, getattr(self, name), "give it in seconds, 0.2 for 200 ms")
        use = concrete(self.use)
        require(
            use is None or bool(((use > 0) & (use <= 1)).all()),
            f"use={self.use}: expected a share above 0 and up to 1; take 0.2 to facilitate, 0.6 to "
            "depress",
        )

    def init(self, shape: tuple[int, int]) -> Resources:
        """Rested synapses: nothing in use, all at hand."""
        dtype = default_float()
        return Resources(u=jnp.zeros(shape, dtype), x=jnp.ones(shape, dtype))

    def release(
        self, state: Resources, arrived: Float[Array, "n_pre k"], dt: float
    ) -> tuple[Resources, Float[Array, "n_pre k"]]:
        """One step: the new resources, and the share `u x` that each arriving spike releases."""
        u = state.u * jnp.exp(-dt / self.tau_f)
        x = 1.0 - (1.0 - state.x) * jnp.exp(-dt / self.tau_d)
        u = u + self.use * (1.0 - u) * arrived
        released = u * x * arrived
        return Resources(u=u, x=x - released), released
