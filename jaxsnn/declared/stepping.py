"""Declared networks at work: `init`, one `step` of dt, and `run` over many.

Order within a step: all membranes advance and fire; receptors decay; spikes are delivered (with the
weights and the resources from before this step's learning); membranes take the jumps and reset;
weights learn.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from jaxsnn._checks import default_float, require, require_key
from jaxsnn.declared.parts import FixedProbability, Input, Population
from jaxsnn.declared.wiring import Wiring


class Params(NamedTuple):
    """The constants of a network by name: a pytree whose numbers can be traced and batched."""

    neurons: dict[str, Any]
    receptors: dict[str, Any]
    rules: dict[str, Any]
    short_term: dict[str, Any]
    gains: dict[str, Any]


class Synapses(NamedTuple):
    """State of one projection; leaves that it does not need are None."""

    weights: Float[Array, "n_pre n_post"]
    there: Float[Array, "n_pre n_post"] | None
    receptor: Any
    rule: Any
    short_term: Any


class State(NamedTuple):
    """State of a network: steps done, membranes and spike history by population, synapses.

    `history` is a ring of the last steps' spikes, `[depth, n]`, for populations with delays.
    """

    clock: Int[Array, ""]
    membranes: dict[str, Any]
    history: dict[str, Float[Array, "depth n"]]
    synapses: dict[str, Synapses]


def constants(wiring: Wiring) -> Params:
    """The numbers of all parts, to be given to `step` and `run`.

    Returns:
        Params; replace leaves, or batch them, as any pytree.
    """
    parts = wiring.projections
    return Params(
        neurons={
            name: part.neuron
            for name, part in wiring.populations.items()
            if isinstance(part, Population)
        },
        receptors={name: part.receptor for name, part in parts.items()},
        rules={name: part.rule for name, part in parts.items()},
        short_term={name: part.short_term for name, part in parts.items()},
        gains={name: part.gain for name, part in parts.items()},
    )


def init(key: Key[Array, ""], wiring: Wiring) -> State:
    """Neurons at rest, no spikes under way, weights and random edges drawn.

    Args:
        key: a single typed key; only random edges and weights use it.
        wiring: from `declare`.

    Returns:
        State, in jax's default float (float64 under x64); membranes `[n]`, weights
        `[n_pre, n_post]`, zero where there is no edge.

    Raises:
        ValueError: no typed key, or a weight function that gives another shape.
    """
    require_key(key)
    synapses = {
        name: _init_synapses(jax.random.fold_in(key, number), wiring, name)
        for number, name in enumerate(wiring.projections)
    }
    return State(
        clock=jnp.zeros((), jnp.int32),
        membranes={
            name: part.neuron.init(part.n)
            for name, part in wiring.populations.items()
            if isinstance(part, Population)
        },
        history={
            name: jnp.zeros((depth, wiring.populations[name].n), default_float())
            for name, depth in wiring.depth.items()
            if depth > 1
        },
        synapses=synapses,
    )


def _init_synapses(key: Array, wiring: Wiring, name: str) -> Synapses:
    part, edges = wiring.projections[name], wiring.edges[name]
    dtype, shape = default_float(), edges.shape
    for_edges, for_weights = jax.random.split(key)
    there = None if edges.table is None else jnp.asarray(edges.table, dtype)
    if isinstance(part.connect, FixedProbability):
        there = jax.random.bernoulli(for_edges, part.connect.p, shape).astype(dtype)
    given = part.weight(for_weights, shape) if callable(part.weight) else part.weight
    weights = jnp.asarray(given, dtype)
    require(
        weights.shape in ((), shape),
        f"projections[{name!r}].weight=<shape {weights.shape}>: expected weights of the shape "
        f"{shape} that the function was given; return that shape",
    )
    weights = jnp.broadcast_to(weights, shape)
    return Synapses(
        weights=weights if there is None else weights * there,
        there=there,
        receptor=part.receptor.init(shape[1]),
        rule=None if part.rule is None else part.rule.init(edges.arriving, shape[1]),
        short_term=None if part.short_term is None else part.short_term.init(edges.arriving),
    )


def step(
    wiring: Wiring, params: Params, state: State, inputs: Mapping[str, Any]
) -> tuple[State, dict[str, Array]]:
    """One step of `wiring.dt`.

    Args:
        wiring: from `declare`.
        params: from `constants`.
        state: from `init` or an earlier step.
        inputs: by name: of an Input its spikes, 0 or 1, `[n]` (needed); of a Population a current
            into it [nA], `[n]` or a number; of a projection with RewardSTDP its reward (needed), a
            number, `[n_post]` or `[n_pre, n_post]`.

    Returns:
        The new state, of the dtypes of the old one, and the spikes of each Population, bool `[n]`.

    Raises:
        ValueError: an input is missing, or has a name that nothing has.
    """
    _check_inputs(wiring, inputs)
    pulls = _pulls(wiring, params, state, inputs)
    spikes: dict[str, Array] = {}
    membranes: dict[str, Any] = {}
    for name in wiring.names(Population):
        membranes[name], spikes[name] = params.neurons[name].advance(
            state.membranes[name], *pulls[name], wiring.dt
        )
    dtype = next(iter(membranes.values())).v.dtype
    numbers = {name: jnp.asarray(fired, dtype) for name, fired in spikes.items()}
    numbers |= {name: jnp.asarray(inputs[name], dtype) for name in wiring.names(Input)}
    history = {
        name: ring.at[state.clock % wiring.depth[name]].set(numbers[name])
        for name, ring in state.history.items()
    }
    jumps = {name: jnp.zeros_like(membranes[name].v) for name in membranes}
    synapses = {}
    for name, part in wiring.projections.items():
        arrived = _arrived(wiring, name, state.clock, history, numbers)
        reward = jnp.asarray(inputs.get(name, 0.0), dtype)
        synapses[name], arriving = _transmit(
            wiring, params, name, state.synapses[name], arrived, numbers[part.post], reward
        )
        if synapses[name].receptor is None:
            jumps[part.post] = jumps[part.post] + arriving
    membranes = {
        name: params.neurons[name].receive(cells, spikes[name], jumps[name], wiring.dt)
        for name, cells in membranes.items()
    }
    new = State(state.clock + 1, membranes, history, synapses)
    return jax.tree.map(lambda a, b: a.astype(b.dtype), new, state), spikes


def run(
    wiring: Wiring,
    params: Params,
    state: State,
    inputs: Mapping[str, Any],
    *,
    watch: Callable[[State], Any] | None = None,
) -> tuple[State, dict[str, Array], Any]:
    """`step` over the rows of the inputs.

    Args:
        wiring, params, state: as for `step`.
        inputs: as for `step`, each with a leading axis of `T` steps.
        watch: what to note of the state after each step, such as
            `lambda s: s.membranes["out"].v`.

    Returns:
        The last state, spikes of each Population `[T, n]`, and what was watched, `[T, ...]` (None
        without `watch`).

    Raises:
        ValueError: as `step`, or the inputs have no steps to go by.
    """
    lengths = {name: jnp.shape(value)[:1] for name, value in inputs.items()}
    require(
        len(set(lengths.values())) == 1 and () not in lengths.values(),
        f"inputs=<leading axes {lengths}>: expected one and the same number of steps for each; "
        "repeat what is constant",
    )

    def body(carry: State, now: Mapping[str, Any]) -> tuple[State, Any]:
        carry, spikes = step(wiring, params, carry, now)
        return carry, (spikes, None if watch is None else watch(carry))

    state, (spikes, watched) = jax.lax.scan(body, state, dict(inputs))
    return state, spikes, watched


def _check_inputs(wiring: Wiring, inputs: Mapping[str, Any]) -> None:
    rewarded = {
        name
        for name, part in wiring.projections.items()
        if part.rule is not None and part.rule.rewarded
    }
    needed = {*wiring.names(Input), *rewarded}
    missing = sorted(needed - set(inputs))
    require(
        not missing, f"inputs={sorted(inputs)}: expected {missing} as well; give spikes, reward"
    )
    strange = sorted(set(inputs) - needed - set(wiring.populations))
    require(
        not strange,
        f"inputs={strange}: expected names of populations and of projections with a reward; one of "
        f"{sorted(needed | set(wiring.populations))}",
    )


def _pulls(
    wiring: Wiring, params: Params, state: State, inputs: Mapping[str, Any]
) -> dict[str, tuple[Array, Array]]:
    """Current [nA] and conductance [uS] on each population, from before this step's spikes."""
    total: dict[str, tuple[Array, Array]] = {}
    for name in wiring.names(Population):
        v = state.membranes[name].v
        given = jnp.broadcast_to(jnp.asarray(inputs.get(name, 0.0), v.dtype), v.shape)
        total[name] = given, jnp.zeros_like(v)
    for name, part in wiring.projections.items():
        held = state.synapses[name].receptor
        if held is not None:
            current, conductance = params.receptors[name].pull(held)
            total[part.post] = (
                total[part.post][0] + current,
                total[part.post][1] + conductance,
            )
    return total


