"""Drivers that learn nothing, the detour maps that they fail on, and families of such maps."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import families, planner, scenarios, world
from jaxsnn.drivers import DRIVERS, DriverParams, drive, driver_steering
from jaxsnn.families import Difficulty, difficulty, family_map, is_admitted


def reading(sonar: list[float], angle: float) -> world.Reading:
    return world.Reading(jnp.asarray(sonar), jnp.asarray(300.0), jnp.asarray(angle))


@pytest.mark.parametrize(
    ("name", "sonar", "angle", "steering"),
    [
        ("blind", [10.0] * 5, 20.0, 20.0),
        ("blind", [300.0] * 5, -90.0, -30.0),
        ("reflex_60", [70.0] * 5, 20.0, 20.0),
        ("reflex_60", [50.0, 300, 300, 300, 300], 20.0, -40.0),  # left is nearer: to the right
        ("reflex_60", [300.0, 300, 300, 50, 300], -20.0, 40.0),
        ("reflex_100", [300.0, 300, 70, 300, 300], -20.0, 40.0),  # straight ahead: to the left
    ],
)
def test_steering_by_rule(name, sonar, angle, steering):
    assert float(driver_steering(DRIVERS[name], reading(sonar, angle))) == steering


@pytest.mark.slow
def test_drivers_side_by_side_are_one_by_one():
    """A sweep over a driver's constants is a vmap."""
    keys = jax.random.split(jax.random.key(0), 4)

    def status(distance):
        driver = DriverParams(distance=distance)
        return drive(driver, scenarios.detour(1), keys=keys, n_trials=2, max_steps=60).status

    distances = jnp.array([0.0, 60.0, 100.0])
    many = jax.jit(jax.vmap(status))(distances)
    one = jax.jit(status)
    np.testing.assert_array_equal(many, jnp.stack([one(d) for d in distances]))


@pytest.mark.slow
def test_drivers_solve_the_short_scenarios_and_none_of_the_detours():
    for number in (1, 2, 3):
        easy, hard = (difficulty(m(number)) for m in (scenarios.scenario, scenarios.detour))
        assert easy.reflex_60 > 95 and easy.reflex_100 > 95
        assert is_admitted(hard) and not is_admitted(easy)
    assert [round(difficulty(scenarios.scenario(n)).blind) for n in (1, 3)] == [100, 0]


@pytest.mark.parametrize(("number", "n_mv"), [(1, 46), (2, 62), (3, 54)])
def test_detours_keep_what_the_text_fixes_and_come_nearer_to_its_paths(number, n_mv):
    short, long = scenarios.scenario(number), scenarios.detour(number)
    used = np.asarray(long.start_probs) > 0
    np.testing.assert_array_equal(used, np.asarray(short.start_probs) > 0)
    starts = np.asarray(long.starts, float)[used, :2]
    assert ((starts[:, 0] < 200) | (starts[:, 0] > 600)).all()  # at the left and at the right
    if number == 1:
        assert long.target.tolist() == [400.0, 300.0]
    ways = [
        planner.path_field(m).lengths(np.asarray(m.starts, float)[used, :2]).mean()
        for m in (short, long)
    ]
    source = 15.0 * n_mv
    assert ways[0] < 0.45 * source < 0.5 * source < ways[1] < source


def test_admission_is_blind_below_10_reflexes_below_50_and_a_way():
    assert is_admitted(Difficulty(9.0, 49.0, 49.0, 500.0))
    for change in ({"blind": 10.0}, {"reflex_60": 50.0}, {"reflex_100": 50.0},
                   {"shortest": np.inf}):  # fmt: skip
        assert not is_admitted(Difficulty(9.0, 49.0, 49.0, 500.0)._replace(**change))


def test_a_family_map_is_a_function_of_its_number_and_admitted():
    map = family_map("detour", "train", 0)
    families.admitted_draw.cache_clear()
    jax.tree.map(np.testing.assert_array_equal, map, family_map("detour", "train", 0))
    assert is_admitted(difficulty(map))
    assert not np.array_equal(map.target, family_map("detour", "test", 0).target)


def test_splits_never_share_a_seed():
    first = sorted(families.SPLITS.values())
    assert np.diff(first).min() >= 1_000_000
    for bad, message in (
        (("forest", "train", 0), "family='forest': expected one of 'open'"),
        (("open", "exam", 0), "split='exam'"),
        (("open", "train", 1_000_000), "number=1000000: expected less than"),
    ):
        with pytest.raises(ValueError, match=message):
            family_map(*bad)


@pytest.mark.slow
@pytest.mark.parametrize("family", families.FAMILIES)
def test_every_family_has_maps_in_every_split(family):
    for split in families.SPLITS:
        assert is_admitted(difficulty(family_map(family, split, 1)))
