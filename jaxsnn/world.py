"""A robot with five sonars in a closed plane: kinematics, sensors, collision, arrival.

Pure functions over two pytrees: `WorldParams` is a map with all constants (vmap over it to run
many maps at once, every map padded to the same size), `WorldState` is what a control step
changes.

>>> import jax
>>> from jaxsnn import scenarios, world
>>> params = scenarios.scenario(1)
>>> state = world.reset(params, key=jax.random.key(0))
>>> reading = world.observe(params, state)
>>> state, outcome = world.step(params, state, 0.0)
>>> bool(outcome.collided), bool(outcome.arrived)
(False, False)

Conventions: lengths in pixels, x to the right, y up; headings in radians, counter-clockwise from
the x axis; steering and the angle to the target in degrees, positive to the left
(counter-clockwise). Sonars are listed from the leftmost to the rightmost.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxsnn import geometry
from jaxsnn._checks import concrete, require, require_circles, require_key
from jaxsnn.way import WayLength, remaining_way, turn_onto_way

N_SONARS = 5
"""Of the source's robot; `make_map(sonar_angles=...)` takes any odd number."""


class WorldParams(NamedTuple):
    """A map and the constants of its robot; made by `jaxsnn.maps.make_map`.

    Every leaf is an array, so maps of equal padding can be stacked and vmapped.

    Example:
        >>> from jaxsnn import scenarios
        >>> params = scenarios.scenario(1)
        >>> float(params.speed), params._replace(speed=params.speed / 3).speed.tolist()
        (15.0, 5.0)
    """

    segments: Array  # [s, 4] sides (ax, ay, bx, by) of closed polygons [px]
    segment_mask: Array  # [s] bool, False = padding
    circles: Array  # [c, 3] round obstacles (x, y, radius) [px]
    circle_mask: Array  # [c] bool
    bounds: Array  # [4] walls (x0, y0, x1, y1) [px]
    target: Array  # [2] centre of the target [px]
    arrival_radius: Array  # [] the robot's centre within this of the target has arrived [px]
    starts: Array  # [k, 3] start circles (x, y, radius) [px]
    start_probs: Array  # [k] how often each start circle is drawn; 0 = padding
    heading_spread: Array  # [] start heading: towards the target, plus or minus this [deg]
    speed: Array  # [] path per control step [px]
    robot_radius: Array  # [] [px]
    sonar_angles: Array  # [n] directions of the sonars from the heading, left to right [deg]
    sonar_range: Array  # [] [px]
    distance_range: Array  # [] range of the distance sensor [px]
    # Extensions, off by default.
    segment_velocity: Array  # [s, 2] motion of each side's polygon [px per step]
    circle_velocity: Array  # [c, 2] motion of each circle [px per step]
    patrol_steps: Array  # [] whole steps after which moving obstacles turn back, >= 1
    sonar_noise: Array  # [] standard deviation [px]
    distance_noise: Array  # [] standard deviation [px]
    angle_noise: Array  # [] standard deviation [deg]
    sonar_failed: Array  # [n] bool: this sonar reports its stuck value
    sonar_stuck: Array  # [n] what a failed sonar reports [px]
    way: WayLength | None = None  # shortest ways, for rewards alone; made by `ways.with_way`


class WorldState(NamedTuple):
    """Pose of one robot, the number of control steps it has made, and its source of noise."""

    x: Array  # [] [px]
    y: Array  # [] [px]
    heading: Array  # [] [rad], in (-pi, pi]
    t: Array  # [] int32, control steps since reset
    key: Array  # [] typed PRNG key; only sensor noise uses it


class Reading(NamedTuple):
    """What the sensors say."""

    sonar: Array  # [n] distance to what each sonar sees, at most sonar_range [px]
    distance: Array  # [] distance to the target, at most distance_range [px]
    angle: Array  # [] angle from heading to target in (-180, 180], positive = to the left [deg]
    # No sensor, and no network's input: what a trainer that knows the map tells a reward.
    way_turn: Array | None = None  # [] turn onto the shortest way [deg]; None without `map.way`
    way_left: Array | None = None  # [] length of the shortest way from here [px]


class Outcome(NamedTuple):
    """How a control step ended; at most one flag is set."""

    collided: Array  # [] bool
    arrived: Array  # [] bool
    failed: Array | bool = False  # [] bool: pose or steering was not finite, the robot stayed


class Discs(NamedTuple):
    """Other robots, as one robot meets them."""

    centres: Array  # [m, 2] [px]
    moves: Array  # [m, 2] what each does in this step [px]
    mask: Array  # [m] bool


