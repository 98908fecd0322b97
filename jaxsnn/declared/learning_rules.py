"""Rules by which the weights of a projection learn: pair, triplet and reward-modulated STDP.

All take the arriving spikes as `[n_pre, 1]`, or as `[n_pre, n_post]` where each edge has its own
delay, and one number per postsynaptic neuron. Traces take this step's spikes before pairs are
counted, so a pair in the same step counts both ways, as in `jaxsnn.stdp_step`; both changes of a
step are added and then applied within the bounds by `jaxsnn.apply_reward`.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn._checks import (
    concrete,
    default_float,
    require,
    require_choice,
    require_finite,
    require_positive,
)
from jaxsnn.declared.membranes import Constant
from jaxsnn.plasticity import apply_reward


class PairTraces(NamedTuple):
    """Traces of pre and post, and the eligibility where a reward is waited for."""

    plus: Float[Array, "n_pre k"]
    minus: Float[Array, "1 n_post"]
    z: Float[Array, "n_pre n_post"] | None


class TripletTraces(NamedTuple):
    """Fast and slow traces of pre (`r1`, `r2`) and of post (`o1`, `o2`) [1]."""

    r1: Float[Array, "n_pre k"]
    r2: Float[Array, "n_pre k"]
    o1: Float[Array, "1 n_post"]
    o2: Float[Array, "1 n_post"]


def _static(default: str) -> Any:
    return dataclasses.field(default=default, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Bounded:
    """What all rules share: where weights may be, and how a change depends on them.

    Attributes:
        w_min, w_max: bounds, in the unit of the weight.
        dependence: "additive", or "multiplicative": a change is a share of the weight.
        bounds: "hard" or "soft", see `jaxsnn.apply_reward`.
    """

    rewarded: ClassVar[bool] = False
    times: ClassVar[tuple[str, ...]] = ()
    sizes: ClassVar[tuple[str, ...]] = ()

    w_min: Constant = 0.0
    w_max: Constant = 5.0
    dependence: str = _static("additive")
    bounds: str = _static("hard")

    def check(self) -> None:
        """Refuse times that are not positive, sizes that are not finite, bounds in disorder."""
        require_choice("dependence", self.dependence, ("additive", "multiplicative"))
        require_choice("bounds", self.bounds, ("hard", "soft"))
        for name in self.times:
            require_positive(name, getattr(self, name), "give it in seconds, 20e-3 for 20 ms")
        for name in (*self.sizes, "w_min", "w_max"):
            require_finite(name, getattr(self, name), "give a number in the unit of the weight")
        low, high = concrete(self.w_min), concrete(self.w_max)
        if low is not None and high is not None:
            require(
                bool((low < high).all()),
                f"w_min={self.w_min}: expected less than w_max = {self.w_max}; exchange them",
            )
            require(
                bool((low >= 0).all()),
                f"w_min={self.w_min}: expected >= 0: weights are magnitudes; give the sign to the "
                "population",
            )

    def changed(self, weights: Array, drive: Array) -> Array:
        """The weights after a change, by the rule's dependence and within its bounds."""
        return apply_reward(
            weights,
            drive,
            self.w_min,
            self.w_max,
            rule=self.dependence,  # type: ignore[arg-type]  # checked above
            bounds=self.bounds,  # type: ignore[arg-type]
        )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PairSTDP(Bounded):
    r"""Every pair of spikes changes the weight at once.

    .. math:: d = P^+ \Phi_{post} + P^- \Phi_{pre}, \qquad
        \tau_\pm \dot P^\pm = -P^\pm + \tau_\pm A_\pm \Phi

    Source: Song, Miller and Abbott (2000), Nature Neuroscience 3(9); all pairs.

    Attributes:
        a_plus, a_minus: change of a causal and (negative) of an anti-causal pair, in the unit of
            the weight, or as a share of it where `dependence` is multiplicative.
        tau_plus, tau_minus: time constants of the two windows [s].
    """

    times: ClassVar[tuple[str, ...]] = ("tau_plus", "tau_minus")
    sizes: ClassVar[tuple[str, ...]] = ("a_plus", "a_minus")

    a_plus: Constant = 0.05
    a_minus: Constant = -0.0525
    tau_plus: Constant = 20e-3
    tau_minus: Constant = 20e-3

    def init(self, shape: tuple[int, int], n_post: int) -> PairTraces:
        """No spikes so far; `shape` is that of the arriving spikes."""
        dtype = default_float()
        return PairTraces(jnp.zeros(shape, dtype), jnp.zeros((1, n_post), dtype), None)

    def step(
        self,
        state: PairTraces,
        weights: Float[Array, "n_pre n_post"],
        arrived: Float[Array, "n_pre k"],
        post: Float[Array, " n_post"],
        reward: Any,
        dt: float,
    ) -> tuple[PairTraces, Float[Array, "n_pre n_post"]]:
        """One step of the traces and of the weights; `reward` is not used."""
        state, pairs = self._pairs(state, arrived, post, dt)
        return state, self.changed(weights, pairs)

    def _pairs(
        self, state: PairTraces, arrived: Array, post: Array, dt: float
    ) -> tuple[PairTraces, Array]:
        fired = post[None, :]
        plus = state.plus * jnp.exp(-dt / self.tau_plus) + self.a_plus * arrived
        minus = state.minus * jnp.exp(-dt / self.tau_minus) + self.a_minus * fired
        return PairTraces(plus, minus, state.z), plus * fired + arrived * minus


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RewardSTDP(PairSTDP):
    r"""Reward-modulated STDP: pairs feed an eligibility, a reward turns it into a change.

    .. math:: \tau_z \dot z = -z + \xi, \qquad \dot w = \gamma r z \;(\times w)

    Step for step `jaxsnn.stdp_step` and `jaxsnn.apply_reward`; the reward of a step meets the
    eligibility after this step's spikes.

    Source: Shim (2020), Eq. 2.3-2.8.

    Attributes:
        tau_z: time constant of the eligibility [s].
        gamma: learning rate.
    """

    rewarded: ClassVar[bool] = True
    times: ClassVar[tuple[str, ...]] = ("tau_plus", "tau_minus", "tau_z")
    sizes: ClassVar[tuple[str, ...]] = ("a_plus", "a_minus", "gamma")

    a_plus: Constant = 1.0
    a_minus: Constant = -1.0
    tau_z: Constant = 25e-3
    gamma: Constant = 1e-3

    def init(self, shape: tuple[int, int], n_post: int) -> PairTraces:
        """No spikes so far, no eligibility."""
        state = super().init(shape, n_post)
        return state._replace(z=jnp.zeros((shape[0], n_post), state.plus.dtype))

    def step(
        self,
        state: PairTraces,
        weights: Float[Array, "n_pre n_post"],
        arrived: Float[Array, "n_pre k"],
        post: Float[Array, " n_post"],
        reward: Float[Array, "n_pre n_post"],
        dt: float,
    ) -> tuple[PairTraces, Float[Array, "n_pre n_post"]]:
        """One step of traces, eligibility and weights under a reward for each edge."""
        state, pairs = self._pairs(state, arrived, post, dt)
        assert state.z is not None  # `init` of this class makes one
        z = state.z * jnp.exp(-dt / self.tau_z) + pairs / self.tau_z
        return state._replace(z=z), self.changed(weights, self.gamma * dt * reward * z)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TripletSTDP(Bounded):
    r"""Triplets of spikes, all to all.

    .. math:: w \mathrel{-}= o_1 (A_2^- + A_3^- r_2) \text{ at pre}, \qquad
        w \mathrel{+}= r_1 (A_2^+ + A_3^+ o_2) \text{ at post}

    with :math:`r_2, o_2` from before the spike and :math:`r_1, o_1` with it (see the module).

    Source: Pfister and Gerstner (2006), Journal of Neuroscience 26(38), Eq. 3 and 4; the default
        amplitudes are those of its full model for visual cortex, all to all.

    Attributes:
        a2_plus, a3_plus, a2_minus, a3_minus: amplitudes of pairs and triplets, all >= 0.
        tau_plus, tau_x: of the presynaptic traces `r1` and `r2` [s].
        tau_minus, tau_y: of the postsynaptic traces `o1` and `o2` [s].
    """

    times: ClassVar[tuple[str, ...]] = ("tau_plus", "tau_x", "tau_minus", "tau_y")
    sizes: ClassVar[tuple[str, ...]] = ("a2_plus", "a3_plus", "a2_minus", "a3_minus")

    a2_plus: Constant = 5e-10
    a3_plus: Constant = 6.2e-3
    a2_minus: Constant = 7e-3
    a3_minus: Constant = 2.3e-4
    tau_plus: Constant = 16.8e-3
    tau_x: Constant = 101e-3
    tau_minus: Constant = 33.7e-3
    tau_y: Constant = 125e-3

    def init(self, shape: tuple[int, int], n_post: int) -> TripletTraces:
        """No spikes so far; `shape` is that of the arriving spikes."""
        pre = jnp.zeros(shape, default_float())
        post = jnp.zeros((1, n_post), default_float())
        return TripletTraces(r1=pre, r2=pre, o1=post, o2=post)

    def step(
        self,
        state: TripletTraces,
        weights: Float[Array, "n_pre n_post"],
        arrived: Float[Array, "n_pre k"],
        post: Float[Array, " n_post"],
        reward: Any,
        dt: float,
    ) -> tuple[TripletTraces, Float[Array, "n_pre n_post"]]:
        """One step of the traces and of the weights; `reward` is not used."""
        fired = post[None, :]
        r1 = state.r1 * jnp.exp(-dt / self.tau_plus) + arrived
        o1 = state.o1 * jnp.exp(-dt / self.tau_minus) + fired
        r2 = state.r2 * jnp.exp(-dt / self.tau_x)
        o2 = state.o2 * jnp.exp(-dt / self.tau_y)
        growth = r1 * (fired * (self.a2_plus + self.a3_plus * o2))
        decline = (arrived * (self.a2_minus + self.a3_minus * r2)) * o1
        new = TripletTraces(r1=r1, r2=r2 + arrived, o1=o1, o2=o2 + fired)
        return new, self.changed(weights, growth - decline)


Rule = PairSTDP | RewardSTDP | TripletSTDP
