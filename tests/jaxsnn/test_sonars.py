"""A robot with another number of sonars: map, network, rewards, environments."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import make_map, navigation, qlearning, run_experiment, snn_params, world
from jaxsnn.config import NetworkConfig
from jaxsnn.drivers import DRIVERS, driver_steering
from jaxsnn.mirror import mirrored_inputs
from jaxsnn.network_input import input_rates
from jaxsnn.presets import preset
from jaxsnn.turn_goal import TurnGoalParams, turn_goal

ANGLES = (90.0, 60.0, 30.0, 0.0, -30.0, -60.0, -90.0)
MAP = make_map(
    [], [(400.0, 300.0, 60.0)], target=(700, 300), starts=[(90, 300, 20)], sonar_angles=ANGLES,
    sonar_stuck={6: 20.0},
)  # fmt: skip


@pytest.fixture(scope="module")
def reading():
    at = world.reset(MAP, key=jax.random.key(0))._replace(
        x=jnp.float32(250.0), y=jnp.float32(300.0), heading=jnp.float32(0.0)
    )
    return world.observe(MAP, at)


def test_seven_sonars_see_what_is_ahead_of_each(reading):
    seen = np.asarray(reading.sonar)
    assert seen.shape == (7,) and seen[6] == 20.0
    np.testing.assert_allclose(seen[3], 90.0, atol=0.01)
    np.testing.assert_allclose(seen[0], 300.0)
    assert navigation.observation(MAP, reading).shape == (navigation.observation_size(MAP),)
    free = reading._replace(sonar=jnp.full(7, 300.0).at[1].set(30.0))
    goal, _ = turn_goal(TurnGoalParams(), free, jnp.asarray(0.0))
    assert float(goal) < 0  # away from the left
    assert float(driver_steering(DRIVERS["reflex_100"], free)) < 0


@pytest.mark.parametrize("name", ["tuned", "way"])
def test_a_network_has_a_group_for_each(name, reading):
    sizes = {"n_sonars": 7, "hidden_exc": 4, "hidden_inh": 4, "group_exc": 1, "group_inh": 1}
    config, params = preset("S4", name, config=sizes)
    groups = {"tuned": 9, "way": 7 * 4 + 4 + 8 + 2}[name]
    assert config.n_groups == groups and config.n_in == 2 * groups
    rates = input_rates(config, params, reading, jnp.asarray(0.0))
    assert rates.shape == (config.n_in,)
    if config.input_code == "interval":
        assert sorted(mirrored_inputs(config)) == list(range(config.n_in))
        return

    def experiment(words):
        keys = jax.random.wrap_key_data(words)
        return run_experiment(
            config, snn_params(config, params), MAP, keys=keys, n_learn=1, n_test=1, max_steps=2
        )

    words = jax.random.key_data(jax.random.split(jax.random.key(0), 2))
    # The shapes of a whole experiment, without compiling it.
    assert jax.eval_shape(experiment, words).testing.status.shape == (2, 1)


def test_who_has_other_sonars_is_named(reading):
    config, params = preset("S4", "tuned")
    with pytest.raises(ValueError, match="n_sonars=5: expected the 7 sonars of the map's robot"):
        input_rates(config, params, reading, jnp.asarray(0.0))
    with pytest.raises(ValueError, match="n_sonars=4: expected an odd number, 3 or more"):
        NetworkConfig(n_sonars=4)
    with pytest.raises(ValueError, match=r"sonar=<7 readings>: expected 5"):
        qlearning.discretize(reading)
