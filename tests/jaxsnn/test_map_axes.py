"""What makes a map harder leaves its walls, its target and its admission alone."""

from __future__ import annotations

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import families, planner, world
from jaxsnn.drivers import DRIVERS, drive_together
from jaxsnn.families import family_map
from jaxsnn.map_axes import MOST, PATROL_STEPS, hardened
from jaxsnn.maps import make_map
from jaxsnn.status import Status

BARE = ("detour", "test", 3)
AXES = (
    {"moving": 4},
    {"robots": 4},
    {"sonar_stuck": {1: 20.0}},
    {"sonar_noise": 12.0, "distance_noise": 30.0, "angle_noise": 10.0},
)


@pytest.mark.parametrize("axis", AXES, ids=lambda a: next(iter(a)))
def test_an_option_leaves_walls_target_and_first_start_as_they_are(axis):
    bare, hard = family_map(*BARE), family_map(*BARE, **axis)
    for name in ("segments", "segment_mask", "segment_velocity", "bounds", "target", "speed"):
        np.testing.assert_array_equal(getattr(bare, name), getattr(hard, name), err_msg=name)
    np.testing.assert_array_equal(bare.starts[0], hard.starts[0])
    changed = {
        name for name, a, b in zip(bare._fields, bare, hard, strict=True)
        if a is not None and not (a.shape == b.shape and bool((a == b).all()))
    }  # fmt: skip
    wanted = {
        "moving": {"circles", "circle_mask", "circle_velocity", "patrol_steps"},
        "robots": {"starts", "start_probs"},
        "sonar_stuck": {"sonar_failed", "sonar_stuck"},
    }
    assert changed == wanted.get(next(iter(axis)), set(axis))


def test_admission_measures_the_bare_map_whatever_is_added(monkeypatch):
    seen = []

    def admitted(measured):
        seen.append(measured)
        return rule(measured)

    rule = families.is_admitted
    monkeypatch.setattr(families, "is_admitted", admitted)
    for axis in ({}, {"moving": 2, "sonar_stuck": dict.fromkeys(range(5), 0.0), "robots": 2}):
        families.admitted_draw.cache_clear()
        family_map("detour", "train", 0, **axis)
    half = len(seen) // 2
    assert half and seen[:half] == seen[half:]


def test_moving_obstacles_keep_clear_of_what_stands_still_and_are_the_same_for_ever():
    map = family_map(*BARE, moving=4)
    jax.tree.map(np.testing.assert_array_equal, map, family_map(*BARE, moving=4))
    np.testing.assert_array_equal(map.circles[:2], family_map(*BARE, moving=2).circles[:2])
    assert int(map.circle_mask.sum()) == 4 and int(map.patrol_steps) == PATROL_STEPS
    still = planner.Obstacles.of(family_map(*BARE))
    start, target = np.asarray(map.starts[0]), np.asarray(map.target)
    for t in range(2 * PATROL_STEPS):
        x, y, radius = np.asarray(world.obstacles_at(map, jnp.asarray(t))[1], np.float64)[:4].T
        at = np.stack([x, y], axis=1)
        assert (still.clearance(at, at) > radius - 1e-3).all()
        assert (np.hypot(*(at - start[:2]).T) > radius + start[2] + 6.0).all()
        assert (np.hypot(*(at - target).T) > radius + 35.0).all()
    assert np.hypot(*np.asarray(map.circle_velocity[:4]).T).min() > 1.9


def test_robots_begin_apart_with_as_long_a_way_to_go():
    map = family_map(*BARE, robots=5)
    starts = np.asarray(map.starts, np.float64)
    assert starts.shape == (5, 3) and (starts[:, 2] == 30.0).all()
    gaps = np.hypot(*(starts[:, None, :2] - starts[None, :, :2]).transpose(2, 0, 1))
    assert gaps[~np.eye(5, dtype=bool)].min() > 72.0
    ways = planner.path_field(map).lengths(starts[:, :2])
    assert np.isfinite(ways).all() and (ways >= 0.75 * ways[0]).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"moving": -1}, "moving=-1: expected a whole number >= 0"),
        ({"moving": MOST + 1}, "moving=9: expected at most 8; lower it"),
        ({"robots": 0}, "robots=0: expected a whole number >= 1"),
        ({"robots": MOST + 1}, "robots=9: expected at most 8"),
        ({"sonar_stuck": {7: 20.0}}, "sonar_stuck={7: 20.0}: expected a sonar 0..4"),
        ({"sonar_noise": -1.0}, "sonar_noise=-1.0: expected"),
        ({"angle_noise": float("nan")}, "angle_noise=nan: expected"),
    ],
)
def test_options_out_of_range_are_refused_by_name(options, message):
    with pytest.raises(ValueError, match=message):
        family_map(*BARE, **options)


def test_options_of_another_form_are_refused_by_name():
    draw = families.admitted_draw(*BARE)
    for options, error, message in (
        ({"moving": 2.0}, TypeError, "moving=2.0: expected a whole number"),
        ({"sonar_stuck": [20.0]}, ValueError, r"sonar_stuck=\[20.0\]: expected {index:"),
    ):
        with pytest.raises(error, match=message):
            inspect.unwrap(hardened)(*draw, np.random.default_rng(0), **options)


def test_robots_together_hit_one_another_and_one_after_the_other_do_not():
    """Two that start face to face, the target of both in between but not in reach at first."""
    blind = jax.tree.map(jnp.float32, DRIVERS["blind"])
    keys = jax.random.split(jax.random.key(0), 3)
    options = {"arrival_radius": 2.0, "heading_spread": 0.0, "max_segments": 4, "max_circles": 1}
    both = make_map(target=(400, 300), starts=[(200, 300, 0), (600, 300, 0)], **options)
    np.testing.assert_array_equal(drive_together(blind, both, keys=keys), Status.COLLIDED)
    later = make_map(target=(400, 300), starts=[(200, 300, 0), (700, 300, 0)], **options)
    found = np.asarray(drive_together(blind, later, keys=keys))
    assert (found == Status.ARRIVED).all()  # who has arrived is in nobody's way
    near = np.asarray(drive_together(blind, later, keys=keys, max_steps=15))
    assert near.tolist() == [[Status.ARRIVED, Status.TIMEOUT]] * 3


def test_a_map_with_less_start_circles_than_room_is_refused():
    keys = jax.random.split(jax.random.key(0), 2)
    with pytest.raises(ValueError, match=r"start_probs=\[1.0, 0.0\]: expected a start circle"):
        drive_together(DRIVERS["blind"], family_map(*BARE), keys=keys)
