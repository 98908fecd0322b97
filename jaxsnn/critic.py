"""A critic beside the network: reward replaced by its temporal-difference error, and potentials.

The source rewards what is there to be seen now. Here a linear value of the network's own input
groups learns what comes later, and its error is what the synapses get: an actor-critic whose actor
is the spiking network. A potential, the way that is left, tells good steps from bad ones before the
first arrival, without changing which policy is best.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsnn._checks import concrete, default_float, require, require_finite, require_positive
from jaxsnn.world import Reading

Credit = Literal["global", "turn"]
Potential = Literal["none", "straight", "way"]


class CriticParams(NamedTuple):
    """Constants of the critic and of the potential.

    Attributes:
        rate: step of the value, relative to one that would take the whole error at once.
        discount: of a control step, between 0 and 1.
        trace: share of the value's eligibility that is kept at each step, `lambda`.
        strength: what the error is multiplied with before the synapses get it.
        scale: turn for which the credit is full [deg].
        height: of the potential [1/px]; a step of 15 px straight on is worth 15 times as much.
    """

    rate: float | Array = 0.2
    discount: float | Array = 0.95
    trace: float | Array = 0.8
    strength: float | Array = 1.0
    scale: float | Array = 60.0
    height: float | Array = 0.01


class Critic(NamedTuple):
    """Weights of the value and their eligibility, one for each input group."""

    weights: Float[Array, " groups"]
    trace: Float[Array, " groups"]


def check_critic(params: CriticParams) -> None:
    """Refuse constants with which nothing can be learnt.

    Raises:
        ValueError: names the constant, its value and the fix.
    """
    require_positive("scale", params.scale, "give degrees")
    for name in ("rate", "discount", "trace"):
        value = concrete(getattr(params, name))
        good = value is None or bool(((value >= 0) & (value <= 1)).all())
        require(good, f"critic.{name}={value}: expected a number from 0 to 1; 0 leaves it out")
    for name in ("strength", "height"):
        require_finite(name, getattr(params, name), "0 leaves it out")


def critic_init(groups: int) -> Critic:
    """A value of 0 everywhere."""
    return Critic(jnp.zeros((groups,), default_float()), jnp.zeros((groups,), default_float()))


def features(rates: Float[Array, " groups"]) -> Float[Array, " groups"]:
    """Rates of the input groups, of length 1 (0 where none fires): what the value is linear in."""
    return rates / jnp.maximum(jnp.sqrt(jnp.sum(rates**2)), 1e-6)


def potential(
    params: CriticParams, reading: Reading, kind: Potential, distance: Float[Array, ""]
) -> Float[Array, ""]:
    r"""What a place is worth: less the farther it is to the target.

    .. math:: \Phi = -h\,L

    Args:
        params: CriticParams; `height` is `h`.
        reading: with `way_left`, of a map made by `ways.with_way`, for the kind "way".
        kind: "straight", or "way" for `L` along the shortest way, which a trainer that knows the
            map tells; "none" for 0.
        distance: to the target [px], `L` of the kind "straight".

    Raises:
        ValueError: the map has no ways.
    """
    if kind == "none":
        return jnp.zeros_like(distance)
    if kind == "straight":
        return -params.height * distance
    if reading.way_left is None:
        raise ValueError(
            "map.way=None: expected a map with its shortest ways for shaping='way'; learn on "
            "ways.with_way(map)"
        )
    return -params.height * reading.way_left


def shaped_reward(
    params: CriticParams, before: Reading, after: Reading, kind: Potential
) -> Float[Array, ""]:
    r"""What a step is worth by the potential.

    .. math:: F = \gamma\,\Phi(s') - \Phi(s)

    Source: Ng, Harada and Russell (1999), Proc. ICML, Theorem 1. Deviation: none is given in the
        step that ends a trial, as if the potential stayed where the robot ends; who collides far
        from the target has not earned the way that was left.

    Example:
        >>> at = [Reading(jnp.ones(5), jnp.asarray(d), jnp.asarray(0.0)) for d in (115.0, 100.0)]
        >>> round(float(shaped_reward(CriticParams(discount=1.0), *at, "straight")), 6)
        0.15
    """
    values = [potential(params, r, kind, r.distance) for r in (before, after)]
    return params.discount * values[1] - values[0]


def temporal_difference(
    params: CriticParams,
    critic: Critic,
    before: Float[Array, " groups"],
    after: Float[Array, " groups"],
    reward: Float[Array, ""],
    ended: Bool[Array, ""],
) -> tuple[Critic, Float[Array, ""]]:
    r"""The error of the value over one control step, and the critic after it.

    .. math:: \delta = r + \gamma\,v \cdot x' - v \cdot x, \qquad
        e \leftarrow \gamma\lambda e + x, \qquad v \leftarrow v + \alpha\,\delta\,e

    with :math:`v \cdot x' = 0` once the trial has ended.

    Args:
        params: CriticParams.
        critic: Critic.
        before, after: `features` of what was sensed before the move and after it.
        reward: of the step.
        ended: collided or arrived; a trial that ran out of time has not.

    Source: Sutton and Barto (2018), section 12.2; as the third factor of spike-timing dependent
        plasticity: Fremaux, Sprekeler and Gerstner (2013), PLoS Computational Biology 9(4), Eq. 17.
        Deviation: their critic is a population of spiking neurons in continuous time, this one
        takes one number for each control step.

    Example:
        >>> x = jnp.array([1.0, 0.0])
        >>> critic, error = temporal_difference(
        ...     CriticParams(rate=0.5), critic_init(2), x, x, jnp.asarray(2.0), jnp.asarray(True)
        ... )
        >>> float(error), critic.weights.tolist()
        (2.0, [1.0, 0.0])
    """
    following = jnp.where(ended, 0.0, critic.weights @ after)
    error = reward + params.discount * following - critic.weights @ before
    trace = params.discount * params.trace * critic.trace + before
    weights = critic.weights + params.rate * error * trace
    return Critic(weights.astype(trace.dtype), trace), error


def credited(
    params: CriticParams, error: Float[Array, ""], turn: Float[Array, ""], credit: Credit
) -> Float[Array, "2"]:
    r"""The error as a reward of the left and of the right motor's synapses.

    .. math:: r_{left} = r_{right} = k\,\delta \quad \text{(global)}, \qquad
        r_{right} = -r_{left} = k\,\delta\,\mathrm{clip}(\theta / \text{scale}, -1, 1)
        \quad \text{(turn)}

    Args:
        params: CriticParams; `strength` is `k`.
        error: of `temporal_difference`, or a reward.
        turn: that the robot made [deg], positive to the left.
        credit: "global", one number for the whole network, as the source's rewards for collision
            and arrival and the source of the actor-critic have it; or "turn", to the motor that
            made the turn and against the other one.

    Example:
        >>> credited(CriticParams(), jnp.asarray(2.0), jnp.asarray(-30.0), "turn").tolist()
        [1.0, -1.0]
    """
    error = params.strength * error
    if credit == "global":
        return jnp.stack([error, error])
    share = error * jnp.clip(turn / params.scale, -1.0, 1.0)
    return jnp.stack([-share, share])
