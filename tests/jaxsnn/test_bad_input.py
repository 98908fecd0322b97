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
    "weights of another network": (
        "network.init(jax.random.key(0), *preset('S4'), Weights(w[None], w[None]))",
        "weights.hidden=<shape (1, 1)>: expected (210, 208)",
    ),
}
PROGRAM = """
import json, sys
import jax, jax.numpy as jnp
from jaxsnn import *
from jaxsnn import maps, network, random_maps, world
from jaxsnn.config import Weights
room = maps.make_map(target=(300, 300), starts=[(100, 300, 20)])
keys = jax.random.split(jax.random.key(0), 1)
w, w2 = jnp.ones(1), jnp.ones((4, 1))
def spikes(rates):
    return poisson_spikes(rates, 2, dt=1e-3, key=keys[0])
def phase(**changes):
    given = {"n_trials": 2, "max_steps": 1, **changes}
    return run_phase(None, None, room, None, keys=keys, **given)
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
