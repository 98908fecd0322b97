"""A spiking network as an agent: what it does with a reading, what it learns from the outcome.

An agent is three pure functions, `init`, `act` and `learn`, so that `trials.py` can drive any other
agent as well. All take the agent's parameters first; nothing is kept in the agent itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxsnn import network
from jaxsnn.config import NetworkConfig, NetworkParams, check_network
from jaxsnn.critic import credited, features, shaped_reward, temporal_difference
from jaxsnn.encoding import poisson_spikes
from jaxsnn.network import Eligibility, NetworkState
from jaxsnn.network_input import group_input, input_rates
from jaxsnn.reinforcement import no_eligibility
from jaxsnn.rewards import motor_rewards, scale_by_remaining_turn, terminal_reward
from jaxsnn.turn_goal import turn_reward, update_recent_turn, way_reward
from jaxsnn.window import STDPKernel
from jaxsnn.world import Outcome, Reading


class Agent(NamedTuple):
    """What `trials.py` needs of an agent; `P`, `S` and `M` are pytrees of the agent's own.

    Attributes:
        init: `(key, P) -> S`, a naive agent.
        act: `(P, S, reading, fresh, active, *, key) -> (S, steering, M, info)`. `fresh` is true in
            the first step of a trial. With `active` false nothing may be learnt. Steering is in
            degrees, positive to the left; `info` is a vector that trials average.
        learn: `(P, S, M, outcome, next_reading, active) -> S`; the reading is None unless
            `needs_next`.
        finite: `S -> bool`, false once something in the agent is not a number.
        needs_next: whether `learn` looks at the reading after the move.
        info: names of the entries of `info`.
    """

    init: Callable[..., Any]
    act: Callable[..., Any]
    learn: Callable[..., Any]
    finite: Callable[..., Any]
    needs_next: bool = False
    info: tuple[str, ...] = ()


RewardFunction = Callable[[NetworkParams, Reading, Array, Array], Array]
"""`(params, reading, recent_turn, turn) -> [2]`; see `snn_agent`."""


class SNNParams(NamedTuple):
    """`NetworkParams` and what is worked out from them once; made by `snn_params`."""

    network: NetworkParams
    kernel: STDPKernel


class SNNMemory(NamedTuple):
    """Eligibility of the last window, the reading acted on, the turns before, and this turn."""

    eligibility: Eligibility
    reading: Reading
    recent_turn: Array
    turn: Array


def snn_params(config: NetworkConfig, params: NetworkParams) -> SNNParams:
    """Parameters of the agent: checked constants and the pair kernel.

    Returns:
        SNNParams: the constants, and the kernel of one window of `config.hold_steps`.

    Raises:
        ValueError: a constant is not acceptable (traced constants are not checked).
    """
    check_network(config, params)
    return SNNParams(network=params, kernel=network.kernel(config, params))


def steering_angle(params: NetworkParams, rates: Float[Array, "2"]) -> Float[Array, ""]:
    r"""Turn of the robot from the firing rates of the motors [deg], positive to the left.

    .. math:: \theta = g\,(b_r\, freq_r - b_l\, freq_l)

    Args:
        params: NetworkParams; `steering_gain` is `g` [deg/Hz], `right_motor` and `left_motor` are
            `b_r` and `b_l`, all 1 in the source.
        rates: of the left and the right motor neuron [Hz].

    Source: Shim (2020), section 2.4.3. The sign is that of our world: the source writes
        `freq_l - freq_r` and steers left when that is negative.
    """
    left, right = params.left_motor * rates[0], params.right_motor * rates[1]
    return params.steering_gain * (right - left)


def _where(flag: bool | Array, yes: Callable[[], Any], no: Callable[[], Any]) -> Any:
    """One of two results; where the flag is only known when the program runs, both are in it."""
    if isinstance(flag, bool):
        return yes() if flag else no()
    return jax.lax.cond(flag, yes, no)


def snn_agent(
    config: NetworkConfig,
    *,
    plastic: bool | Bool[Array, ""] = True,
    reward: RewardFunction | None = None,
) -> Agent:
    """The network as an agent.

    In a control step the inputs fire at the rates of the reading for `config.control_steps`, in
    windows of `config.hold_steps`. Rewards for avoidance and target hold during the step and change
    the weights after each window. Collision or arrival, known after the move, replaces them in the
    last window.

    Args:
        config: NetworkConfig.
        plastic: False for frozen weights: nothing is learnt, and traces are not computed. A traced
            scalar for one program that does either.
        reward: a function of one's own in place of the rewards on the way,
            `(params, reading, recent_turn, turn) -> [left, right]`: NetworkParams, what the network
            saw, the leaky mean of the turns before [deg], and the turn that the motors ask for
            [deg, positive to the left]. Collision and arrival keep theirs.

    Returns:
        Agent whose parameters are `SNNParams` and whose state is `NetworkState`.
    """
    n_windows = config.control_steps // config.hold_steps
    table = config.rates
    learns = plastic is not False
    foresees = learns and (config.critic == "td" or config.shaping != "none")

    def reward_of(
        constants: NetworkParams, reading: Reading, window: Eligibility, recent_turn: Array
    ) -> Array:
        turn = steering_angle(constants, window.output_count / window.duration)
        if reward is not None:
            return reward(constants, reading, recent_turn, turn)
        if config.guidance == "none":
            return jnp.zeros_like(window.output_count)
        if config.guidance == "way":
            return way_reward(constants.goal, reading, turn)
        if config.guidance == "graded":
            return turn_reward(constants.goal, reading, recent_turn, turn)
        rewards = motor_rewards(
            constants.reward, reading.sonar, reading.distance, reading.angle, turn
        )
        return scale_by_remaining_turn(constants.reward, rewards, turn)

    def foresee(
        constants: NetworkParams,
        state: NetworkState,
        memory: SNNMemory,
        after: Reading,
        end: Array,
        ended: Array,
        active: Array,
    ) -> tuple[NetworkState, Array]:
        """The step's reward with its potential; with a critic what it did not expect of it."""
        shaped = shaped_reward(constants.critic, memory.reading, after, config.shaping)
        reward = jnp.where(ended, end, shaped)
        if state.critic is None:
            return state, reward

        def sensed(reading: Reading, recent_turn: Array) -> Array:
            return features(group_input(config, constants, reading, recent_turn, table=table))

        critic, error = temporal_difference(
            constants.critic, state.critic, sensed(memory.reading, memory.recent_turn),
            sensed(after, state.recent_turn), reward, ended,
        )  # fmt: skip
        kept = jax.tree.map(lambda a, b: jnp.where(active, a, b), critic, state.critic)
        return state._replace(critic=kept), error

    def learning_share(constants: NetworkParams, state: NetworkState) -> Array:
        return (1.0 / (1.0 + state.updates / constants.anneal)).astype(state.hidden.v.dtype)

    def init(key: Key[Array, ""], params: SNNParams) -> NetworkState:
        return network.init(key, config, params.network)

    def act(
        params: SNNParams,
        state: NetworkState,
        reading: Reading,
        fresh: Bool[Array, ""],
        active: Bool[Array, ""],
        *,
        key: Key[Array, ""],
    ) -> tuple[NetworkState, Float[Array, ""], SNNMemory, Float[Array, "3"]]:
        constants = params.network
        recent_turn = jnp.where(fresh, 0.0, state.recent_turn)
        rates = input_rates(config, constants, reading, recent_turn, table=table)
        state = network.reset_membranes(constants, state, fresh)
        if state.critic is not None:
            trace = jnp.where(fresh, 0.0, state.critic.trace).astype(state.critic.trace.dtype)
            state = state._replace(critic=state.critic._replace(trace=trace))
        baselines = state.baseline_input, state.baseline_hidden

        def draw(index: Array | int) -> Array:
            window_key = jax.random.fold_in(key, index)
            return poisson_spikes(rates, config.hold_steps, dt=config.dt, key=window_key)

        def run(
            state: NetworkState, index: Array | int, keep: Any, before: Eligibility
        ) -> tuple[NetworkState, Eligibility, network.Spikes]:
            pre = draw(index)
            state, spikes = network.fire(config, constants, state, pre)

            def remember() -> tuple[NetworkState, Eligibility]:
                new, eligibility = network.remember(
                    config, constants, params.kernel, state, pre, spikes, keep
                )
                return new, eligibility._replace(duration=duration)

            state, eligibility = _where(plastic, remember, lambda: (state, before))
            return state, eligibility, spikes

        def count(spikes: network.Spikes) -> Array:
            hidden = jnp.sum(spikes.hidden) / config.n_hidden
            return jnp.append(jnp.sum(spikes.output, axis=0), hidden)

        dtype = state.hidden.v.dtype
        keep = 1.0 - fresh.astype(dtype)
        learning = active.astype(dtype) * learning_share(constants, state)
        total = jnp.zeros((3,), dtype)
        duration = jnp.asarray(config.hold_steps * config.dt, dtype)
        eligibility = no_eligibility(state.weights, duration)
        if n_windows == 1:
            state, eligibility, spikes = run(state, 0, keep, eligibility)
            total = total + count(spikes)
        else:
            # One piece of program for all windows: the eligibility goes round the loop, since the
            # last window's reward has to wait for what comes of the move.
            def body(carry: tuple, index: Array) -> tuple:
                state, before, total = carry
                window_keep = jnp.where(index == 0, keep, 1.0)
                state, eligibility, spikes = run(state, index, window_keep, before)
                if learns:
                    weights = jax.lax.cond(
                        (index < n_windows - 1) & plastic,
                        lambda: network.reinforce(
                            config, constants, state.weights, eligibility,
                            reward_of(constants, reading, eligibility, recent_turn), learning,
                        ),
                        lambda: state.weights,
                    )  # fmt: skip
                    state = state._replace(weights=weights)
                return (state, eligibility, total + count(spikes)), None

            (state, eligibility, total), _ = jax.lax.scan(
                body, (state, eligibility, total), jnp.arange(n_windows)
            )
        # A robot that waits for the others of its block learns nothing, running means included.
        mine = state.baseline_input, state.baseline_hidden
        mine = jax.tree.map(lambda new, old: jnp.where(active, new, old), mine, baselines)
        state = state._replace(baseline_input=mine[0], baseline_hidden=mine[1])
        firing = total / (config.control_steps * config.dt)
        limit = constants.max_turn
        steering = jnp.clip(steering_angle(constants, firing[:2]), -limit, limit)
        turned = update_recent_turn(constants.goal, recent_turn, steering)
        state = state._replace(recent_turn=turned.astype(state.recent_turn.dtype))
        return state, steering, SNNMemory(eligibility, reading, recent_turn, steering), firing

    def learn(
        params: SNNParams,
        state: NetworkState,
        memory: SNNMemory,
        outcome: Outcome,
        next_reading: Reading | None,
        active: Bool[Array, ""],
    ) -> NetworkState:
        constants = params.network

        def rewarded() -> NetworkState:
            observed = memory.reading
            if config.reward_timing == "after" and next_reading is not None:
                observed = next_reading
            given = reward_of(constants, observed, memory.eligibility, memory.recent_turn)
            end = terminal_reward(constants.reward, outcome.collided, outcome.arrived)
            ended = outcome.collided | outcome.arrived
            held = state
            if foresees and next_reading is not None:
                held, error = foresee(constants, state, memory, next_reading, end, ended, active)
                given = jnp.where(ended, 0.0, given) + credited(
                    constants.critic, error, memory.turn, config.credit
                )
            else:
                given = jnp.where(ended, end, given)
            going = active.astype(held.weights.hidden.dtype)
            learning = going * learning_share(constants, held)
            weights = network.reinforce(
                config, constants, held.weights, memory.eligibility, given, learning
            )
            return held._replace(weights=weights, updates=held.updates + going)

        return _where(plastic, rewarded, lambda: state)

    def finite(state: NetworkState) -> Bool[Array, ""]:
        # A weight that is not a number makes the potential of its neuron one that is not.
        return jnp.all(jnp.isfinite(state.hidden.v)) & jnp.all(jnp.isfinite(state.output.v))

    return Agent(
        init=init,
        act=act,
        learn=learn,
        finite=finite,
        needs_next=foresees or (learns and config.reward_timing == "after"),
        info=("left motor [Hz]", "right motor [Hz]", "hidden [Hz]"),
    )
