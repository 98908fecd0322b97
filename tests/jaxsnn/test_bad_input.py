"""What users see who give something wrong: run without type checks, one process for all calls."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

CALLS = {
    "legacy key": (
        "random_maps.random_map(key=jax.random.PRNGKey(0))",
        "key=<uint32>: expected a typed",
    ),
    "single key": (
        "run_phase(None, None, room, None, keys=jax.random.key(0), n_trials=1, max_steps=1)",
        "expected one key per robot",
    ),
    "batch of keys": ("world.reset(room, key=keys)", "expected a single key"),
    "unknown bounds": (
        "apply_reward(w, w, 0.0, 5.0, rule='additive', bounds='sotf')",
        "bounds='sotf': expected one of 'hard', 'soft'",
    ),
    "unknown rule": ("apply_reward(w, w, 0.0, 5.0, rule='add')", "rule='add': expected one of"),
    "bounds the wrong way round": (
        "apply_reward(w, w, 5.0, 0.0, rule='additive')",
        "w_min=5: expected at most w_max = 0",
    ),
    "rates that are NaN": ("spikes(jnp.array([jnp.nan]))", "rates=nan: expected a number >= 0"),
    "rates above 1/dt": ("spikes(jnp.array([2000.0]))", "rates=2000.0: expected at most one spike"),
    "step of two time constants": (
        "lif_step(LIFParams(tau_m=5e-4), lif_init(LIFParams(), 1), 0.0, w, dt=1e-3)",
        "dt=0.001: expected a step below 2 tau_m",
    ),
    "refractory for two seconds": (
        "lif_scan(LIFParams(t_ref=2.0), lif_init(LIFParams(), 1), w[None], dt=1e-3)",
        "t_ref=2: expected less than one second",
    ),
    "time constant of zero": (
        "stdp_step(STDPParams(tau_z=0.0), stdp_init(1, 1), w, w, dt=1e-3)",
        "tau_z=0.0: expected a number > 0",
    ),
    "kernel for another window": (
        "stdp_window(stdp_kernel(STDPParams(), 5, dt=1e-3), stdp_init(1, 1), w2, w2)",
        "expected the 5 steps of the kernel",
    ),
    "sizes with a point": ("lif_init(LIFParams(), 2.0)", "n=2.0: expected a whole number"),
    "network with half a neuron": (
        "NetworkConfig(hidden_exc=104.0)",
        "hidden_exc=104.0: expected a whole number",
    ),
    "network with bounds the wrong way round": (
        "preset('S4', params={'w_min': 9.0})",
        "w_min=9: expected at most w_max = 5",
    ),
    "too few start circles": (
        "phase(circles=jnp.array([0]))",
        r"circles=<shape (1,)>: expected (2,)",
    ),
    "a start circle that is not there": (
        "phase(circles=jnp.array([0, 1]))",
        "circles=[1]: expected numbers of start circles of the map, [0]",
    ),
    "trials with a point": ("phase(n_trials=2.0)", "n_trials=2.0: expected a whole number"),
    "start circles with a point": (
        "phase(circles=jnp.array([0.0, 0.0]))",
        "circles=<float32>: expected whole numbers",
    ),
    "start circles as a list, one not there": (
        "phase(circles=[0, 7])",
        "circles=[7]: expected numbers of start circles of the map, [0], or negative ones",
    ),
    "a start circle that one map of two lacks": (
        "phase(map=two, keys=keys2, map_axis=0, circles=[0, 1])",
        "circles=[1]: expected numbers of start circles of the map, [0]",
    ),
    "a start in a circle that is not there": (
        "world.reset(room, key=keys[0], circle=5)",
        "circle=5: expected numbers of start circles of the map, [0]",
    ),
    "a start in a circle of padding": (
        "world.reset(room, key=keys[0], circle=jnp.array(1))",
        "circle=1: expected numbers of start circles of the map, [0]",
    ),
    "a start in a circle beyond a traced map": (
        "jax.eval_shape(lambda room: world.reset(room, key=keys[0], circle=99), room)",
        "circle=99: expected numbers of start circles of the map, [0, 1",
    ),
    "a start in half a circle": (
        "world.reset(room, key=keys[0], circle=0.5)",
        "circle=<float64>: expected whole numbers",
    ),
    "a start in two circles": (
        "world.reset(room, key=keys[0], circle=[0, 0])",
        "circle=<shape (2,)>: expected one number",
    ),
    "starts with too few circles": (
        "start_states(room, jnp.array([0]), key=keys[0], n_trials=2)",
        "circles=<shape (1,)>: expected (2,)",
    ),
    "starts in a circle that is not there": (
        "start_states(room, [0, 3], key=keys[0], n_trials=2)",
        "circles=[3]: expected numbers of start circles of the map, [0]",
    ),
    "starts with a batch of keys": (
        "start_states(room, key=keys, n_trials=2)",
        "expected a single key",
    ),
    "one trial with a batch of keys": (
        "run_trial(None, None, room, None, key=keys, max_steps=1)",
        "expected a single key",
    ),
    "run with a point": ("phase(run=1.0)", "run=1.0: expected a whole number"),
    "run more than there are": ("phase(run=3)", "run=3: expected at most n_trials = 2"),
    "states of other robots": (
        "phase(states=jnp.zeros(3))",
        "states=<shape (3,)>: expected 1 first",
    ),
    "too many parameters of robots": (
        "experiment(params_axis=gamma_axis, params=with_gamma(3))",
        "params.network.gamma=<shape (3,)>: expected 2 first",
    ),
    "too few parameters of robots": (
        "experiment(params_axis=gamma_axis, params=with_gamma(1))",
        "params.network.gamma=<shape (1,)>: expected 2 first",
    ),
    "parameters of robots without an axis": (
        "experiment(params_axis=0)",
        "=<shape ()>: expected 2 first",
    ),
    "parameters of robots along axis 1": (
        "experiment(params_axis=1)",
        "params_axis=1: expected 0 or None",
    ),
    "axes of other parameters": (
        "experiment(params_axis=(0, None, None))",
        "params_axis=(0, None, None): expected 0, None, or a tree of them",
    ),
    "maps of other robots": (
        "experiment(map=two, map_axis=0, keys=jax.random.split(keys[0], 3))",
        "map.segments=<shape (2, ",
    ),
    "a second map that not each robot has": (
        "experiment(map=two, map_axis=0, test_map=room)",
        "test_map.segments=<shape (",
    ),
    "learning trials with a point": (
        "experiment(n_learn=2.0)",
        "n_learn=2.0: expected a whole number",
    ),
    "testing trials with a point": ("experiment(n_test=2.0)", "n_test=2.0: expected a whole"),
    "fewer than no trials": ("experiment(n_learn=-1)", "n_learn=-1: expected a whole number >= 0"),
    "no trial at all": (
        "experiment(n_learn=0, n_test=0)",
        "n_learn=0, n_test=0, n_online=0: expected a trial",
    ),
    "sonars with a point": ("NetworkConfig(n_sonars=5.0)", "n_sonars=5.0: expected a whole number"),
    "a first trial with a point": (
        "qlearning.run_trials(qlearning.QParams(), room, qlearning.init(1), keys=keys,"
        " n_trials=1, max_steps=1, learn=True, first_trial=0.5)",
        "first_trial=0.5: expected a whole number",
    ),
    "a driver with a single key": (
        "drive(drivers.DriverParams(), room, keys=keys[0])",
        "expected one key per robot",
    ),
    "a rule with a single key": (
        "guidance.drive_guided(guidance.TurnGoalParams(), room, keys=keys[0])",
        "expected one key per robot",
    ),
    "learners with a batch of keys": (
        "learners.train_qlearning(qlearning.QParams(), room, key=keys, learners=1)",
        "expected a single key",
    ),
    "policies with a single key": (
        "learners.ppo_policies(PPOConfig(), PPOParams(), room, None, keys=keys[0])",
        "expected one key per robot",
    ),
    "trained policies with a single key": (
        "learners.train_ppo(PPOConfig(), PPOParams(), room, keys=keys[0])",
        "expected one key per robot",
    ),
    "policies with keys of one policy": (
        "learners.drive_policies(PPOConfig(), room, None, keys=keys)",
        "keys=<shape (1,)>: expected [policies, trials]",
    ),
    "spikes in no time": ("spikes(w, dt=0)", "dt=0: expected a number > 0"),
    "spikes backwards": ("spikes(w, dt=-1e-3)", "dt=-0.001: expected a number > 0"),
    "one rate for how many neurons": ("spikes(5.0)", "rates=<shape ()>: expected [n]"),
    "rates in rows": ("spikes([[5.0]])", "rates=<shape (1, 1)>: expected [n]"),
    "a step with spikes of another layer": (
        "stdp_step(STDPParams(), stdp_init(2, 1), w, w, dt=1e-3)",
        "pre=<shape (1,)>: expected (2,)",
    ),
    "a window with spikes of another input": (
        "stdp_window(stdp_kernel(STDPParams(), 4, dt=1e-3), stdp_init(3, 1), w2, w2)",
        "pre=<shape (4, 1)>: expected (steps, 3)",
    ),
    "a window with spikes of another output": (
        "stdp_window(stdp_kernel(STDPParams(), 4, dt=1e-3), stdp_init(1, 3), w2, w2)",
        "post=<shape (4, 1)>: expected (steps, 3)",
    ),
    "a window without steps": (
        "stdp_window(stdp_kernel(STDPParams(), 1, dt=1e-3), stdp_init(1, 1), w, w)",
        "pre=<shape (1,)>: expected (steps, 1)",
    ),
    "a drive for other weights": (
        "apply_reward(w, w2, 0.0, 5.0, rule='additive')",
        "drive=<shape (4, 1)>: expected (1,)",
    ),
    "jumps of another layer": (
        "lif_step(LIFParams(), lif_init(LIFParams(), 2), 0.0, jnp.ones(3), dt=1e-3)",
        "jump=<shape (3,)>: expected a number or 2 of them",
    ),
    "jumps of more than one neuron": (
        "lif_step(LIFParams(), lif_init(LIFParams(), 1), 0.0, jnp.ones(3), dt=1e-3)",
        "jump=<shape (3,)>: expected a number or 1 of them",
    ),
    "currents of another layer": (
        "lif_step(LIFParams(), lif_init(LIFParams(), 2), jnp.ones(3), 0.0, dt=1e-3)",
        "current=<shape (3,)>: expected a number or 2 of them",
    ),
    "constants of another layer": (
        "lif_step(LIFParams(tau_m=jnp.ones(3)), lif_init(LIFParams(), 2), 0.0, 0.0, dt=1e-3)",
        "tau_m=<shape (3,)>: expected a number or 2 of them",
    ),
    "a layer at rest of another layer": (
        "lif_init(LIFParams(v_rest=jnp.ones(3)), 2)",
        "v_rest=<shape (3,)>: expected a number or 2 of them",
    ),
    "a row of jumps": (
        "lif_scan(LIFParams(), lif_init(LIFParams(), 2), jnp.ones(2), dt=1e-3)",
        "jumps=<shape (2,)>: expected (steps, 2)",
    ),
    "weights of another network": (
        "network.init(jax.random.key(0), *preset('S4'), Weights(w[None], w[None]))",
        "weights.hidden=<shape (1, 1)>: expected (210, 208)",
    ),
    "a step with spikes of another network": (
        "network.step(config, constants, net(), w, jnp.ones(2))",
        "pre=<shape (1,)>: expected (210,), a column for each input",
    ),
    "a step with a row of spikes": (
        "network.step(config, constants, net(), jnp.ones((1, 210)), jnp.ones(2))",
        "pre=<shape (1, 210)>: expected (210,), a column for each input",
    ),
    "a step with one reward": (
        "network.step(config, constants, net(), jnp.ones(210), 1.0)",
        "reward=<shape ()>: expected (2,)",
    ),
    "neurons with spikes of another network": (
        "network.fire(config, constants, net(), w2)",
        "pre=<shape (4, 1)>: expected (steps, 210)",
    ),
    "traces of spikes of another network": (
        "network.remember(config, constants, None, net(), w2, None)",
        "pre=<shape (4, 1)>: expected (steps, 210)",
    ),
}
PROGRAM = """
import json, sys
import jax, jax.numpy as jnp
from jaxsnn import *
from jaxsnn import drivers, guidance, learners, maps, network, qlearning, random_maps, world
from jaxsnn.config import Weights
from jaxsnn.ppo_config import PPOConfig, PPOParams
from jaxsnn.trials import run_trial, start_states
room = maps.make_map(target=(300, 300), starts=[(100, 300, 20)])
other = maps.make_map(target=(300, 300), starts=[(100, 300, 20), (100, 200, 20)])
two = maps.stack_maps([room, other])
keys = jax.random.split(jax.random.key(0), 1)
keys2 = jax.random.split(jax.random.key(0), 2)
w, w2 = jnp.ones(1), jnp.ones((4, 1))
config, constants = preset("S4")
base = snn_params(config, constants)
gamma_axis = jax.tree.map(lambda _: None, base)
gamma_axis = gamma_axis._replace(network=gamma_axis.network._replace(gamma=0))
def net():
    return network.init(jax.random.key(0), config, constants)
