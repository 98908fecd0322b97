"""The rule that the graded reward teaches, as a driver: what a network can learn from it at most.

A network that learns from `turn_goal.turn_reward` is rewarded for the turn that `turn_goal` asks
for. A driver that makes exactly these turns shows how far the rule itself gets, and its constants
are chosen on validation maps before any network is trained (`scripts/studies/study_guidance.py`).
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxsnn import world
from jaxsnn.agents import Agent
from jaxsnn.drivers import drive_fixed, fixed_agent
from jaxsnn.trials import TrialResult
from jaxsnn.turn_goal import TurnGoalParams, turn_goal, update_recent_turn


def guidance_agent() -> Agent:
    r"""A driver that turns as the graded reward asks; its state is the leaky mean of its turns.

    .. math:: \theta = g(\text{reading}, \bar\theta)

    with :math:`g` of `turn_goal` and :math:`\bar\theta` of `turn_goal.update_recent_turn`.

    Returns:
        Agent whose parameters are TurnGoalParams.
    """

    def act(
        params: TurnGoalParams,
        state: Float[Array, ""],
        reading: world.Reading,
        fresh: Bool[Array, ""],
        active: Bool[Array, ""],
        *,
        key: Key[Array, ""],
    ) -> tuple[Float[Array, ""], Float[Array, ""], None, Float[Array, "0"]]:
        recent = jnp.where(fresh, jnp.zeros_like(state), state)
        turn, _ = turn_goal(params, reading, recent)
        kept = update_recent_turn(params, recent, turn)
        return kept.astype(state.dtype), turn, None, jnp.zeros((0,))

    return fixed_agent(act)


@functools.partial(jax.jit, static_argnames=("n_trials", "max_steps"))
def drive_guided(
    params: TurnGoalParams,
    map: world.WorldParams,
    *,
    keys: Key[Array, " robots"],
    n_trials: int = 10,
    max_steps: int = 200,
) -> TrialResult:
    """Drive robots by the rule over a map.

    Returns:
        TrialResult, leaves `[robots, trials]`.

    Example:
        >>> from jaxsnn import scenario, success_rate
        >>> keys = jax.random.split(jax.random.key(0), 2)
        >>> rule = jax.tree.map(jnp.float32, TurnGoalParams())
        >>> success_rate(drive_guided(rule, scenario(1), keys=keys, n_trials=2)).tolist()
        [1.0, 1.0]
    """
    return drive_fixed(
        guidance_agent(), params, map, keys=keys, n_trials=n_trials, max_steps=max_steps
    )
