"""The phases of an experiment as one loop: one piece of program for learning and testing.

Two phases in a row are two copies of nearly everything, world, sensors and neurons, and a first
call spends its time compiling. Here one loop goes through the phases, and only what learning adds
depends on which one it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key

from jaxsnn import world
from jaxsnn.agents import Agent
from jaxsnn.trials import TrialResult, run_phase

AgentMaker = Callable[[Any], Agent]
"""From a traced flag, whether it may learn, to an agent."""


def run_phases(
    agent: AgentMaker,
    params: Any,
    map: world.WorldParams,
    states: Any,
    *,
    keys: Key[Array, "robots phases"],
    n_trials: Sequence[int],
    plastic: Sequence[bool],
    circles: Int[Array, " trials"] | None = None,
    **options: Any,
) -> tuple[Any, list[TrialResult]]:
    """A first phase, and others that all begin with what it has left.

    Args:
        agent: makes the agent from the flag of a phase.
        params: the agent's parameters.
        map: the map of all phases.
        states: the agents' states, leaves `[robots, ...]`.
        keys: one per robot and phase.
        n_trials: of each phase.
        plastic: whether a phase may learn.
        circles: start circle of each trial of the first phase; those of the others are drawn.
        options: of `run_phase`.

    Returns:
        The states after the first phase, and a TrialResult of each phase.
    """
    most = max(n_trials)
    given = None
    if circles is not None:
        drawn = jnp.full((len(n_trials), most), -1, circles.dtype)
        given = drawn.at[0, : n_trials[0]].set(circles)
    each = (
        jnp.arange(len(n_trials)) == 0,
        jnp.asarray(plastic),
        jnp.asarray(n_trials, jnp.int32),
        jnp.swapaxes(keys, 0, 1),
        given,
    )

    def phase(states: Any, each: tuple) -> tuple[Any, TrialResult]:
        first, learns, run, keys, circles = each
        after, result = run_phase(
            agent(learns), params, map, states,
            keys=keys, n_trials=most, run=run, circles=circles, **options,
        )  # fmt: skip
        return jax.lax.cond(first, lambda: after, lambda: states), result

    states, results = jax.lax.scan(phase, states, each)
    cut = [jax.tree.map(lambda x, i=i, n=n: x[i, :, :n], results) for i, n in enumerate(n_trials)]
    return states, cut
