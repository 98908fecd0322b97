"""Neuron models of declared networks: each advances by a step, then takes what arrives in it.

A model is a frozen record of constants and a pytree, so its numbers can be traced and batched. The
two halves of a step are apart because the spikes of all populations must be known before any of
them is delivered: `advance` (leak, current, threshold), then `receive` (jumps, reset).
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsnn._checks import (
    concrete,
    default_float,
    require,
    require_choice,
    require_finite,
    require_positive,
)
from jaxsnn.neurons import LIFParams, check_lif

Constant = Any
"""A number or an array over the neurons; anything while jax takes a tree apart."""


@runtime_checkable
class Neuron(Protocol):
    """What a neuron model of one's own has to offer; its state has a leaf `v`, `[n]` [mV]."""

    def check(self, dt: float) -> None:
        """Refuse constants that cannot work with steps of `dt` [s]."""

    def init(self, n: int) -> Any:
        """`n` neurons at rest."""

    def advance(self, state: Any, current: Any, conductance: Any, dt: float) -> tuple[Any, Any]:
        """Integrate over `dt` under `current - conductance * v`; the state and who fired."""

    def receive(self, state: Any, spikes: Any, jump: Any, dt: float) -> Any:
        """Add the jumps [mV] that arrive in this step, then reset who fired."""


class LIFCells(NamedTuple):
    """Membrane potential [mV], refractory time left [s], rise of the threshold [mV]."""

    v: Float[Array, " n"]
    refractory: Float[Array, " n"]
    theta: Float[Array, " n"] | None


