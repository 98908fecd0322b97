"""Declared networks in windows: weights held over many steps, learning as matrix products.

While the weights are held, what inputs add to the membranes is one product over all steps of the
window, and the eligibility of reward-modulated STDP is two (`jaxsnn.window`); only membranes go
step by step. For networks whose rewards change once per window at most, many times faster than
`step`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsnn._checks import require
from jaxsnn.declared.learning_rules import PairTraces, RewardSTDP
from jaxsnn.declared.parts import Input, Population, Projection
from jaxsnn.declared.receptors import Delta
from jaxsnn.declared.stepping import Params, State
from jaxsnn.declared.wiring import Wiring
from jaxsnn.plasticity import STDPParams, STDPState, Traces
from jaxsnn.window import STDPKernel, stdp_kernel, stdp_window


def check_windows(wiring: Wiring) -> None:
    """Refuse a network that has no window form: it has to be run by `step`.

    Raises:
        ValueError: a projection with a receptor that remembers, short-term plasticity, a delay of
            more than one step, or a rule that changes weights at every spike.
    """
    for name, part in wiring.projections.items():
        where = f"projections[{name!r}]"
        require(
            isinstance(part.receptor, Delta) and part.short_term is None,
            f"{where}.receptor={type(part.receptor).__name__}: expected Delta and no short-term "
            "plasticity in windows; use step",
        )
        longest = int(wiring.edges[name].delay.max())
        require(longest == 1, f"{where}.delay={longest}: expected 1 in windows; use step")
        require(
            part.rule is None or isinstance(part.rule, RewardSTDP),
            f"{where}.rule={type(part.rule).__name__}: expected RewardSTDP or none in windows, it "
            "changes weights at every spike; use step",
        )


def window_kernels(wiring: Wiring, params: Params, n_steps: int) -> dict[str, STDPKernel]:
    """The pair kernel of each projection that learns, for windows of `n_steps`; make them once.

    Raises:
        ValueError: as `check_windows`.
    """
    check_windows(wiring)
    return {
        name: stdp_kernel(
            STDPParams(rule.a_plus, rule.a_minus, rule.tau_plus, rule.tau_minus, rule.tau_z),
            n_steps,
            dt=wiring.dt,
        )
        for name, rule in params.rules.items()
        if rule is not None
    }


def window(
    wiring: Wiring,
    params: Params,
    kernels: Mapping[str, STDPKernel],
    state: State,
    inputs: Mapping[str, Float[Array, "t n"]],
) -> tuple[State, dict[str, Array], dict[str, Array]]:
    r"""All steps of a window with the weights held.

    Args:
        wiring: from `declare`.
        params: from `constants`.
        kernels: from `window_kernels`, for as many steps as the inputs have rows.
        state: from `init` or an earlier window.
        inputs: of each Input its spikes, 0 or 1, `[T, n]`; of a Population a current into it [nA],
            `[T, n]`, if there is one.

    Returns:
        The state with the weights as they were; :math:`\int z\,dt` of each projection that learns,
        `[n_pre, n_post]`, for `reinforce`; the spikes of each Population, 0 or 1, `[T, n]`.

    Raises:
        ValueError: an input is missing, or the kernels are for other windows.
    """
    given = set(wiring.names(Input))
    missing = sorted(given - set(inputs))
    require(not missing, f"inputs={sorted(inputs)}: expected {missing} as well; give spikes")
    populations = wiring.names(Population)
    dtype = state.membranes[populations[0]].v.dtype
    jumps: dict[str, Any] = {}
    inner: dict[str, tuple[Projection, Array]] = {}
    for name, part in wiring.projections.items():
        sign = jnp.asarray(wiring.edges[name].sign, dtype)
        held = params.gains[name] * state.synapses[name].weights
        if part.pre not in given:
            # Signs go to the small side once, not to the spikes of every step.
            inner[name] = part, sign[:, None] * held
            continue
        spikes = jnp.asarray(inputs[part.pre], dtype) * sign[None]
        jumps[part.post] = jumps.get(part.post, 0.0) + spikes @ held
    currents = {n: jnp.asarray(inputs[n], dtype) for n in populations if n in inputs}

    def body(cells: dict[str, Any], now: tuple[dict[str, Array], dict[str, Array]]) -> tuple:
        jump, current = now
        over, advanced, spikes = {}, {}, {}
        for name in populations:
            nothing = jnp.zeros_like(cells[name].v)
            advanced[name], over[name] = params.neurons[name].advance(
                cells[name], current.get(name, nothing), nothing, wiring.dt
            )
            spikes[name] = over[name].astype(dtype)
        arriving = {name: jump.get(name, jnp.zeros_like(cells[name].v)) for name in populations}
        for part, held in inner.values():
            arriving[part.post] = arriving[part.post] + spikes[part.pre] @ held
        after = {
            name: params.neurons[name].receive(
                advanced[name], over[name], arriving[name], wiring.dt
            )
            for name in populations
        }
        return jax.tree.map(lambda a, b: a.astype(b.dtype), after, cells), spikes

    membranes: dict[str, Any]
    fired: dict[str, Array]
    membranes, fired = jax.lax.scan(body, state.membranes, (jumps, currents))
    synapses, eligibility = dict(state.synapses), {}
    for name, kernel in kernels.items():
        part, old = wiring.projections[name], state.synapses[name]
        pre = jnp.asarray(inputs[part.pre], dtype) if part.pre in given else fired[part.pre]
        traces = Traces(old.rule.plus[:, 0], old.rule.minus[0])
        new, eligibility[name] = stdp_window(
            kernel, STDPState(traces, old.rule.z), pre, fired[part.post]
        )
        kept = PairTraces(new.traces.p_plus[:, None], new.traces.p_minus[None, :], new.z)
        synapses[name] = old._replace(rule=kept)
    steps = next(iter(fired.values())).shape[0]
    state = state._replace(clock=state.clock + steps, membranes=membranes, synapses=synapses)
    return state, eligibility, fired


def reinforce(
    wiring: Wiring,
    params: Params,
    state: State,
    eligibility: Mapping[str, Float[Array, "n_pre n_post"]],
    rewards: Mapping[str, Any],
) -> State:
    r"""Change the weights by rewards held over the window that the eligibility is from.

    .. math:: d = \gamma\,r \int z\,dt

    through the rule's dependence and bounds; weights where there is no edge stay 0.

    Args:
        wiring, params, state: as for `window`.
        eligibility: of the window.
        rewards: of each projection that learns, a number, `[n_post]` or `[n_pre, n_post]`.

    Returns:
        The state with the new weights.

    Raises:
        ValueError: a reward is missing.
    """
    missing = sorted(set(eligibility) - set(rewards))
    require(not missing, f"rewards={sorted(rewards)}: expected {missing} as well; give a reward")
    synapses = dict(state.synapses)
    for name, summed in eligibility.items():
        old, rule = synapses[name], params.rules[name]
        reward = jnp.atleast_2d(jnp.asarray(rewards[name], summed.dtype))
        weights = rule.changed(old.weights, rule.gamma * reward * summed)
        table = wiring.edges[name].table
        there = old.there if table is None else jnp.asarray(table, weights.dtype)
        weights = weights if there is None else weights * there
        synapses[name] = old._replace(weights=weights.astype(old.weights.dtype))
    return state._replace(synapses=synapses)
