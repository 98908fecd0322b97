"""Distance along the shortest way, and the reward that it shapes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import navigation, planner, scenarios, success_rate, world
from jaxsnn.drivers import drive_fixed, fixed_agent
from jaxsnn.network_input import input_rates
from jaxsnn.presets import preset
from jaxsnn.turn_goal import way_reward
from jaxsnn.way import WayLength, remaining_way, turn_onto_way
from jaxsnn.ways import training_map, way_length, with_way


@pytest.fixture(scope="module")
def detour():
    map = scenarios.detour(1)
    return map, way_length(map)


def test_the_grid_knows_the_planner_s_lengths(detour):
    map, way = detour
    points = np.array([[90.0, 300.0], [400.0, 500.0], [345.0, 95.0]])
    planned = planner.path_field(map).lengths(points)
    found = jax.vmap(lambda p: remaining_way(way, *p))(jnp.asarray(points, jnp.float32))
    np.testing.assert_allclose(found, planned, rtol=0.06)
    assert bool(jnp.isfinite(way.lengths).all())
    corner = remaining_way(way, jnp.float32(800.0), jnp.float32(600.0))
    assert bool(jnp.isfinite(corner))


def test_a_step_along_the_way_is_rewarded_though_it_leads_away(detour):
    map, way = detour
    before = world.WorldState(
        jnp.float32(90.0), jnp.float32(300.0), jnp.float32(-np.pi / 2), jnp.int32(0),
        jax.random.key(0),
    )  # fmt: skip
    after, outcome = world.step(map, before, 0.0)  # down, towards the gap below the wall
    straight = navigation.navigation_reward(map, before, after, outcome)
    along = navigation.navigation_reward(map, before, after, outcome, way)
    assert float(straight) < 0 < float(along)


def test_a_cell_without_size_is_refused():
    with pytest.raises(ValueError, match="cell=0: expected a number > 0"):
        way_length(scenarios.detour(1), cell=0)


@pytest.mark.parametrize("heading", [0.0, 0.5, -2.0, 3.0])
def test_the_turn_onto_the_way_points_down_a_plane(heading):
    x, y = np.meshgrid(np.arange(0.0, 200.0, 10.0), np.arange(0.0, 200.0, 10.0), indexing="ij")
    direction = np.array([np.cos(0.7), np.sin(0.7)])  # of the steepest way down
    lengths = 500.0 - direction[0] * x - direction[1] * y
    way = WayLength(jnp.asarray(lengths, jnp.float32), jnp.zeros(2), jnp.float32(10.0))
    at = jnp.float32(93.0), jnp.float32(111.0), jnp.float32(heading)
    wanted = np.rad2deg(np.angle(np.exp(1j * (0.7 - heading))))
    np.testing.assert_allclose(float(turn_onto_way(way, *at)), wanted, atol=0.01)
    flat = way._replace(lengths=jnp.zeros_like(way.lengths))
    assert float(turn_onto_way(flat, *at)) == 0.0


@pytest.mark.parametrize("price", [0.0, 3.0])
def test_a_dear_margin_keeps_the_way_clear_of_walls(price):
    """A driver that follows the ways arrives on every detour; on the shortest ones it scrapes."""
    keys = jax.random.split(jax.random.key(5), 4)
    follow = fixed_agent(
        lambda params, state, reading, fresh, active, *, key: (
            *(state, jnp.clip(reading.way_turn, -params, params)),
            *(None, jnp.zeros((0,))),
        )
    )

    @jax.jit
    def drive(limit, map):
        return success_rate(
            drive_fixed(follow, limit, map, keys=keys, n_trials=4, max_steps=200)
        ).mean()

    rates = [
        float(drive(jnp.float32(45.0), with_way(scenarios.detour(n), price=price)))
        for n in (1, 2, 3)
    ]
    assert min(rates) == 1.0 if price else min(rates) < 1.0, rates


def test_ways_change_what_is_rewarded_and_nothing_that_is_sensed():
    config, params = preset("S4", "way")
    plain = scenarios.detour(1)
    map = training_map(config, plain)
    assert training_map(preset("S4", "guided")[0], plain) is plain
    state = world.reset(plain, key=jax.random.key(2))
    seen, plainly = world.observe(map, state), world.observe(plain, state)
    assert plainly.way_turn is None and abs(float(seen.way_turn)) <= 180.0
    np.testing.assert_array_equal(
        input_rates(config, params, seen, jnp.float32(0.0)),
        input_rates(config, params, plainly, jnp.float32(0.0)),
    )
    left = way_reward(params.goal, seen._replace(way_turn=jnp.float32(30.0)), jnp.float32(15.0))
    np.testing.assert_allclose(left, [-0.5, 0.5])  # 2 (30 - 15) / 60
    far = way_reward(params.goal, seen._replace(way_turn=jnp.float32(-170.0)), jnp.float32(0.0))
    np.testing.assert_allclose(far, [1.5, -1.5])  # at most `towards`, 45
    with pytest.raises(ValueError, match="expected a map with its shortest ways"):
        way_reward(params.goal, plainly, jnp.float32(0.0))


@pytest.mark.parametrize(
    ("name", "value"), [("margin", 0.0), ("price", -1.0), ("price", float("nan"))]
)
def test_ways_refuse_prices_that_are_none(name, value):
    with pytest.raises(ValueError, match=f"{name}={value}: expected"):
        way_length(scenarios.detour(1), **{name: value})