def _arrived(
    wiring: Wiring, name: str, clock: Array, history: dict[str, Array], now: dict[str, Array]
) -> Array:
    """Spikes that reach the synapses in this step, `[n_pre, 1]` or `[n_pre, n_post]`."""
    pre, edges = wiring.projections[name].pre, wiring.edges[name]
    if int(edges.delay.max()) == 1:
        return jnp.broadcast_to(now[pre][:, None], edges.arriving)
    ring = history[pre]
    row = (clock - jnp.asarray(edges.delay - 1, clock.dtype)) % wiring.depth[pre]
    if row.ndim == 0:
        return ring[row][:, None]
    axon = jnp.arange(edges.shape[0])
    return ring[row, axon[:, None]] if row.ndim == 2 else ring[row, axon][:, None]


def _transmit(
    wiring: Wiring,
    params: Params,
    name: str,
    old: Synapses,
    arrived: Array,
    post: Array,
    reward: Array,
) -> tuple[Synapses, Array]:
    """Deliver what arrived, then learn; the sum at each postsynaptic neuron goes with it."""
    edges, dt = wiring.edges[name], wiring.dt
    released, resources = arrived, old.short_term
    if resources is not None:
        resources, released = params.short_term[name].release(resources, arrived, dt)
    released = released * jnp.asarray(edges.sign, arrived.dtype)[:, None]
    if released.shape[1] == 1 < edges.shape[1]:
        arriving = released[:, 0] @ old.weights
    else:
        arriving = jnp.sum(released * old.weights, axis=0)
    arriving = params.gains[name] * arriving
    receptor = params.receptors[name].update(old.receptor, arriving, dt)
    rule, weights = old.rule, old.weights
    if rule is not None:
        rewards = jnp.broadcast_to(jnp.atleast_2d(reward), edges.shape)
        rule, weights = params.rules[name].step(rule, weights, arrived, post, rewards, dt)
        weights = weights if old.there is None else weights * old.there
    return Synapses(weights, old.there, receptor, rule, resources), arriving
