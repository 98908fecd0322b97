"""What a spike does at a synapse: a jump of the potential, a current, or a conductance.

A receptor gives `(current, conductance)` [nA, uS] to the membrane, which feels
`current - conductance * v`. What arrives in a step counts from the next step on.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn._checks import default_float, require_finite, require_positive
from jaxsnn.declared.membranes import Constant


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Delta:
    """The potential jumps by the weight [mV]; nothing is remembered."""

    def check(self) -> None:
        """Nothing to refuse."""

    def init(self, n: int) -> None:
        """No state."""

    def pull(self, state: None) -> tuple[float, float]:
        """No current: the jump goes to the membrane as it arrives."""
        return 0.0, 0.0

    def update(self, state: None, arriving: Float[Array, " n"], dt: float) -> None:
        """No state."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Exponential:
    r"""A current that jumps by the weight [nA] and decays: :math:`\tau \dot I = -I`, exactly.

    Attributes:
        tau: time constant [s].
    """

    tau: Constant = 5e-3

    def check(self) -> None:
        """Refuse a time constant that is not positive."""
        require_positive("tau", self.tau, "give it in seconds, 5e-3 for five milliseconds")

    def init(self, n: int) -> Float[Array, " n"]:
        """No current, `[n]`."""
        return jnp.zeros((n,), default_float())

    def pull(self, state: Float[Array, " n"]) -> tuple[Any, Any]:
        """The current [nA], and no conductance."""
        return state, 0.0

    def update(
        self, state: Float[Array, " n"], arriving: Float[Array, " n"], dt: float
    ) -> Float[Array, " n"]:
        """`I exp(-dt/tau)` plus what arrives."""
        return state * jnp.exp(-dt / self.tau) + arriving


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Conductance(Exponential):
    r"""A conductance that jumps by the weight [uS] and decays; it drives towards `reversal`.

    .. math:: I = g (E - v), \qquad \tau \dot g = -g

    Attributes:
        tau: time constant [s].
        reversal: `E` [mV]; below the resting potential the synapse inhibits.
    """

    reversal: Constant = 60.0

    def check(self) -> None:
        """As for the current; the reversal potential is finite."""
        super().check()
        require_finite("reversal", self.reversal, "give it in millivolts")

    def pull(self, state: Float[Array, " n"]) -> tuple[Any, Any]:
        """`(g E, g)`."""
        return state * self.reversal, state


Receptor = Delta | Exponential | Conductance
