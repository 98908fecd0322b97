"""The critic's error, the potential, the tied halves, and where learning trials begin."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import run_experiment, scenarios, snn_params, world
from jaxsnn.config import NetworkConfig, Weights, check_network
from jaxsnn.critic import (
    CriticParams,
    credited,
    critic_init,
    features,
    potential,
    shaped_reward,
    temporal_difference,
)
from jaxsnn.mirror import mirrored_inputs, tied
from jaxsnn.network import NetworkState
from jaxsnn.network_input import group_input, input_rates
from jaxsnn.presets import preset
from jaxsnn.saved import KEPT, load_networks, save_networks
from jaxsnn.ways import with_starts_anywhere, with_way
from jaxsnn.world import Reading

CONSTANTS = CriticParams(rate=0.1, discount=0.9, trace=0.5)


@jax.jit
def chain(rewards):
    """A walk over five places, many times; the value of each at the end."""
    places = jnp.eye(5)

    def walk(critic, _):
        def step(critic, i):
            after = places[jnp.minimum(i + 1, 4)]
            return temporal_difference(CONSTANTS, critic, places[i], after, rewards[i], i == 4)

        fresh = critic._replace(trace=jnp.zeros(5))
        critic, errors = jax.lax.scan(step, fresh, jnp.arange(5))
        return critic, errors

    return jax.lax.scan(walk, critic_init(5), None, length=400)


def test_the_value_of_a_chain_is_the_discounted_reward_to_come():
    critic, errors = chain(jnp.array([0.0, 0.0, -1.0, 0.0, 2.0]))
    wanted, value = [], 0.0
    for reward in (2.0, 0.0, -1.0, 0.0, 0.0):
        value = reward + 0.9 * value
        wanted.insert(0, value)
    np.testing.assert_allclose(critic.weights, wanted, atol=1e-4)
    assert float(jnp.abs(errors[-1]).max()) < 1e-3 < float(jnp.abs(errors[0]).max())


def seen(left: float, distance: float = 300.0) -> Reading:
    return Reading(
        jnp.full(5, 300.0), jnp.asarray(distance), jnp.asarray(0.0), jnp.asarray(0.0),
        jnp.asarray(left),
    )  # fmt: skip


def test_potentials_add_up_to_their_ends_whatever_the_path():
    params = CriticParams(discount=1.0)
    for path in ([400.0, 300.0, 100.0], [400.0, 700.0, 100.0]):
        steps = [
            shaped_reward(params, seen(a), seen(b), "way") for a, b in itertools.pairwise(path)
        ]
        np.testing.assert_allclose(sum(map(float, steps)), 3.0, rtol=1e-5)
    assert float(shaped_reward(params, seen(1.0), seen(2.0), "none")) == 0.0
    straight = potential(params, seen(900.0, 250.0), "straight", jnp.asarray(250.0))
    np.testing.assert_allclose(straight, -2.5)
    with pytest.raises(ValueError, match="expected a map with its shortest ways for shaping"):
        potential(params, seen(1.0)._replace(way_left=None), "way", jnp.asarray(1.0))


def test_credit_goes_to_the_motor_of_the_turn():
    @jax.jit
    def both(turn):
        error = jnp.asarray(2.0)
        return [credited(CriticParams(), error, turn, c) for c in ("turn", "global")]

    turn, everyone = both(jnp.asarray(90.0))
    assert turn.tolist() == [-2.0, 2.0] and everyone.tolist() == [2.0, 2.0]
    assert features(jnp.zeros(3)).tolist() == [0.0] * 3


@pytest.mark.parametrize("turn_groups", [False, True])
def test_a_mirrored_reading_drives_the_mirrored_inputs(turn_groups):
    config, params = preset(
        "S4", "way", config={"group_exc": 2, "group_inh": 1, "turn_groups": turn_groups}
    )
    sonar = jnp.array([20.0, 70.0, 150.0, 250.0, 60.0])
    reading = Reading(sonar, jnp.asarray(250.0), jnp.asarray(100.0))
    image = Reading(sonar[::-1], jnp.asarray(250.0), jnp.asarray(-100.0))

    @jax.jit
    def rates(reading, turn):
        groups = group_input(config, params, reading, turn)
        neurons = input_rates(config, params, reading, turn)
        return jnp.repeat(groups, 3), neurons

    groups, one = rates(reading, jnp.asarray(30.0))
    other = rates(image, jnp.asarray(-30.0))[1]
    np.testing.assert_array_equal(groups, one)
    np.testing.assert_array_equal(other, one[mirrored_inputs(config)])


def test_tied_weights_are_their_own_image():
    config, _ = preset("S4", "way", config={"group_exc": 1, "group_inh": 1})
    keys = jax.random.split(jax.random.key(0))
    shapes = (config.n_in, config.n_hidden), (2, config.n_half)
    drawn = Weights(*(jax.random.uniform(k, s) for k, s in zip(keys, shapes, strict=True)))
    once = jax.jit(lambda w: tied(config, w))(drawn)
    for a, b in zip(once, tied(config, once), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    image = once.hidden[mirrored_inputs(config)]
    np.testing.assert_allclose(once.hidden[:, : config.n_half], image[:, config.n_half :])
    np.testing.assert_allclose(float(once.hidden.mean()), float(drawn.hidden.mean()), rtol=1e-5)
    with pytest.raises(ValueError, match="mirror=True: expected input_code='interval'"):
        NetworkConfig(mirror=True)


def test_trials_begin_all_over_the_map():
    config, _ = preset("S4", "way", config={"starts": "anywhere"})
    plain = scenarios.detour(1)
    map = with_starts_anywhere(plain, spacing=60)
    assert config.starts == "anywhere" and 40 < len(map.starts) < 13 * 10
    begun = jax.vmap(lambda k: world.reset(map, key=k))(jax.random.split(jax.random.key(0), 256))
    spread = np.std(np.asarray([begun.x, begun.y]), axis=1)
    assert (spread > 100).all()
    with pytest.raises(ValueError, match="spacing=0: expected a number > 0"):
        with_starts_anywhere(plain, spacing=0)


def small(**changes):
    sizes = {"hidden_exc": 8, "hidden_inh": 8, "group_exc": 2, "group_inh": 2,
             "control_steps": 20, "hold_steps": 10}  # fmt: skip
    return preset("S4", "way", config={**sizes, **changes}, params={"gamma": 1e-3})


def test_what_a_file_keeps_is_part_of_a_network():
    assert set(KEPT) <= set(NetworkState._fields)


@pytest.mark.slow
def test_a_critic_learns_beside_the_network_and_is_kept(tmp_path):
    config, params = small(critic="td", shaping="way", mirror=True, guidance="none")
    constants = jax.tree.map(jnp.float32, params)
    map = with_way(scenarios.scenario(1))

    @jax.jit
    def go(words, states):
        return run_experiment(
            config, snn_params(config, constants), map, keys=jax.random.wrap_key_data(words),
            n_learn=2, n_test=1, max_steps=8, block=2, keep_states=True, states=states,
        )  # fmt: skip

    words = jax.random.key_data(jax.random.split(jax.random.key(1), 2))
    states = go(words, None).states
    assert states.critic is not None and float(jnp.abs(states.critic.weights).max()) > 0.01
    one = jax.tree.map(lambda x: x[0], states.weights)
    np.testing.assert_allclose(one.hidden, tied(config, one).hidden, rtol=1e-5)
    file = save_networks(tmp_path / "nets.npz", config, states)
    again = load_networks(file, config, params)
    np.testing.assert_array_equal(again.critic.weights, states.critic.weights)
    with pytest.raises(ValueError, match="networks with critic='none', they have 'td'"):
        load_networks(file, small()[0], params)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"discount": 1.5}, "critic.discount=1.5: expected a number from 0 to 1"),
        ({"rate": float("nan")}, "critic.rate=nan"),
        ({"scale": 0.0}, "scale=0.0: expected a number > 0"),
        ({"height": float("inf")}, "height=inf"),
    ],
)
def test_constants_of_no_critic_are_refused(change, words):
    config, params = small()
    with pytest.raises(ValueError, match=words):
        check_network(config, params._replace(critic=CriticParams(**change)))
