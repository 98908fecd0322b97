"""Drivers that learn nothing: what a map demands, measured before anything is trained on it.

The blind driver turns to the target and ignores its sonars. The reflex does the same until a sonar
reads less than `distance`; then it turns away from the nearer side. A map that one of them solves
says nothing about learning to avoid obstacles.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxsnn import world
from jaxsnn._checks import concrete, require, require_keys
from jaxsnn.agents import Agent
from jaxsnn.status import Status
from jaxsnn.trials import TrialResult, run_phase


class DriverParams(NamedTuple):
    """Constants of a driver; may be traced.

    Attributes:
        distance: a sonar below this sets the reflex off [px]; 0 is the blind driver.
        turn: size of the reflex's turn [deg].
        limit: largest turn towards the target [deg].
        left: factor on turns to the left; below 1 the right motor is weak.
    """

    distance: float | Array = 60.0
    turn: float | Array = 40.0
    limit: float | Array = 30.0
    left: float | Array = 1.0


DRIVERS = {
    "blind": DriverParams(distance=0.0),
    "reflex_60": DriverParams(distance=60.0),
    "reflex_100": DriverParams(distance=100.0),
}
"""The three drivers that every table of navigation carries."""


def driver_steering(params: DriverParams, reading: world.Reading) -> Float[Array, ""]:
    r"""Turn of a driver for a reading [deg], positive to the left.

    .. math:: \theta = \begin{cases} \pm \text{turn} & \min_i s_i < \text{distance} \\
              \mathrm{clip}(\beta, -\text{limit}, \text{limit}) & \text{else} \end{cases}

    to the right when the left side is nearer, to the left otherwise.
    """
    half = reading.sonar.shape[0] // 2
    left, right = jnp.min(reading.sonar[:half]), jnp.min(reading.sonar[half + 1 :])
    away = jnp.where(left < right, -params.turn, params.turn)
    ahead = jnp.clip(reading.angle, -params.limit, params.limit)
    turn = jnp.where(jnp.min(reading.sonar) < params.distance, away, ahead)
    return jnp.where(turn > 0, params.left * turn, turn)


def driver_agent() -> Agent:
    """A driver as an agent: its parameters are DriverParams, its state is not used."""

    def act(
        params: DriverParams,
        state: Any,
        reading: world.Reading,
        fresh: Bool[Array, ""],
        active: Bool[Array, ""],
        *,
        key: Key[Array, ""],
    ) -> tuple[Any, Float[Array, ""], None, Float[Array, "0"]]:
        return state, driver_steering(params, reading), None, jnp.zeros((0,))

    return fixed_agent(act)


def fixed_agent(act: Callable[..., Any]) -> Agent:
    """An agent that learns nothing; its state is one number, which `act` may use."""
    return Agent(
        init=lambda key, params: jnp.zeros(()),
        act=act,
        learn=lambda params, state, memory, outcome, next_reading, active: state,
        finite=jnp.isfinite,
    )


def drive_fixed(
    agent: Agent,
    params: Any,
    map: world.WorldParams,
    *,
    keys: Key[Array, " robots"],
    n_trials: int,
    max_steps: int,
) -> TrialResult:
    """Drive robots by an agent of `fixed_agent` over a map: TrialResult, `[robots, trials]`.

    Raises:
        ValueError, TypeError: keys, trials or steps are not what `run_phase` takes.
    """
    require_keys(keys)
    states = jnp.zeros(keys.shape[0])
    _, result = run_phase(
        agent, params, map, states, keys=keys, n_trials=n_trials, max_steps=max_steps
    )
    return result


@functools.partial(jax.jit, static_argnames=("n_trials", "max_steps"))
def drive(
    params: DriverParams,
    map: world.WorldParams,
    *,
    keys: Key[Array, " robots"],
    n_trials: int = 10,
    max_steps: int = 200,
) -> TrialResult:
    """Drive robots over a map; compiled once for all drivers and all maps of equal padding.

    Returns:
        TrialResult, leaves `[robots, trials]`.

    Raises:
        ValueError, TypeError: keys, trials or steps are not what `run_phase` takes.

    Example:
        >>> from jaxsnn import scenario, success_rate
        >>> keys = jax.random.split(jax.random.key(0), 4)
        >>> success_rate(drive(DRIVERS["blind"], scenario(1), keys=keys)).tolist()
        [1.0, 1.0, 1.0, 1.0]
    """
    return drive_fixed(
        driver_agent(), params, map, keys=keys, n_trials=n_trials, max_steps=max_steps
    )


def drive_together(
    params: DriverParams,
    map: world.WorldParams,
    *,
    keys: Key[Array, " runs"],
    max_steps: int = 200,
) -> Int[Array, "runs robots"]:
    """Drive several robots at once in one world, where they see and hit one another.

    Robot `i` begins in start circle `i` of the map. Who has arrived or collided is there no longer.

    Args:
        params: constants of the driver, the same for all.
        map: with a start circle for each robot, as `families.family_map(..., robots=3)` has them.
        keys: one per run.
        max_steps: control steps after which those that still drive are given up.

    Returns:
        `Status` of each robot of each run, int32.

    Raises:
        ValueError: the map has fewer start circles than room for them.
    """
    require_keys(keys)
    probs = concrete(map.start_probs)
    require(
        probs is None or bool((probs > 0).all()),
        f"start_probs={None if probs is None else probs.tolist()}: expected a start circle for "
        "each robot; make the map with robots=2 or more, or max_starts as many as starts",
    )
    return _together(params, map, keys, max_steps)


@functools.partial(jax.jit, static_argnums=3)
def _together(
    params: DriverParams, map: world.WorldParams, keys: Key[Array, " runs"], max_steps: int
) -> Int[Array, "runs robots"]:
    circles = jnp.arange(map.starts.shape[0])

    def run(key: Key[Array, ""]) -> Int[Array, " robots"]:
        begin = jax.vmap(lambda k, c: world.reset(map, key=k, circle=c))
        robots = begin(jax.random.split(key, circles.shape[0]), circles)

        def step(carry: tuple[world.WorldState, Array], _: None) -> tuple[Any, None]:
            robots, status = carry
            active = status == Status.TIMEOUT
            readings = world.observe_many(map, robots, active=active)
            steering = jax.vmap(lambda r: driver_steering(params, r))(readings)
            robots, outcome = world.step_many(map, robots, steering, active=active)
            for ended, name in zip(outcome, _ENDS, strict=True):
                status = jnp.where(ended, jnp.int32(name), status)
            return (robots, status), None

        # Out of steps until something else is known.
        late = jnp.full(circles.shape, Status.TIMEOUT, jnp.int32)
        return jax.lax.scan(step, (robots, late), length=max_steps)[0][1]

    return jax.vmap(run)(keys)


_ENDS = (Status.COLLIDED, Status.ARRIVED, Status.NON_FINITE)
"""Of the flags of `world.Outcome`, in their order."""
