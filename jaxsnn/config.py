"""The networks S1-S4 as data: sizes and choices, constants, signs and bounds of the synapses."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsnn._checks import (
    concrete,
    default_float,
    require,
    require_choice,
    require_finite,
    require_positive,
    require_whole,
)
from jaxsnn.critic import Credit, CriticParams, Potential, check_critic
from jaxsnn.encoding import GROUPS, AngleCode, InputCode, RateTable, rate_table
from jaxsnn.neurons import LIFParams, check_lif
from jaxsnn.plasticity import Bounds, Rule, STDPParams, check_stdp
from jaxsnn.rewards import RewardParams, check_rewards, reward_params
from jaxsnn.turn_goal import TurnGoalParams, check_turn_goal


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Sizes and choices of a network; a change of any of them compiles anew.

    Attributes:
        rule: "additive" (A-RM-STDP) or "multiplicative" (M-RM-STDP).
        encoding: firing rates of the inputs, "reference" (S1, S2) or "proposed" (S3, S4).
        hidden_exc, hidden_inh: hidden neurons of each kind, both halves together.
        group_exc, group_inh: input neurons of each kind per group.
        dt: step [s].
        control_steps: steps the network runs per control step of the robot; open in the source.
        hold_steps: steps between changes of weights; divides `control_steps`; 1 by definition.
        bounds: "hard" (the source) or "soft".
        w_max_split: the half of the first layer's synapses with the lower bound: those onto
            inhibitory neurons ("post") or from inhibitory inputs ("pre"); the source says "half".
        angle_code: order of the rates of the angle's intervals (`encoding.ANGLE_CODES`).
        reward_timing: the reward of a control step comes from the reading that the network saw
            ("before") or from the one after the move ("after").
        input_code: one input group for each "sensor", whose rate says the interval (the source), or
            one for each "interval" (`encoding.interval_rates`).
        turn_groups: two more input groups fire in proportion to the recent turns to either side.
        guidance: rewards by the "nearest" obstacle (the source), "graded" from all sonars
            (`turn_goal.turn_reward`), by the shortest "way" (`turn_goal.way_reward`), or "none".
        critic: "td": a step's reward is its temporal-difference error (`jaxsnn.critic`).
        credit, shaping: who gets that error, and the potential of a step's reward (`critic`).
        mirror: tie the two halves of the network (`jaxsnn.mirror`).
        n_sonars: of the map's robot (`make_map(sonar_angles=...)`), odd and at least 3. The edges
            of the intervals and the two motors are fixed; the table of Q-learning has five sonars.
        starts: of learning trials, the map's "circles" or "anywhere" (`ways.training_map`).
        engine: what computes a window, "xla" or "native" (`jaxsnn.native`).

    Raises:
        ValueError, TypeError: what makes no network.
    """

    rule: Rule = "multiplicative"
    encoding: Literal["reference", "proposed"] = "proposed"
    hidden_exc: int = 104
    hidden_inh: int = 104
    group_exc: int = 15
    group_inh: int = 15
    dt: float = 1e-3
    control_steps: int = 400
    hold_steps: int = 100
    bounds: Bounds = "hard"
    w_max_split: Literal["post", "pre"] = "post"
    angle_code: AngleCode = "region"
    reward_timing: Literal["before", "after"] = "before"
    input_code: InputCode = "sensor"
    turn_groups: bool = False
    guidance: Literal["nearest", "graded", "way", "none"] = "nearest"
    critic: Literal["none", "td"] = "none"
    credit: Credit = "turn"
    shaping: Potential = "none"
    mirror: bool = False
    n_sonars: int = 5
    starts: Literal["circles", "anywhere"] = "circles"
    engine: Literal["xla", "native"] = "xla"

    def __post_init__(self) -> None:
        """Refuse sizes and choices that make no network."""
        for name in ("hidden_exc", "hidden_inh", "group_exc", "group_inh"):
            n = getattr(self, name)
            require_whole(name, n, 0, "give 0 for none")
            even = n % 2 == 0 or name.startswith("group")
            require(even, f"{name}={n}: expected an even number; it has two halves")
        require(
            self.n_hidden > 0, "hidden_exc=0, hidden_inh=0: expected a hidden neuron; raise one"
        )
        require(self.n_in > 0, "group_exc=0, group_inh=0: expected an input neuron; raise one")
        require_whole("n_sonars", self.n_sonars, 3, "give an odd number, 3 or more")
        odd = self.n_sonars % 2 == 1
        require(odd, f"n_sonars={self.n_sonars}: expected an odd number, 3 or more; add one")
        require_positive("dt", self.dt, "give the step in seconds, 1e-3 for one millisecond")
        for name in ("control_steps", "hold_steps"):
            require_whole(name, getattr(self, name), 1, "give at least one step")
        require(
            self.control_steps % self.hold_steps == 0,
            f"hold_steps={self.hold_steps}: expected a divisor of control_steps = "
            f"{self.control_steps}; choose one",
        )
        choices: dict[str, tuple[Any, ...]] = {
            "rule": ("additive", "multiplicative"),
            "encoding": ("reference", "proposed"),
            "bounds": ("hard", "soft"),
            "w_max_split": ("post", "pre"),
            "reward_timing": ("before", "after"),
            "input_code": tuple(GROUPS),
            "turn_groups": (False, True),
            "guidance": ("nearest", "graded", "way", "none"),
            "critic": ("none", "td"),
            "credit": ("global", "turn"),
            "shaping": ("none", "straight", "way"),
            "mirror": (False, True),
            "starts": ("circles", "anywhere"),
            "engine": ("xla", "native"),
        }
        for name, allowed in choices.items():
            require_choice(name, getattr(self, name), allowed)
        rate_table(self.encoding, self.angle_code)
        require(
            not self.mirror or self.input_code == "interval",
            "mirror=True: expected input_code='interval'; the rate of an angle has no mirror image",
        )

    @property
    def n_groups(self) -> int:
        """Input groups."""
        return GROUPS[self.input_code](self.n_sonars) + 2 * self.turn_groups

    @property
    def n_in(self) -> int:
        """Input neurons."""
        return self.n_groups * (self.group_exc + self.group_inh)

    @property
    def n_hidden(self) -> int:
        """Hidden neurons."""
        return self.hidden_exc + self.hidden_inh

    @property
    def n_half(self) -> int:
        """Hidden neurons of one motor."""
        return self.n_hidden // 2

    @property
    def rates(self) -> RateTable:
        """Firing rates of the intervals [Hz]."""
        return rate_table(self.encoding, self.angle_code)


