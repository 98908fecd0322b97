"""The robot world: sensors against shapely, mirror symmetry, no tunnelling, arrival, extensions."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from jaxsnn import maps, planner, random_maps, scenarios, world

N = 256

# Compiled once for the whole file.
reset = jax.jit(world.reset)
observe = jax.jit(world.observe)
step = jax.jit(world.step)
reset_all = jax.jit(lambda keys, params: jax.vmap(lambda k: world.reset(params, key=k))(keys))
observe_all = jax.jit(jax.vmap(world.observe, (None, 0)))
step_all = jax.jit(jax.vmap(world.step, (None, 0, 0)))


def shapes(params: world.WorldParams) -> tuple[Any, Any, np.ndarray]:
    """Polygons, polygons with the walls, and the circles, in float64."""
    still = planner.Obstacles.of(params)
    solid = shapely.union_all([shapely.Polygon(loop) for loop in still.loops()])
    return solid, shapely.union_all([solid, shapely.box(*still.bounds).exterior]), still.circles


def gap_to_everything(lines: np.ndarray, params: world.WorldParams) -> np.ndarray:
    """Distance of shapely lines to the nearest polygon, wall or circle."""
    _, everything, circles = shapes(params)
    gap = shapely.distance(lines, everything)
    for x, y, r in circles:
        gap = np.minimum(gap, shapely.distance(lines, shapely.Point(x, y)) - r)
    return gap


def ray_cast(xy: np.ndarray, angles: np.ndarray, params: world.WorldParams) -> np.ndarray:
    """Sonars by shapely: polygons and walls cut the ray, a circle cuts it before its foot."""
    _, everything, circles = shapes(params)
    xy = np.broadcast_to(xy[:, None], (*angles.shape, 2))
    tips = xy + 300.0 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    rays = shapely.linestrings(np.stack([xy, tips], axis=-2))
    hits = shapely.intersection(rays, everything)
    reach = np.where(shapely.is_empty(hits), 300.0, shapely.distance(hits, shapely.points(xy)))
    for x, y, r in circles:
        centre = shapely.Point(x, y)
        foot, off = shapely.line_locate_point(rays, centre), shapely.distance(rays, centre)
        # The foot at an end of the ray says nothing about where it meets the circle, but there
        # the circle is out of reach, or so little in reach that the caller drops the ray.
        cut = foot - np.sqrt(np.maximum(r**2 - off**2, 0.0))
        reach = np.where((off < r) & (foot > 0), np.minimum(reach, cut), reach)
    return reach


@functools.cache
def rollout(steps: int) -> Callable[..., Any]:
    """N robots under random steering; a robot stays where its trial ends."""

    @jax.jit
    @chex.assert_max_traces(n=1)
    def run(key: jax.Array, params: world.WorldParams) -> tuple[world.WorldState, Any, Any]:
        k_reset, k_steer = jax.random.split(key)
        first = jax.vmap(lambda k: world.reset(params, key=k))(jax.random.split(k_reset, N))
        steering = 25.0 * jax.random.normal(k_steer, (steps, N))

        def body(carry: tuple[world.WorldState, jax.Array], theta: jax.Array) -> tuple[Any, Any]:
            states, over = carry
            after, outcome = jax.vmap(lambda s, a: step(params, s, a))(states, theta)
            after = jax.tree.map(lambda old, new: jnp.where(over, old, new), states, after)
            flags = world.Outcome(*(f & ~over for f in outcome))
            over = over | flags.collided | flags.arrived
            return (after, over), (after, flags)

        return first, *jax.lax.scan(body, (first, jnp.zeros(N, bool)), steering)[1]

    return run


@pytest.fixture(scope="module", params=[1, 2, 3, "random", "fast"])
def case(request: pytest.FixtureRequest) -> tuple[world.WorldParams, Any, Any, Any]:
    """A map and a rollout on it; "fast" moves 400 px in a step, over whole obstacles."""
    if request.param == "random":
        params = random_maps.random_map(key=jax.random.key(5))
    elif request.param == "fast":
        params = scenarios.scenario(3)._replace(speed=jnp.float32(400.0))
    else:
        params = scenarios.scenario(request.param)
    return params, *rollout(60)(jax.random.key(7), params)


def test_sonar_equals_shapely_ray_casting(case: tuple) -> None:
    params, first, _, _ = case
    rng = np.random.default_rng(0)
    states = first._replace(
        x=jnp.asarray(rng.uniform(1, 799, N), jnp.float32),
        y=jnp.asarray(rng.uniform(1, 599, N), jnp.float32),
        heading=jnp.asarray(rng.uniform(-np.pi, np.pi, N), jnp.float32),
    )
    with jax.enable_x64(True):
        wide = jax.tree.map(
            lambda a: a.astype(jnp.float64) if a.dtype == jnp.float32 else a, (params, states)
        )
        exact = observe_all(*wide)
        exact = jax.tree.map(np.asarray, exact)
    single = observe_all(params, states)

    solid, _, circles = shapes(params)
    xy = np.stack([states.x, states.y], axis=1).astype(np.float64)
    inside = shapely.contains(solid, shapely.points(xy))
    for x, y, r in circles:
        inside |= np.hypot(*(xy - [x, y]).T) < r
    angles = np.asarray(states.heading, np.float64)[:, None] + np.deg2rad([60, 30, 0, -30, -60])
    reach = ray_cast(xy, angles, params)
    # A ray that grazes a corner may hit or miss: leave it out if a hair to either side differs.
    beside = [ray_cast(xy, angles + turn, params) for turn in (-1e-5, 1e-5)]
    steady = ~inside[:, None] & (np.ptp(beside, axis=0) < 0.05)
    # The end of a ray inside a circle is where the foot of ray_cast is not the circle's.
    tips = xy[:, None] + 300.0 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    for x, y, r in circles:
        steady &= np.hypot(tips[..., 0] - x, tips[..., 1] - y) > r
    assert steady.mean() > 0.8
    np.testing.assert_allclose(exact.sonar[steady], reach[steady], atol=1e-4)
    # Single precision: 1e-4 of the range.
    np.testing.assert_allclose(np.asarray(single.sonar)[steady], reach[steady], atol=1e-4 * 300.0)


def test_distance_and_angle_in_a_known_pose() -> None:
    params = scenarios.scenario(1)
    state = reset(params, key=jax.random.key(0))
    state = state._replace(x=jnp.float32(400.0), y=jnp.float32(200.0), heading=jnp.float32(0.0))
    reading = observe(params, state)
    np.testing.assert_allclose(reading.distance, 100.0)
    np.testing.assert_allclose(reading.angle, 90.0)  # target straight above: to the left
    away = observe(params, state._replace(heading=jnp.float32(-np.pi / 2)))
    np.testing.assert_allclose(np.abs(away.angle), 180.0, rtol=1e-6)


def test_angle_lies_in_the_half_open_interval(case: tuple) -> None:
    params, _, states, _ = case
    poses = jax.tree.map(lambda a: a[10], states)
    reading = observe_all(params, poses)
    assert (reading.angle > -180.0).all()
    assert (reading.angle <= 180.0).all()
    assert (reading.sonar >= 0).all()
    assert (reading.sonar <= 300.0).all()


def mirror(params: world.WorldParams) -> world.WorldParams:
    """The map upside down."""
    height = params.bounds[1] + params.bounds[3]

    def flip(a: jax.Array, columns: list[int]) -> jax.Array:
        return a.at[:, jnp.asarray(columns)].set(height - a[:, jnp.asarray(columns)])

    return params._replace(
        segments=flip(params.segments, [1, 3]),
        circles=flip(params.circles, [1]),
        starts=flip(params.starts, [1]),
        target=params.target.at[1].set(height - params.target[1]),
    )


def test_mirrored_world_gives_mirrored_readings(case: tuple) -> None:
    params, first, _, _ = case
    reflected = mirror(params)
    twins = first._replace(y=params.bounds[1] + params.bounds[3] - first.y, heading=-first.heading)
    steering = jnp.linspace(-90.0, 90.0, N)
    for _ in range(2):
        here, there = observe_all(params, first), observe_all(reflected, twins)
        # 256 poses: a ray that grazes a corner in one world may miss it in the other.
        same = np.isclose(here.sonar, there.sonar[:, ::-1], atol=2e-2).mean()
        assert same > 0.995
        np.testing.assert_allclose(here.distance, there.distance, atol=1e-3)
        np.testing.assert_allclose(here.angle, -there.angle, atol=1e-2)
        first, a = step_all(params, first, steering)
        twins, b = step_all(reflected, twins, -steering)
        np.testing.assert_array_equal(a.collided, b.collided)
        np.testing.assert_array_equal(a.arrived, b.arrived)
        np.testing.assert_allclose(first.x, twins.x, atol=5e-2)


def test_no_path_crosses_an_obstacle(case: tuple) -> None:
    """Shapely sees the disc clear of everything on every step; contacts leave it touching."""
    params, first, states, outcome = case
    xs = np.concatenate([np.asarray(first.x)[None], states.x]).astype(np.float64)
    ys = np.concatenate([np.asarray(first.y)[None], states.y]).astype(np.float64)
    points = np.stack([xs, ys], axis=-1)
    steps = shapely.linestrings(np.stack([points[:-1], points[1:]], axis=-2))
    gap = gap_to_everything(steps, params)
    collided, arrived = np.asarray(outcome.collided), np.asarray(outcome.arrived)
    assert collided.any()
    assert not (collided & arrived).any()
    # Single precision at 800 px, and at 400 px in a step.
    assert gap.min() > 6.0 - 2e-3
    np.testing.assert_allclose(gap[collided], 6.0, atol=2e-3)
    target = np.asarray(params.target, np.float64)
    at = np.hypot(*(points[1:][arrived] - target).T)
    np.testing.assert_allclose(at, 35.0, atol=2e-3)
    still = ~(np.cumsum(collided | arrived, axis=0) > 0)
    assert shapely.distance(steps, shapely.Point(target))[still].min() > 35.0 - 2e-3


def test_thin_obstacle_stops_a_robot_at_any_speed() -> None:
    wall = [(400.0, 50.0), (400.01, 50.0), (400.01, 550.0), (400.0, 550.0)]
    params = maps.make_map([wall], target=(700, 300), starts=[(100, 300, 0)], heading_spread=0.0)
    state = reset(params, key=jax.random.key(0))
    for speed in (15.0, 299.0, 600.0, 1e4):
        here, outcome = state, world.Outcome(jnp.zeros((), bool), jnp.zeros((), bool))
        while not (outcome.collided | outcome.arrived):
            here, outcome = step(params._replace(speed=jnp.float32(speed)), here, 0.0)
        assert outcome.collided
        np.testing.assert_allclose(here.x, 394.0, atol=1e-3)


def test_target_before_obstacle_is_an_arrival_and_behind_it_a_collision() -> None:
    params = maps.make_map(
        [[(300.0, 270.0), (310.0, 270.0), (310.0, 330.0), (300.0, 330.0)]],
        target=(400, 300),
        starts=[(100, 300, 0), (600, 300, 0)],
        heading_spread=0.0,
        speed=500.0,
    )
    for circle, arrives in ((0, False), (1, True)):
        state = reset(params, key=jax.random.key(0), circle=circle)
        _, outcome = step(params, state, 0.0)
        assert bool(outcome.arrived) is arrives
        assert bool(outcome.collided) is not arrives


def test_steering_is_positive_to_the_left_and_the_speed_is_15() -> None:
    params = scenarios.scenario(1)
    state = reset(params, key=jax.random.key(3), circle=0)._replace(heading=jnp.float32(0.0))
    after, _ = step(params, state, 90.0)
    np.testing.assert_allclose(after.y - state.y, 15.0, rtol=1e-5)
    np.testing.assert_allclose(after.x, state.x, atol=1e-4)
    assert after.t == 1


def test_starts_fill_the_circles_and_face_the_target() -> None:
    params = scenarios.scenario(2)
    states = reset_all(jax.random.split(jax.random.key(1), 4000), params)
    xy = np.stack([states.x, states.y], axis=1)
    gaps = np.hypot(*np.moveaxis(xy[:, None] - np.asarray(params.starts)[None, :, :2], -1, 0))
    assert gaps.min(axis=1).max() <= 40.0 + 1e-3
    left = gaps[:, 0] < gaps[:, 1]
    assert abs(left.mean() - 0.5) < 0.04  # five standard errors
    # Uniform in area: half of the starts lie within R / sqrt(2).
    assert abs((gaps.min(axis=1) < 40.0 / np.sqrt(2)).mean() - 0.5) < 0.04
    reading = observe_all(params, states)
    assert np.abs(reading.angle).max() <= 45.0 + 1e-3
    assert np.abs(reading.angle).mean() == pytest.approx(22.5, abs=1.1)


def test_vmap_over_maps_equals_a_loop() -> None:
    three = [scenarios.scenario(n) for n in (1, 2, 3)]
    keys = jax.random.split(jax.random.key(4), 3)

    def one(key: jax.Array, params: world.WorldParams) -> tuple[world.Reading, world.WorldState]:
        state = world.reset(params, key=key)
        return world.observe(params, state), world.step(params, state, 5.0)[0]

    together = jax.jit(jax.vmap(one))(keys, maps.stack_maps(three))
    for i, params in enumerate(three):
        state = reset(params, key=keys[i])
        reading, after = observe(params, state), step(params, state, 5.0)[0]
        pair = (jax.tree.leaves(readings) for readings in (together[0], reading))
        for a, b in zip(*pair, strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-5, atol=1e-3)
        np.testing.assert_allclose(together[1].x[i], after.x, rtol=1e-6)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_steering_stops_that_robot_only(bad: float) -> None:
    params = scenarios.scenario(1)
    states = reset_all(jax.random.split(jax.random.key(0), 2), params)
    after, outcome = step_all(params, states, jnp.asarray([bad, 0.0]))
    assert outcome.failed.tolist() == [True, False]
    assert not (outcome.collided | outcome.arrived).any()
    assert after.x[0] == states.x[0]
    assert after.x[1] != states.x[1]
    assert np.isfinite(after.heading).all()


# --- extensions --------------------------------------------------------------------------------


def test_moving_circle_runs_into_a_robot_that_it_would_jump_over() -> None:
    """The circle moves 200 px per step through the robot's map: only a swept test sees it."""
    params = maps.make_map(
        circles=[(100, 300, 20)],
        circle_velocity=[(200, 0)],
        patrol_steps=3,
        target=(400, 500),
        starts=[(200, 300, 0)],
        speed=1e-3,
    )
    state = reset(params, key=jax.random.key(0))
    _, outcome = step(params, state, 0.0)
    assert outcome.collided
    parked = params._replace(circle_velocity=jnp.zeros_like(params.circle_velocity))
    assert not step(parked, state, 0.0)[1].collided


