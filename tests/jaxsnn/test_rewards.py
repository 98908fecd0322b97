"""Equations 2.9 and 2.10, who gets them, and the sign table of section 2.3.2."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import rewards
from jaxsnn.rewards import RewardParams

LEFT, RIGHT = 0, 1
FREE = jnp.full(5, 300.0)
FAR = jnp.asarray(500.0)


def sonar(*at):
    readings = np.full(5, 300.0, np.float32)
    for index, value in at:
        readings[index] = value
    return jnp.asarray(readings)


@pytest.mark.parametrize(("rule", "k"), [("additive", 0.3), ("multiplicative", 1.3)])
def test_avoidance_values(rule, k):
    params = rewards.reward_params(rule)
    got = rewards.avoidance_rewards(params, jnp.array([0.0, 40.0, 99.0, 100.0, 250.0]))
    r1 = [1.0 + k, 0.6 + k, 0.01 + k, 0.0, 0.0]
    np.testing.assert_allclose(got[:, 0], r1, rtol=1e-6)
    np.testing.assert_allclose(got[:, 1], -np.array(r1), rtol=1e-6)


def test_target_values():
    got = rewards.target_reward(RewardParams(), jnp.array([0.0, 50.0, 199.0, 200.0, 700.0]))
    np.testing.assert_allclose(got, [2.0, 1.75, 1.005, 0.0, 0.0], rtol=1e-6)


@pytest.mark.parametrize("index", [3, 4])
def test_obstacle_on_the_right_favours_the_right_motor(index):
    got = rewards.motor_rewards(RewardParams(), sonar((index, 50.0)), FAR, jnp.asarray(0.0))
    np.testing.assert_allclose(got, [-1.8, 1.8], rtol=1e-6)
    mirror = rewards.motor_rewards(RewardParams(), sonar((4 - index, 50.0)), FAR, jnp.asarray(0.0))
    np.testing.assert_allclose(mirror, got[::-1])


def test_obstacle_ahead_is_on_the_nearer_side_or_on_none():
    params = RewardParams()
    ahead = rewards.motor_rewards(params, sonar((2, 20.0)), FAR, jnp.asarray(0.0))
    np.testing.assert_array_equal(ahead, [0.0, 0.0])
    got = rewards.motor_rewards(params, sonar((2, 20.0), (0, 150.0)), FAR, jnp.asarray(0.0))
    np.testing.assert_allclose(got, [2.1, -2.1], rtol=1e-6)  # size by the nearest, side by the left


@pytest.mark.parametrize(
    ("angle", "want"), [(0.0, (0, 0)), (-90.0, (1.5, 0)), (180.0, (0, 0)), (90.0, (0, 1.5))]
)
def test_target_reward_by_region(angle, want):
    near = jnp.asarray(100.0)
    got = rewards.motor_rewards(RewardParams(), FREE, near, jnp.asarray(angle))
    np.testing.assert_allclose(got, want)
    opposed = rewards.motor_rewards(RewardParams(opponent=1.0), FREE, near, jnp.asarray(angle))
    np.testing.assert_allclose(opposed, np.array(want) - np.array(want)[::-1])


def test_rewards_add_up():
    got = rewards.motor_rewards(
        RewardParams(), sonar((4, 50.0)), jnp.asarray(100.0), jnp.asarray(-90.0)
    )
    np.testing.assert_allclose(got, [-1.8 + 1.5, 1.8], rtol=1e-6)


def test_terminal():
    false, true, params = jnp.asarray(False), jnp.asarray(True), RewardParams()
    assert float(rewards.terminal_reward(params, true, false)) == -2.0
    assert float(rewards.terminal_reward(params, false, true)) == 2.0
    assert float(rewards.terminal_reward(params, false, false)) == 0.0


@pytest.mark.parametrize(
    ("first", "second", "want"),
    [  # section 2.3.2, word by word
        (-1, -1, (+1, -1)),  # I-I: potentiate the first, depress the second
        (-1, +1, (-1, +1)),  # I-E: depress the first, potentiate the second
        (+1, -1, (-1, -1)),  # E-I: depress the first, depress the second
        (+1, +1, (+1, +1)),  # E-E: potentiate both
    ],
)
def test_sign_table(first, second, want):
    one, two = rewards.synapse_signs(jnp.array([float(first)]), jnp.array([float(second)]))
    assert (float(one[0, 0]), float(two[0])) == want


@pytest.mark.parametrize(
    ("change", "part"),
    [({"d_safe": 0.0}, "d_safe=0"), ({"collision": float("nan")}, "collision")],
)
def test_bad_constants_are_named(change, part):
    with pytest.raises(ValueError, match=part):
        rewards.check_rewards(RewardParams(**change))


def test_a_scaled_reward_ends_at_the_goal_and_turns_round_behind_it():
    params = RewardParams(goal_angle=50.0)
    left = jnp.array([-1.5, 1.5])
    factors = {-50.0: 1.0, 0.0: 1.0, 25.0: 0.5, 50.0: 0.0, 75.0: -0.5, 500.0: -1.0}
    for angle, factor in factors.items():
        got = rewards.scale_by_remaining_turn(params, left, jnp.asarray(angle))
        np.testing.assert_allclose(got, factor * left, atol=1e-6)
        mirrored = rewards.scale_by_remaining_turn(params, left[::-1], jnp.asarray(-angle))
        np.testing.assert_allclose(mirrored, got[::-1], atol=1e-6)
    literal = rewards.scale_by_remaining_turn(RewardParams(), left, jnp.asarray(400.0))
    np.testing.assert_array_equal(literal, left)
    both = jnp.array([-2.0, -2.0])
    np.testing.assert_array_equal(
        rewards.scale_by_remaining_turn(params, both, jnp.asarray(80.0)), both
    )


def test_avoidance_first_silences_the_target_near_obstacles():
    map = sonar((0, 50.0)), jnp.asarray(50.0), jnp.asarray(90.0)
    with_target = rewards.motor_rewards(RewardParams(opponent=1.0), *map)
    first = rewards.motor_rewards(RewardParams(opponent=1.0, target_near_obstacle=0.0), *map)
    np.testing.assert_allclose(first, [1.8, -1.8], rtol=1e-6)
    np.testing.assert_allclose(with_target - first, [-1.75, 1.75], rtol=1e-6)


def test_a_goal_angle_must_be_positive():
    with pytest.raises(ValueError, match="goal_angle=0"):
        rewards.check_rewards(RewardParams(goal_angle=0.0))


def test_what_is_nearest_straight_ahead_rewards_the_turn_that_is_made_anyway():
    """With `commit`; a robot that goes straight on turns left, and a tie with a side is ahead."""
    params, straight = RewardParams(commit=1.0), jnp.asarray(0.0)
    to_left, to_right = [-2.1, 2.1], [2.1, -2.1]
    for turn, want in ((10.0, to_left), (0.0, to_left), (-10.0, to_right)):
        got = rewards.motor_rewards(params, sonar((2, 20.0)), FAR, straight, jnp.asarray(turn))
        np.testing.assert_allclose(got, want, rtol=1e-6)
    tie = sonar((2, 20.0), (4, 20.0))  # by its side alone it would reward turning left
    got = rewards.motor_rewards(params, tie, FAR, straight, jnp.asarray(-10.0))
    np.testing.assert_allclose(got, to_right, rtol=1e-6)
    # What is nearer on a side than ahead, and every obstacle without `commit`, goes by its side.
    aside = sonar((2, 60.0), (4, 20.0))
    got = rewards.motor_rewards(params, aside, FAR, straight, jnp.asarray(-10.0))
    np.testing.assert_allclose(got, to_left, rtol=1e-6)
    got = rewards.motor_rewards(RewardParams(), tie, FAR, straight, jnp.asarray(-10.0))
    np.testing.assert_allclose(got, to_left, rtol=1e-6)


def test_at_the_border_of_a_range_there_is_no_reward_left():
    """`d < d_safe` in Eq. 2.9, `d < d_tar` in Eq. 2.10, where what follows is not zero."""
    assert rewards.avoidance_rewards(RewardParams(), jnp.array([100.0])).tolist() == [[0.0, 0.0]]
    assert rewards.target_reward(RewardParams(), jnp.array([200.0])).tolist() == [0.0]