NETWORKS: dict[str, dict[str, Any]] = {
    "S1": {"rule": "additive", "encoding": "reference", "hidden_exc": 210, "hidden_inh": 0},
    "S2": {"rule": "multiplicative", "encoding": "reference", "hidden_exc": 210, "hidden_inh": 0},
    "S3": {"rule": "additive", "encoding": "proposed", "hidden_exc": 104, "hidden_inh": 104},
    "S4": {"rule": "multiplicative", "encoding": "proposed", "hidden_exc": 104, "hidden_inh": 104},
}


class NetworkParams(NamedTuple):
    """What a sweep may vary without compiling anew; leaves are scalars.

    Attributes:
        hidden, output: neurons of the two layers.
        stdp: traces and eligibility.
        reward: rewards.
        gamma: learning rate [1/mV for the multiplicative rule, 1 for the additive one].
        gamma_output: learning rate of the second layer relative to `gamma`.
        w_max: bound of a weight [mV] (Table 2.1).
        w_max_low: bound of the lower half of the first layer [mV] (section 2.4.4).
        w_min: lower bound of a magnitude [mV].
        init_low: initial weights are uniform between this fraction of their bound and the bound.
        gain_input, gain_output: what a weight is multiplied with to give the jump of the potential.
        steering_gain: degrees per Hz of difference between the motors; 1 is the source.
        left_motor, right_motor: what each motor makes of its rate; below 1 it is weak.
        homeostasis: rate of synaptic scaling [1/s]; 0 is the source. While a neuron fires above
            its target rate, its excitatory inputs shrink and its inhibitory ones grow, and the
            other way round below it. Without it, what has grown fires more and grows faster.
        homeostasis_output: rate of the scaling of the second layer relative to `homeostasis`. It is
            what keeps one motor from winning for good.
        centring: share of a presynaptic neuron's mean firing that is taken off before the trace is
            formed; 0 is the source, 1 makes the trace a covariance (see `running_mean`).
        tau_baseline: time constant of that mean [s].
        rate_hidden, rate_output: target rates of the scaling [Hz].
        max_turn: the robot turns by no more than this in a step [deg]; infinite in the source.
        anneal: control steps after which the learning rate is half, `1 / (1 + n / anneal)`;
            infinite in the source.
        interval_rate: of the group that is on, with one group for each interval [Hz].
        turn_rate: of a turn group after turns of 60 degrees [Hz].
        goal: constants of the graded reward.
        critic: constants of the critic and the potential.
    """

    hidden: LIFParams = LIFParams()
    output: LIFParams = LIFParams()
    stdp: STDPParams = STDPParams()
    reward: RewardParams = RewardParams()
    gamma: float | Array = 1e-3
    gamma_output: float | Array = 1.0
    w_max: float | Array = 5.0
    w_max_low: float | Array = 2.5
    w_min: float | Array = 0.0
    init_low: float | Array = 0.0
    gain_input: float | Array = 1.0
    gain_output: float | Array = 1.0
    steering_gain: float | Array = 1.0
    left_motor: float | Array = 1.0
    right_motor: float | Array = 1.0
    homeostasis: float | Array = 0.0
    homeostasis_output: float | Array = 1.0
    centring: float | Array = 0.0
    tau_baseline: float | Array = 20.0
    rate_hidden: float | Array = 25.0
    rate_output: float | Array = 60.0
    max_turn: float | Array = math.inf
    anneal: float | Array = math.inf
    interval_rate: float | Array = 150.0
    turn_rate: float | Array = 100.0
    goal: TurnGoalParams = TurnGoalParams()
    critic: CriticParams = CriticParams()