def test_obstacles_patrol_and_sonars_see_them_move() -> None:
    params = maps.make_map(
        [[(300.0, 250.0), (350.0, 250.0), (350.0, 350.0), (300.0, 350.0)]],
        polygon_velocity=[(-10, 0)],
        patrol_steps=2,
        target=(700, 300),
        starts=[(100, 300, 0)],
        heading_spread=0.0,
    )
    state = reset(params, key=jax.random.key(0))
    ahead = [float(observe(params, state._replace(t=jnp.int32(t))).sonar[2]) for t in range(6)]
    np.testing.assert_allclose(ahead, [200, 190, 180, 190, 200, 190], atol=1e-3)


def test_noise_has_the_stated_deviation_and_failed_sonars_stick() -> None:
    plain = scenarios.scenario(1)
    noisy = maps.make_map(
        target=(400, 300),
        starts=[(150, 300, 0)],
        heading_spread=0.0,
        sonar_noise=3.0,
        distance_noise=2.0,
        angle_noise=1.0,
        sonar_stuck={1: 0.0, 4: 120.0},
    )
    state = reset(noisy, key=jax.random.key(0))._replace(heading=jnp.float32(np.pi))
    states = jax.vmap(lambda t: state._replace(t=t))(jnp.arange(2000))
    reading = observe_all(noisy, states)
    assert reading.sonar[:, 2].std() == pytest.approx(3.0, rel=0.1)
    assert reading.sonar[:, 2].mean() == pytest.approx(150.0, abs=0.4)
    assert reading.distance.std() == pytest.approx(2.0, rel=0.1)
    assert (reading.angle <= 180.0).all()
    assert (reading.angle > -180.0).all()
    off = np.where(reading.angle > 0, reading.angle - 180.0, reading.angle + 180.0)
    assert off.std() == pytest.approx(1.0, rel=0.1)
    assert (reading.sonar[:, 1] == 0.0).all()
    assert (reading.sonar[:, 4] == 120.0).all()
    again = observe(noisy, state)
    np.testing.assert_array_equal(again.sonar, observe(noisy, state).sonar)
    clean = reset(plain, key=jax.random.key(0))
    np.testing.assert_array_equal(
        observe(plain, clean).sonar,
        observe(plain, clean._replace(key=jax.random.key(9))).sonar,
    )