def with_gamma(n):
    return base._replace(network=base.network._replace(gamma=jnp.full(n, 1e-3)))
def experiment(params=base, map=room, keys=keys2, **changes):
    given = {"n_learn": 1, "n_test": 1, "max_steps": 1, **changes}
    return jax.eval_shape(lambda: run_experiment(config, params, map, keys=keys, **given))
def spikes(rates, dt=1e-3):
    return poisson_spikes(rates, 2, dt=dt, key=keys[0])
def phase(map=room, states=None, keys=keys, **changes):
    given = {"n_trials": 2, "max_steps": 1, **changes}
    return run_phase(None, None, map, states, keys=keys, **given)
said = {}
for name, call in json.loads(sys.argv[1]).items():
    try:
        eval(call)
        said[name] = "nothing"
    except (ValueError, TypeError) as error:
        said[name] = f"{type(error).__name__}: {error}"
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def said() -> dict[str, str]:
    calls = json.dumps({name: call for name, (call, _) in CALLS.items()})
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, calls],
        capture_output=True, text=True, cwd=Path(__file__).parents[2], check=True,
    )  # fmt: skip
    found: dict[str, str] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("name", CALLS)
def test_bad_input_is_refused_with_value_expectation_and_fix(
    said: dict[str, str], name: str
) -> None:
    assert CALLS[name][1] in said[name]
    assert "; " in said[name]
