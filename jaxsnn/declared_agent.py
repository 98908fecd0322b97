"""A declared network as the driver of a robot: what it senses, how it steers, what teaches it.

`jaxsnn.declared` puts any network together; here one of its inputs takes the robot's readings, one
population of two neurons are the motors, and a reward of one's own reaches every synapse that
learns by `RewardSTDP` with the sign of its effect on each motor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from jaxsnn import declared
from jaxsnn._checks import require, require_choice, require_whole
from jaxsnn.agents import Agent
from jaxsnn.encoding import poisson_spikes
from jaxsnn.world import Outcome, Reading

Encode = Callable[[Reading], Array]
"""`reading -> [n]`, firing rates of the sensors' input [Hz]."""
MotorReward = Callable[[Reading, Array], Array]
"""`(reading, turn) -> [2]`, rewards of the left and the right motor's synapses."""


class DriveParams(NamedTuple):
    """Constants of a driving network; every number may be traced.

    Attributes:
        network: of `declared.constants`.
        steering_gain: turn for each Hz by which the right motor fires more often [deg/Hz].
        max_turn: turns are cut off here [deg].
        collision, arrival: rewards of all synapses at the end of a trial.
    """

    network: declared.Params
    steering_gain: float | Array = 1.0
    max_turn: float | Array = 60.0
    collision: float | Array = -2.0
    arrival: float | Array = 2.0


def motor_credit(
    wiring: declared.Wiring, *, motors: str = "motors"
) -> dict[str, Float[np.ndarray, "n_pre n_post 2"]]:
    r"""What a larger magnitude of each synapse does to the left and to the right motor.

    .. math:: c_{ij} = s_i\, C_j, \qquad C_i = \frac{1}{n_i} \sum_j s_i\, C_j, \qquad
              C_{motor} = (1, 0), (0, 1)

    backwards from the motors over the edges that are there, :math:`n_i` of them; :math:`s_i` is the
    sign of the presynaptic neuron. For the structure of S4 this is `rewards.synapse_signs`. A
    population that is reached on several ways has the credit of the shortest one.

    Args:
        wiring: from `declare`.
        motors: name of the population of the left and the right motor.

    Returns:
        By projection, for those on a way to the motors.

    Raises:
        ValueError: there is no such population, or it has not two neurons.
    """
    part = wiring.populations.get(motors)
    require(
        part is not None and part.n == 2,
        f"motors={motors!r}: expected the name of a population of two neurons, left and right",
    )
    neurons: dict[str, np.ndarray] = {motors: np.eye(2)}
    found: dict[str, np.ndarray] = {}
    reached = [motors]
    while reached:
        post = reached.pop(0)
        for name, projection in wiring.projections.items():
            if projection.post != post:
                continue
            edges = wiring.edges[name]
            there = np.ones(edges.shape) if edges.table is None else np.asarray(edges.table)
            found[name] = there[..., None] * edges.sign[:, None, None] * neurons[post]
            if projection.pre not in neurons:
                many = np.maximum(there.sum(axis=1), 1.0)
                neurons[projection.pre] = found[name].sum(axis=1) / many[:, None]
                reached.append(projection.pre)
    return found