def test_robots_in_one_world_see_and_hit_one_another() -> None:
    params = maps.make_map(target=(400, 550), starts=[(100, 100, 0)])
    one = reset(params, key=jax.random.key(0))
    states = jax.tree.map(lambda a: jnp.broadcast_to(a, (3, *a.shape)), one)._replace(
        x=jnp.asarray([100.0, 160.0, 100.0]),
        y=jnp.asarray([300.0, 300.0, 500.0]),
        heading=jnp.asarray([0.0, np.pi, 0.0], jnp.float32),
    )
    everyone = jnp.ones(3, bool)
    reading = jax.jit(world.observe_many)(params, states, active=everyone)
    np.testing.assert_allclose(reading.sonar[:2, 2], 60.0 - 6.0, rtol=1e-5)
    np.testing.assert_allclose(reading.sonar[2, 2], 300.0)
    fast = params._replace(speed=jnp.float32(100.0))  # they would swap places
    step_many = jax.jit(world.step_many)
    after, outcome = step_many(fast, states, jnp.zeros(3), active=everyone)
    assert outcome.collided.tolist() == [True, True, False]
    # They meet half way, their centres two radii apart.
    np.testing.assert_allclose(after.x[1] - after.x[0], 12.0, atol=1e-3)
    np.testing.assert_allclose((after.x[0] + after.x[1]) / 2, 130.0, atol=1e-3)
    alone = jnp.asarray([True, False, True])
    after, outcome = step_many(fast, states, jnp.zeros(3), active=alone)
    assert not outcome.collided.any()
    assert after.x[1] == 160.0
    with pytest.raises(ValueError, match="at least one robot"):
        world.step_many(
            fast, jax.tree.map(lambda a: a[:0], states), jnp.zeros(0), active=jnp.zeros(0, bool)
        )