def _patrol(t: Array, params: WorldParams) -> Array:
    """Steps away from the start of the patrol: 0 1 .. P .. 1 0 1 .., linear between whole steps."""
    period = jnp.maximum(params.patrol_steps, 1.0)
    return period - jnp.abs(jnp.mod(t.astype(period.dtype), 2.0 * period) - period)


def obstacles_at(
    params: WorldParams, t: Int[Array, ""]
) -> tuple[Float[Array, "s 4"], Float[Array, "c 3"]]:
    """Segments and circles where they are after `t` control steps, padding included."""
    steps = _patrol(t, params)
    shift = params.segment_velocity * steps
    segments = params.segments + jnp.concatenate([shift, shift], axis=1)
    centres = params.circles[:, :2] + params.circle_velocity * steps
    return segments, jnp.concatenate([centres, params.circles[:, 2:]], axis=1)


def reset(
    params: WorldParams, *, key: Key[Array, ""], circle: int | Int[Array, ""] | None = None
) -> WorldState:
    """A robot at a uniform point of a start circle, facing the target within `heading_spread`.

    Args:
        params: the map.
        key: typed PRNG key.
        circle: number of the start circle, from 0; drawn with `start_probs` when it is not given
            or negative.

    Returns:
        WorldState at step 0.

    Raises:
        ValueError, TypeError: the map has no such start circle, or it is no single whole number
            (a traced one is not looked at); the key is not one typed key.
    """
    require_key(key)
    if circle is not None:
        shape = np.shape(circle)
        require(shape == (), f"circle=<shape {shape}>: expected one number; vmap over them")
        require_circles("circle", circle, params.start_probs)
        if isinstance(circle, int) and circle < 0:
            circle = None
    keys = jax.random.split(key, 5)
    dtype = params.starts.dtype
    if not isinstance(circle, int):
        drawn = _drawn_circle(params, keys[0])
        circle = drawn if circle is None else jnp.where(circle < 0, drawn, circle)
    start = params.starts[circle]
    # One draw from three keys: a random number takes longer to compile than to draw.
    u = jax.vmap(lambda k: jax.random.uniform(k, dtype=dtype))(keys[1:4])
    radius = start[2] * jnp.sqrt(u[0])
    phi = 2.0 * jnp.pi * u[1]
    x = start[0] + radius * jnp.cos(phi)
    y = start[1] + radius * jnp.sin(phi)
    spread = params.heading_spread * (2.0 * u[2] - 1.0)
    towards = jnp.arctan2(params.target[1] - y, params.target[0] - x)
    heading = _wrap(towards + jnp.deg2rad(spread))
    return WorldState(x, y, heading, jnp.zeros((), jnp.int32), keys[4])


def _drawn_circle(params: WorldParams, key: Key[Array, ""]) -> int | Int[Array, ""]:
    """A start circle by `start_probs`; where the map is known to have one only, that one."""
    probs = concrete(params.start_probs)
    if probs is not None and probs.ndim == 1 and np.count_nonzero(probs) == 1:
        return int(np.argmax(probs))
    return jax.random.categorical(key, jnp.log(params.start_probs))


def _wrap(heading: Array) -> Array:
    """The same direction in (-pi, pi]."""
    return jnp.arctan2(jnp.sin(heading), jnp.cos(heading))


def _silent(params: WorldParams) -> bool:
    """Whether the sensors are known to have no noise; inside jit it is, for a map given outside."""
    known = [concrete(x) for x in (params.sonar_noise, params.distance_noise, params.angle_noise)]
    return all(x is not None and not x.any() for x in known)