def declared_agent(
    wiring: declared.Wiring,
    encode: Encode,
    reward: MotorReward | None = None,
    *,
    sensors: str = "sensors",
    motors: str = "motors",
    credit: Mapping[str, Any] | None = None,
    control_steps: int = 200,
    window: int = 25,
    plastic: bool = True,
    form: Literal["step", "window"] = "step",
) -> Agent:
    r"""A network of `jaxsnn.declared` as an agent of `trials.run_phase` and `run_experiment`.

    In a control step the sensors fire at the rates of the reading. After each window of it the
    motors' rates say the turn that they ask for, and for that the reward of the next window:

    .. math:: \theta = g\,(freq_r - freq_l), \qquad r_{ij} = c_{ij} \cdot (r_{left}, r_{right})

    Collision and arrival reach all synapses as one step of reward after the move, as strong as a
    window of it. Membranes, traces and delayed spikes are at rest when a trial begins; weights
    stay.

    Args:
        wiring: from `declare`.
        encode: rates of the sensors for a reading.
        reward: on the way; needed where a projection learns by reward.
        sensors, motors: names of the input and of the population of two.
        credit: what the motors' rewards are to each edge, `[n_pre, n_post, 2]` by projection; of
            `motor_credit` when not given.
        control_steps: steps of `wiring.dt` between two turns; window: steps between two rewards.
        plastic: False to hold the weights.
        form: "step", in which weights change at every step, by the reward of the window before; or
            "window", in which they are held for the window and change by the reward of the turn
            that it asks for (`declared.window`), many times faster.

    Returns:
        Agent whose parameters are DriveParams and whose state is that of the network.

    Raises:
        ValueError: names that nothing has, a reward that is missing, windows that do not fit.

    Example:
        >>> parts = {"sensors": declared.Input(5), "motors": declared.Population(2)}
        >>> wires = {"only": declared.Projection("sensors", "motors", weight=2.0)}
        >>> agent = declared_agent(declared.declare(parts, wires), lambda r: 300.0 - r.sonar)
        >>> agent.info
        ('left motor [Hz]', 'right motor [Hz]')
    """
    require_whole("window", window, 1, "give whole steps")
    require_choice("form", form, ("step", "window"))
    require(
        control_steps >= window and control_steps % window == 0,
        f"control_steps={control_steps}: expected a multiple of window={window}; change one",
    )
    inputs = wiring.names(declared.Input)
    require(sensors in inputs, f"sensors={sensors!r}: expected the name of an Input, of {inputs}")
    rewarded = [n for n, p in wiring.projections.items() if p.rule is not None and p.rule.rewarded]
    shares = {**motor_credit(wiring, motors=motors), **(credit or {})}
    for name in rewarded:
        shape = (*wiring.edges[name].shape, 2)
        require(
            name in shares and np.shape(shares[name]) == shape,
            f"credit[{name!r}]: expected an array {shape}; it is not on a way to the motors",
        )
    require(
        not rewarded or not plastic or reward is not None,
        f"reward=None: expected a function, since {rewarded} learn by reward; or plastic=False",
    )

    def rewards_of(both: Float[Array, "2"]) -> dict[str, Array]:
        # Two products with a number: they melt into what the reward is used for.
        tables = {name: jnp.asarray(shares[name], both.dtype) for name in rewarded}
        return {name: t[..., 0] * both[0] + t[..., 1] * both[1] for name, t in tables.items()}

    def with_weights_of(state: declared.State, other: declared.State) -> declared.State:
        held = {
            name: synapses._replace(weights=other.synapses[name].weights)
            for name, synapses in state.synapses.items()
        }
        return state._replace(synapses=held)

    def init(key: Key[Array, ""], params: DriveParams) -> declared.State:
        return declared.init(key, wiring)

    def at_rest(state: declared.State) -> declared.State:
        rest = declared.init(jax.random.key(0), wiring)
        there = {n: s._replace(there=state.synapses[n].there) for n, s in rest.synapses.items()}
        return with_weights_of(rest._replace(synapses=there), state)

    def act(
        params: DriveParams,
        state: declared.State,
        reading: Reading,
        fresh: Bool[Array, ""],
        active: Bool[Array, ""],
        *,
        key: Key[Array, ""],
    ) -> tuple[declared.State, Float[Array, ""], Reading, Float[Array, "2"]]:
        begin = jax.tree.map(lambda a, b: jnp.where(fresh, a, b), at_rest(state), state)
        rates = jnp.asarray(encode(reading))
        none = jnp.zeros((2,), _dtype(state))

        kernels = {}
        if form == "window":
            kernels = declared.window_kernels(wiring, params.network, window)
            kernels = kernels if plastic else {}

        def held_window(carry: tuple, index: Array) -> tuple[tuple, Array]:
            network, rewards = carry
            spikes = poisson_spikes(rates, window, dt=wiring.dt, key=jax.random.fold_in(key, index))
            network, eligibility, fired = declared.window(
                wiring, params.network, kernels, network, {sensors: spikes}
            )
            count = jnp.sum(fired[motors], axis=0)
            if plastic and reward is not None:
                turn = _turn(params, count / (window * wiring.dt))
                given = rewards_of(jnp.asarray(reward(reading, turn), none.dtype))
                network = declared.reinforce(wiring, params.network, network, eligibility, given)
            return (network, rewards), count

        def one_window(carry: tuple, index: Array) -> tuple[tuple, Array]:
            network, rewards = carry
            spikes = poisson_spikes(rates, window, dt=wiring.dt, key=jax.random.fold_in(key, index))
            given = rewards_of(rewards)

            def step(network: declared.State, now: Array) -> tuple[declared.State, Array]:
                network, fired = declared.step(
                    wiring, params.network, network, {sensors: now, **given}
                )
                return network, fired[motors]

            network, fired = jax.lax.scan(step, network, spikes)
            count = jnp.sum(fired, axis=0).astype(none.dtype)
            turn = _turn(params, count / (window * wiring.dt))
            if plastic and reward is not None:
                rewards = jnp.asarray(reward(reading, turn), none.dtype)
            return (network, rewards), count

        n_windows = control_steps // window
        carry: tuple
        counts: Array
        body = held_window if form == "window" else one_window
        carry, counts = jax.lax.scan(body, (begin, none), jnp.arange(n_windows))
        network = carry[0]
        kept = with_weights_of(network, state)
        learns = active & jnp.asarray(plastic)
        network = jax.tree.map(lambda a, b: jnp.where(learns, a, b), network, kept)
        firing = counts.sum(axis=0) / (control_steps * wiring.dt)
        turn = jnp.clip(_turn(params, firing), -params.max_turn, params.max_turn)
        return network, turn.astype(none.dtype), reading, firing

    def learn(
        params: DriveParams,
        state: declared.State,
        memory: Reading,
        outcome: Outcome,
        next_reading: Reading | None,
        active: Bool[Array, ""],
    ) -> declared.State:
        if not plastic or not rewarded:
            return state
        end = jnp.where(
            outcome.collided, params.collision, jnp.where(outcome.arrived, params.arrival, 0.0)
        )
        silence = jnp.zeros(wiring.populations[sensors].n, _dtype(state))
        both = jnp.broadcast_to(window * end, (2,)).astype(silence.dtype)
        after, _ = declared.step(
            wiring, params.network, state, {sensors: silence, **rewards_of(both)}
        )
        ended = active & (outcome.collided | outcome.arrived)
        return jax.tree.map(
            lambda a, b: jnp.where(ended, a, b), with_weights_of(state, after), state
        )

    def finite(state: declared.State) -> Bool[Array, ""]:
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(m.v)) for m in state.membranes.values()]))

    return Agent(
        init=init,
        act=act,
        learn=learn,
        finite=finite,
        info=("left motor [Hz]", "right motor [Hz]"),
    )


def _turn(params: DriveParams, rates: Float[Array, "2"]) -> Float[Array, ""]:
    return params.steering_gain * (rates[1] - rates[0])


def _dtype(state: declared.State) -> jnp.dtype:
    return next(iter(state.membranes.values())).v.dtype
