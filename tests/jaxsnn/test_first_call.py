"""What a first call of `run_experiment` has to compile: counted, since times depend on the machine.

The program holds world, neurons and random numbers once, however many phases and windows there are.
"""

import collections
import re

import jax
import jax.numpy as jnp
import numpy as np

import jaxsnn

OPERATIONS = ("dot_general", "while", "scatter", "sine", "exponential")


def small(**sizes):
    sizes = {"hidden_exc": 4, "hidden_inh": 4, "group_exc": 1, "group_inh": 1, **sizes}
    return jaxsnn.preset("S4", config=sizes)


def program(config, params, **options):
    """The lowered program of an experiment, as text."""
    keys = jax.random.split(jax.random.key(0), 4)
    run = jax.jit(
        lambda keys, params: jaxsnn.run_experiment(
            config, jaxsnn.snn_params(config, params), jaxsnn.scenario(1),
            keys=keys, max_steps=3, block=2, **options,
        )
    )  # fmt: skip
    return run.lower(keys, params).as_text()


def operations(text):
    """How often each kind of operation stands in it, and how often random bits are drawn."""
    found = collections.Counter(re.findall(r"stablehlo\.(\w+)", text))
    counts = {name: found[name] for name in OPERATIONS}
    return counts | {"threefry": len(re.findall(r"call @threefry2x32\w*\(", text))}


def test_phases_and_windows_are_loops_and_not_copies():
    config, params = small(control_steps=10, hold_steps=5)
    least = operations(program(config, params, n_learn=1, n_test=1))
    more = small(control_steps=40, hold_steps=5)[0]
    most = operations(program(more, params, n_learn=3, n_test=2, n_online=2))
    assert most == least, (least, most)


def test_a_first_call_compiles_no_more_than_it_did():
    """A rise of these counts is a rise of the time that a first call takes."""
    config, params = small(control_steps=10, hold_steps=5)
    counts = operations(program(config, params, n_learn=1, n_test=1))
    assert counts["dot_general"] <= 12
    assert counts["while"] <= 16
    assert counts["threefry"] <= 11
    assert counts["exponential"] <= 9
    assert counts["scatter"] == 0


def test_a_map_without_noise_draws_none():
    """The noise of the sensors is left out where the map is known, not where it is an argument."""
    config, params = small(control_steps=5, hold_steps=5)
    known = operations(program(config, params, n_learn=1, n_test=1))
    keys = jax.random.split(jax.random.key(0), 2)
    given = jax.jit(
        lambda keys, map: jaxsnn.run_experiment(
            config, jaxsnn.snn_params(config, params), map, keys=keys, n_learn=1, n_test=1
        )
    )
    text = given.lower(keys, jaxsnn.scenario(1)).as_text()
    assert operations(text)["threefry"] > known["threefry"]


def test_phases_in_one_loop_are_those_of_one_after_the_other():
    """Given agents run phase by phase; the network of the config in one loop."""
    config, params = small(control_steps=20, hold_steps=10)
    keys = jax.random.split(jax.random.key(1), 2)
    sizes = {"n_learn": 3, "n_test": 2, "n_online": 1, "max_steps": 6}
    circles = jnp.zeros(3, jnp.int32)
    agents = jaxsnn.snn_agent(config), jaxsnn.snn_agent(config, plastic=False)

    def run(config, **options):
        return jax.jit(
            lambda keys, params: jaxsnn.run_experiment(
                config,
                params,
                jaxsnn.scenario(1),
                keys=keys,
                circles=circles,
                keep_states=True,
                **sizes,
                **options,
            )
        )(keys, jaxsnn.snn_params(built, params))

    built = config
    one, two = run(config), run(None, agents=agents)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=2e-6, atol=2e-6 * float(np.abs(b).max()))