def observe(params: WorldParams, state: WorldState, *, others: Discs | None = None) -> Reading:
    r"""What the sensors report in a pose.

    .. math::
        s_i = \min(R, \min_o t_o(\psi + \alpha_i)), \quad
        d = \min(D, |g - p|), \quad
        \beta = \operatorname{atan2}(u \times (g - p),\, u \cdot (g - p))

    Symbols: :math:`t_o` is the distance along the ray to obstacle, wall or other robot :math:`o`;
    :math:`\psi` is `state.heading`, :math:`\alpha_i` are `params.sonar_angles`, :math:`R` is
    `params.sonar_range` [px], :math:`D` is `params.distance_range` [px]; :math:`p` the pose,
    :math:`g` is `params.target`, :math:`u` the unit heading.

    Args:
        params: the map.
        state: one robot.
        others: other robots in the same world, which the sonars see.

    Returns:
        Reading; sonar from the robot's centre, without noise unless the noise fields are set. The
        noise of a step depends on `state.key` and `state.t` alone, so observing twice agrees.

    Source: Shim & Li (2017), section 2.4.2. The directions of the sonars are ours: the drawing of
    the car is lost.
    """
    position = jnp.stack([state.x, state.y])
    segments, circles = obstacles_at(params, state.t)

    def sonar(direction: Array) -> Array:
        seen = [
            jnp.where(
                params.segment_mask, geometry.ray_segments(position, direction, segments), jnp.inf
            ),
            jnp.where(
                params.circle_mask, geometry.ray_circles(position, direction, circles), jnp.inf
            ),
            geometry.ray_box(position, direction, params.bounds)[None],
        ]
        if others is not None:
            radii = jnp.broadcast_to(params.robot_radius, (others.centres.shape[0], 1))
            discs = jnp.concatenate([others.centres, radii], axis=1)
            hits = geometry.ray_circles(position, direction, discs)
            seen.append(jnp.where(others.mask, hits, jnp.inf))
        return jnp.min(jnp.concatenate(seen))

    angles = state.heading + jnp.deg2rad(params.sonar_angles)
    rays = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    ranges = jnp.minimum(jax.vmap(sonar)(rays), params.sonar_range)

    to_target = params.target - position
    ux, uy = jnp.cos(state.heading), jnp.sin(state.heading)
    angle = jnp.rad2deg(
        jnp.arctan2(ux * to_target[1] - uy * to_target[0], ux * to_target[0] + uy * to_target[1])
    )
    distance = jnp.sqrt(jnp.sum(to_target**2))

    if not _silent(params):
        n, noise_key = ranges.shape[0], jax.random.fold_in(state.key, state.t)
        noise = jax.random.normal(noise_key, (n + 2,), dtype=ranges.dtype)
        ranges = ranges + params.sonar_noise * noise[:n]
        distance = distance + params.distance_noise * noise[-2]
        angle = angle + params.angle_noise * noise[-1]
    ranges = jnp.clip(ranges, 0.0, params.sonar_range)
    ranges = jnp.where(params.sonar_failed, params.sonar_stuck, ranges)
    distance = jnp.clip(distance, 0.0, params.distance_range)
    # Noise may carry the angle over the cut; -180 itself is written as 180.
    angle = jnp.where(angle <= -180.0, angle + 360.0, angle)
    angle = jnp.where(angle > 180.0, angle - 360.0, angle)
    if params.way is None:
        return Reading(ranges, distance, angle)
    way_turn = turn_onto_way(params.way, state.x, state.y, state.heading)
    way_left = remaining_way(params.way, state.x, state.y)
    told = (way_turn.astype(angle.dtype), way_left.astype(angle.dtype))
    return Reading(ranges, distance, angle, *told)


def _heading_and_move(
    state: WorldState, steering: Float[Array, ""], params: WorldParams
) -> tuple[Array, Array]:
    heading = _wrap(state.heading + jnp.deg2rad(steering))
    return heading, params.speed * jnp.stack([jnp.cos(heading), jnp.sin(heading)])


