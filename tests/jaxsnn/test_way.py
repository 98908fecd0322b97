"""Distance along the shortest way, and the reward that it shapes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import navigation, planner, scenarios, world
from jaxsnn.way import remaining_way, way_length


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