class IzhikevichCells(NamedTuple):
    """Membrane potential [mV] and recovery variable `u` [mV/ms]."""

    v: Float[Array, " n"]
    u: Float[Array, " n"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LIF:
    r"""Leaky integrate-and-fire neuron.

    .. math:: \tau_m \dot v = v_{rest} - v + R (I + \sum g (E - v))

    Euler: the step of `jaxsnn.lif_step`. Exact: with `I` and `g` held over the step, which is exact
    for a constant current and the exponential Euler rule else.

    Attributes:
        tau_m, v_rest, v_reset, v_th, resistance, t_ref: as in `jaxsnn.LIFParams` [s, mV, MOhm].
        method: "euler" or "exact".
    """

    tau_m: Constant = 20e-3
    v_rest: Constant = 0.0
    v_reset: Constant = 0.0
    v_th: Constant = 15.0
    resistance: Constant = 1.0
    t_ref: Constant = 2e-3
    method: str = dataclasses.field(default="euler", metadata={"static": True})

    def check(self, dt: float) -> None:
        """Refuse what `jaxsnn.neurons.check_lif` refuses, and an unknown method."""
        require_choice("method", self.method, ("euler", "exact"))
        constants = LIFParams(
            self.tau_m, self.v_rest, self.v_reset, self.v_th, self.resistance, self.t_ref
        )
        if self.method == "exact":  # stable at any step: only the signs of times matter
            require_positive("tau_m", self.tau_m, "give it in seconds")
            constants = constants._replace(tau_m=4.0 * dt)
        check_lif(constants, dt=dt)

    def init(self, n: int) -> LIFCells:
        """`n` neurons at rest, leaves `[n]`."""
        zero = jnp.zeros((n,), default_float())
        return LIFCells(v=zero + self.v_rest, refractory=zero, theta=None)

    def advance(
        self,
        state: LIFCells,
        current: Float[Array, " n"],
        conductance: Float[Array, " n"],
        dt: float,
    ) -> tuple[LIFCells, Bool[Array, " n"]]:
        """Leak, current [nA], conductance [uS] and threshold."""
        left = jnp.maximum(state.refractory - dt, 0.0)
        active = _active(left, dt)
        source = self.v_rest + self.resistance * current
        leak = 1.0 + self.resistance * conductance
        if self.method == "euler":
            v = state.v + (dt / self.tau_m) * (source - leak * state.v)
        else:
            target = source / leak
            v = target + (state.v - target) * jnp.exp(-dt * leak / self.tau_m)
        v = jnp.where(active, v, state.v)
        theta = self._decayed(state.theta, dt)
        threshold = self.v_th if theta is None else self.v_th + theta
        return LIFCells(v, left, theta), active & (v > threshold)

    def receive(
        self, state: LIFCells, spikes: Bool[Array, " n"], jump: Float[Array, " n"], dt: float
    ) -> LIFCells:
        """Jumps [mV], lost on refractory neurons; reset, and the refractory time begins."""
        v = jnp.where(_active(state.refractory, dt), state.v + jump, state.v)
        v = jnp.where(spikes, self.v_reset, v)
        # Whole steps, rounded down, as in jaxsnn.lif_step.
        pause = jnp.floor(jnp.asarray(self.t_ref, v.dtype) / dt + 1e-3) * dt
        left = jnp.where(spikes, pause, state.refractory)
        return LIFCells(v, left, self._raised(state.theta, spikes))

    def _decayed(self, theta: Array | None, dt: float) -> Array | None:
        return None

    def _raised(self, theta: Array | None, spikes: Array) -> Array | None:
        return None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class AdaptiveLIF(LIF):
    r"""A LIF neuron whose threshold jumps with each spike of its own and decays.

    .. math:: \tau_\theta \dot\theta = -\theta, \quad \theta \mathrel{+}= \theta_{jump}
        \text{ at a spike}; \quad \text{fires where } v > v_{th} + \theta

    The decay is exact and goes on through the refractory time.

    Attributes:
        tau_theta: time constant of the threshold [s].
        theta_jump: its rise with a spike [mV].
    """

    tau_theta: Constant = 100e-3
    theta_jump: Constant = 2.0

    def check(self, dt: float) -> None:
        """As for LIF; the threshold needs a positive time constant and a finite rise."""
        super().check(dt)
        require_positive("tau_theta", self.tau_theta, "give it in seconds, 0.1 for 100 ms")
        require_finite("theta_jump", self.theta_jump, "give it in millivolts")

    def init(self, n: int) -> LIFCells:
        """`n` neurons at rest with the resting threshold."""
        cells = super().init(n)
        return cells._replace(theta=jnp.zeros_like(cells.v))

    def _decayed(self, theta: Array | None, dt: float) -> Array | None:
        return None if theta is None else theta * jnp.exp(-dt / self.tau_theta)

    def _raised(self, theta: Array | None, spikes: Array) -> Array | None:
        return None if theta is None else jnp.where(spikes, theta + self.theta_jump, theta)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Izhikevich:
    r"""Izhikevich's neuron: Euler steps of both variables, or the steps of his paper.

    .. math:: \dot v = 0.04 v^2 + 5 v + 140 - u + I, \quad \dot u = a (b v - u) \quad
        [\text{per ms}]; \qquad v \ge v_{peak}: v \leftarrow c, u \leftarrow u + d

    A current of 1 (the unit of the source's `I`) is 1 mV/ms. No refractory time. Euler takes both
    variables from before the step; "paper" takes two half steps for `v`, and then `u` from the
    potential after them, as the program in the source does with steps of 1 ms.

    Source: Izhikevich (2003), IEEE Transactions on Neural Networks 14(6).

    Attributes:
        a [1/ms], b [1/ms], c [mV], d [mV/ms]: regular spiking by default.
        v_peak: where a spike ends [mV].
        method: "euler" or "paper".
    """

    a: Constant = 0.02
    b: Constant = 0.2
    c: Constant = -65.0
    d: Constant = 8.0
    v_peak: Constant = 30.0
    method: str = dataclasses.field(default="euler", metadata={"static": True})

    def check(self, dt: float) -> None:
        """Refuse steps above 1 ms, with which the quadratic term runs away, and no numbers."""
        require_choice("method", self.method, ("euler", "paper"))
        for name in ("a", "b", "c", "d", "v_peak"):
            require_finite(name, getattr(self, name), "take the constants of the 2003 paper")
        require(
            dt <= 1e-3,
            f"dt={dt}: expected at most 1e-3 s for Izhikevich's neuron; take a smaller step",
        )
        low, high = concrete(self.c), concrete(self.v_peak)
        if low is not None and high is not None:
            require(
                bool((low < high).all()),
                f"c={self.c}: expected less than v_peak = {self.v_peak}; lower c",
            )

    def init(self, n: int) -> IzhikevichCells:
        """`n` neurons at the potential of the reset, with `u = b v`."""
        v = jnp.zeros((n,), default_float()) + self.c
        return IzhikevichCells(v=v, u=self.b * v)

    def advance(
        self,
        state: IzhikevichCells,
        current: Float[Array, " n"],
        conductance: Float[Array, " n"],
        dt: float,
    ) -> tuple[IzhikevichCells, Bool[Array, " n"]]:
        """One step of both variables, and the threshold."""
        v, u = state
        ms = 1e3 * dt

        def slope(v: Array) -> Array:
            return 0.04 * v * v + 5.0 * v + 140.0 - u + current - conductance * v

        if self.method == "paper":
            v = v + 0.5 * ms * slope(v)
            v = v + 0.5 * ms * slope(v)
            new = IzhikevichCells(v=v, u=u + ms * self.a * (self.b * v - u))
        else:
            new = IzhikevichCells(v=v + ms * slope(v), u=u + ms * self.a * (self.b * v - u))
        return new, new.v >= self.v_peak

    def receive(
        self, state: IzhikevichCells, spikes: Bool[Array, " n"], jump: Float[Array, " n"], dt: float
    ) -> IzhikevichCells:
        """Jumps [mV], then the reset, which overwrites them where a neuron has fired."""
        v = jnp.where(spikes, self.c, state.v + jump)
        return IzhikevichCells(v=v, u=jnp.where(spikes, state.u + self.d, state.u))


def _active(left: Array, dt: float) -> Array:
    # Half a step of slack: what is left is a multiple of dt only up to rounding.
    return left <= 0.5 * dt