def step(
    params: WorldParams,
    state: WorldState,
    steering: int | float | Float[Array, ""],
    *,
    others: Discs | None = None,
) -> tuple[WorldState, Outcome]:
    r"""Turn by `steering`, then drive `speed` pixels ahead, up to the first contact.

    .. math::
        \psi \leftarrow \psi + \theta, \qquad
        p \leftarrow p + \min(1, t_c, t_a)\, v\, (\cos\psi, \sin\psi)

    Symbols: :math:`\theta` is `steering` [deg, positive = left], :math:`v` is `params.speed`
    [px per control step]; :math:`t_c` is the fraction of the move at which the disc of
    `params.robot_radius` first touches anything, :math:`t_a` the one at which its centre comes
    within `params.arrival_radius` of the target. Both are exact for the straight move, so nothing
    is jumped over at any speed.

    Args:
        params: the map.
        state: one robot.
        steering: turn before the move [deg].
        others: other robots in the same world, which it can run into.

    Returns:
        WorldState after the step and its Outcome. When pose or steering is not finite the robot
        stays where it is and `failed` is set.

    Source: Shim & Li (2017), section 2.4.3 (speed 15 px, steering angle in degrees).
    Deviation: there a negative angle is to the left.
    """
    steering = jnp.asarray(steering, state.x.dtype)
    position = jnp.stack([state.x, state.y])
    finite = jnp.isfinite(steering) & jnp.isfinite(state.heading) & jnp.all(jnp.isfinite(position))
    heading, move = _heading_and_move(state, steering, params)
    segments, circles = obstacles_at(params, state.t)
    gone = _patrol(state.t + 1, params) - _patrol(state.t, params)

    contacts = [
        jnp.where(
            params.segment_mask,
            geometry.disc_segment_contact(
                position,
                move[None, :] - params.segment_velocity * gone,
                params.robot_radius,
                segments,
            ),
            jnp.inf,
        ),
        jnp.where(
            params.circle_mask,
            geometry.disc_circle_contact(
                position,
                move[None, :] - params.circle_velocity * gone,
                circles[:, :2],
                circles[:, 2] + params.robot_radius,
            ),
            jnp.inf,
        ),
        geometry.disc_box_contact(position, move, params.robot_radius, params.bounds)[None],
    ]
    if others is not None:
        reach = jnp.broadcast_to(2.0 * params.robot_radius, (others.centres.shape[0],))
        met = geometry.disc_circle_contact(
            position, move[None, :] - others.moves, others.centres, reach
        )
        contacts.append(jnp.where(others.mask, met, jnp.inf))
    collision = jnp.min(jnp.concatenate(contacts))
    arrival = geometry.disc_circle_contact(
        position, move[None, :], params.target[None, :], params.arrival_radius[None]
    )[0]

    arrived = finite & jnp.isfinite(arrival) & (arrival <= collision)
    collided = finite & jnp.isfinite(collision) & (collision < arrival)
    fraction = jnp.minimum(1.0, jnp.minimum(collision, arrival))
    reached = position + fraction * move
    after = WorldState(
        x=jnp.where(finite, reached[0], state.x),
        y=jnp.where(finite, reached[1], state.y),
        heading=jnp.where(finite, heading, state.heading),
        t=state.t + 1,
        key=state.key,
    )
    return after, Outcome(collided, arrived, ~finite)


def _seen_by_each(states: WorldState, moves: Array, active: Array) -> Discs:
    """For each robot the discs of all others: leaves `[r, r, ...]`, itself masked out."""
    n = active.shape[0]
    if n == 0:
        raise ValueError("robots=0: expected at least one robot; give one state for each")
    centres = jnp.stack([states.x, states.y], axis=1)
    return Discs(
        centres=jnp.broadcast_to(centres[None], (n, n, 2)),
        moves=jnp.broadcast_to(moves[None], (n, n, 2)),
        mask=active[None, :] & ~jnp.eye(n, dtype=bool),
    )


def observe_many(params: WorldParams, states: WorldState, *, active: Bool[Array, "r"]) -> Reading:
    """Readings of several robots in one world, whose sonars see one another.

    Args:
        params: one map, shared.
        states: leaves `[r, ...]`.
        active: robots that take part; the others are not there.

    Returns:
        Reading with leaves `[r, ...]`.
    """
    centres = jnp.stack([states.x, states.y], axis=1)
    discs = _seen_by_each(states, jnp.zeros_like(centres), active)
    return jax.vmap(lambda s, o: observe(params, s, others=o))(states, discs)


def step_many(
    params: WorldParams,
    states: WorldState,
    steering: Float[Array, "r"],
    *,
    active: Bool[Array, "r"],
) -> tuple[WorldState, Outcome]:
    """One control step of several robots in one world, which can run into one another.

    All move at once. Contact between two robots is exact for the moves that they set out on; a
    robot that something else stops earlier in the same step is still met where it was heading.

    Args:
        params: one map, shared.
        states: leaves `[r, ...]`.
        steering: turn of each robot [deg].
        active: robots that take part; the others stay as they are and are not there.

    Returns:
        States and Outcomes with leaves `[r, ...]`; no flag of an inactive robot is set.
    """
    _, moves = jax.vmap(lambda s, a: _heading_and_move(s, a, params))(states, steering)
    discs = _seen_by_each(states, moves, active)
    after, outcome = jax.vmap(lambda s, a, o: step(params, s, a, others=o))(states, steering, discs)
    kept = WorldState(
        x=jnp.where(active, after.x, states.x),
        y=jnp.where(active, after.y, states.y),
        heading=jnp.where(active, after.heading, states.heading),
        t=jnp.where(active, after.t, states.t),
        key=states.key,
    )
    flags = Outcome(*(flag & active for flag in outcome))
    return kept, flags
