"""One definition of intervals: networks, rewards and Q-learning see the same regions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import encoding, qlearning, rewards, sensor_intervals, world

BORDERS = {45.0: 0, -45.0: 0, 45.5: 3, -45.5: 1, 135.0: 3, -135.0: 1, 135.5: 2, -135.5: 2, 180.0: 2}


@pytest.mark.parametrize(("angle", "region"), BORDERS.items())
def test_regions_run_clockwise_from_the_heading_and_are_mirror_images(angle, region):
    assert int(sensor_intervals.angle_region(jnp.asarray(angle))) == region
    mirrored = {0: 0, 1: 3, 2: 2, 3: 1}[region]
    if angle != 180.0:
        assert int(sensor_intervals.angle_region(jnp.asarray(-angle))) == mirrored


@pytest.mark.parametrize("angle", BORDERS)
def test_networks_rewards_and_q_learning_agree_at_every_border(angle):
    region = int(sensor_intervals.angle_region(jnp.asarray(angle)))
    sonar, distance = jnp.full(5, 300.0), jnp.asarray(100.0)
    table = encoding.rate_table("proposed")
    rate = encoding.group_rates(table, sonar, distance, jnp.asarray(angle))[-1]
    assert float(rate) == float(table.angle[region])
    row = qlearning.discretize(world.Reading(sonar, distance, jnp.asarray(angle)))
    assert int(row) % 4 == region
    left, right = rewards.motor_rewards(
        rewards.RewardParams(), sonar, distance, jnp.asarray(angle)
    ).tolist()
    # Region 2 of the source (1 here) rewards the left motor, which turns right; 4 the right one.
    assert (left > 0, right > 0) == (region == 1, region == 3)


def test_bounds_belong_to_the_interval_above():
    readings = np.array([0.0, 99.9, 100.0, 199.9, 200.0, 300.0], np.float32)
    assert jax.jit(sensor_intervals.sonar_interval)(readings).tolist() == [0, 0, 1, 1, 2, 2]
    readings = np.array([0.0, 199.9, 200.0, 599.9, 600.0, 800.0], np.float32)
    assert sensor_intervals.distance_interval(jnp.asarray(readings)).tolist() == [0, 0, 1, 2, 3, 3]