class Weights(NamedTuple):
    """Magnitudes [mV]: input to hidden `[n_in, n_hidden]`, hidden to motor `[2, n_half]`."""

    hidden: Float[Array, "n_in n_hidden"]
    output: Float[Array, "2 n_half"]


def network_config(name: str, **changes: Any) -> NetworkConfig:
    """The configuration of "S1", "S2", "S3" or "S4" (Table 2.2), with changes.

    Example:
        >>> network_config("S2").n_hidden, network_config("S4").n_hidden
        (210, 208)
    """
    require_choice("model", name, tuple(NETWORKS))
    return NetworkConfig(**{**NETWORKS[name], **changes})


def network_params(config: NetworkConfig, **changes: Any) -> NetworkParams:
    """The source's constants for a configuration, with changes of any field."""
    return NetworkParams(reward=reward_params(config.rule))._replace(**changes)


def check_network(config: NetworkConfig, params: NetworkParams) -> None:
    """Refuse constants with which a network cannot run; call it before compiling.

    Raises:
        ValueError: names the constant, its value and the fix.
    """
    check_lif(params.hidden, dt=config.dt)
    check_lif(params.output, dt=config.dt)
    check_stdp(params.stdp, dt=config.dt)
    check_rewards(params.reward)
    check_turn_goal(params.goal)
    check_critic(params.critic)
    for name in ("max_turn", "anneal"):
        value = concrete(getattr(params, name))
        good = value is None or bool((value > 0).all())
        require(good, f"{name}={value}: expected a number > 0; infinity leaves it out")
    for name in ("interval_rate", "turn_rate"):
        value = concrete(getattr(params, name))
        require_positive(name, getattr(params, name), "give a firing rate in Hz", zero=True)
        require(
            value is None or bool((value * config.dt <= 1.0).all()),
            f"{name}={value}: expected at most one spike per step, {1 / config.dt:g} Hz; lower it",
        )
    require_positive("tau_baseline", params.tau_baseline, "give it in seconds")
    for name in ("w_max", "w_max_low", "gain_input", "gain_output", "rate_hidden", "rate_output"):
        require_positive(name, getattr(params, name), "give it in mV (rates: Hz)")
    sizes = ("gamma", "gamma_output", "w_min", "init_low", "homeostasis", "homeostasis_output",
             "centring", "left_motor", "right_motor")  # fmt: skip
    for name in sizes:
        require_positive(name, getattr(params, name), "give a number >= 0", zero=True)
    require_finite("steering_gain", params.steering_gain, "give degrees per Hz")
    low = concrete(params.w_min)
    for name in ("w_max", "w_max_low"):
        high = concrete(getattr(params, name))
        if low is not None and high is not None:
            require(
                bool((low <= high).all()),
                f"w_min={low.max():g}: expected at most {name} = {high.min():g}; lower it",
            )
    init = concrete(params.init_low)
    if init is not None:
        require(
            bool((init <= 1.0).all()),
            f"init_low={init.max():g}: expected a fraction of the bound, at most 1; lower it",
        )


def neuron_signs(config: NetworkConfig) -> tuple[np.ndarray, np.ndarray]:
    """+1 for excitatory, -1 for inhibitory: input neurons `[n_in]`, hidden neurons `[n_hidden]`."""
    group = np.repeat([1.0, -1.0], [config.group_exc, config.group_inh])
    half = np.repeat([1.0, -1.0], [config.hidden_exc // 2, config.hidden_inh // 2])
    return np.tile(group, config.n_groups).astype(np.float32), np.tile(half, 2).astype(np.float32)


def weight_bounds(config: NetworkConfig, params: NetworkParams) -> Weights:
    """Upper bounds [mV]: `[n_in or 1, n_hidden or 1]` and `[1, 1]`, to broadcast with `Weights`."""
    pre, hidden = neuron_signs(config)
    dtype = default_float()
    high, low = jnp.asarray(params.w_max, dtype), jnp.asarray(params.w_max_low, dtype)
    if config.encoding == "reference":
        first = high[None, None]
    elif config.w_max_split == "post":
        first = jnp.where(hidden[None, :] > 0, high[None, None], low[None, None])
    else:
        first = jnp.where(pre[:, None] > 0, high[None, None], low[None, None])
    return Weights(hidden=first, output=high[None, None])
