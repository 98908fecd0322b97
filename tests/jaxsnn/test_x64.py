"""Double precision runs through everything: states keep their dtype, results stay near."""

from __future__ import annotations

import contextlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsnn import LIFParams, STDPParams, lif_init, lif_scan, preset, scenario, snn_params
from jaxsnn.drivers import DRIVERS, driver_agent
from jaxsnn.experiment import run_experiment
from jaxsnn.plasticity import stdp_init
from jaxsnn.trials import run_phase
from jaxsnn.ways import with_way
from jaxsnn.window import stdp_kernel, stdp_steps, stdp_window

SMALL = {"group_exc": 2, "group_inh": 2, "hidden_exc": 8, "hidden_inh": 8,
         "control_steps": 20, "hold_steps": 10}  # fmt: skip


def precision(double: bool) -> Any:
    return jax.enable_x64(True) if double else contextlib.nullcontext()


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.relaxed  # maps stay in single precision
def test_scans_keep_the_dtype_of_their_state(double: bool) -> None:
    with precision(double):
        want = jnp.float64 if double else jnp.float32
        rng = np.random.default_rng(0)
        jumps = jnp.asarray(rng.uniform(0, 9, (20, 3)))
        state, fired, v = lif_scan(LIFParams(), lif_init(LIFParams(), 3), jumps, dt=1e-3)
        assert state.v.dtype == v.dtype == want and fired.any()
        pre = jnp.asarray((rng.random((20, 4)) < 0.3).astype(float))
        stdp = STDPParams()
        slow, total = stdp_steps(stdp, stdp_init(4, 3), pre, fired.astype(want), dt=1e-3)
        kernel = stdp_kernel(stdp, 20, dt=1e-3)
        fast, same = stdp_window(kernel, stdp_init(4, 3), pre, fired.astype(want))
        assert slow.z.dtype == fast.z.dtype == total.dtype == want
        np.testing.assert_allclose(same, total, rtol=1e-12 if double else 1e-4, atol=1e-9)


@pytest.mark.parametrize("reading", ["literal", "guided", "way"])
@pytest.mark.relaxed
def test_an_experiment_can_be_traced_in_double_precision(reading: str) -> None:
    """Loops refuse a carry that changes its dtype; this takes no compiling."""
    config, params = preset("S4", reading, config=SMALL)
    with precision(True):
        out = jax.eval_shape(
            lambda keys: run_experiment(
                config, snn_params(config, params), with_way(scenario(1)), keys=keys,
                n_learn=2, n_test=1, max_steps=3, block=1, keep_states=True,
            ),
            jax.random.split(jax.random.key(0), 2),
        )  # fmt: skip
    assert out.states.weights.hidden.dtype == jnp.float64
    assert out.testing.steps.dtype == jnp.int32


@pytest.mark.relaxed
def test_a_phase_takes_a_number_of_trials_of_any_width() -> None:
    with precision(True):
        keys = jax.random.split(jax.random.key(0), 1)
        _, out = jax.eval_shape(
            lambda run: run_phase(
                driver_agent(), DRIVERS["blind"], scenario(1), jnp.zeros(1),
                keys=keys, n_trials=2, max_steps=3, run=run,
            ),
            jnp.asarray(1, jnp.int64),
        )  # fmt: skip
    assert out.steps.dtype == jnp.int32


@pytest.mark.slow
@pytest.mark.relaxed
def test_an_experiment_runs_in_double_precision() -> None:
    config, params = preset("S4", config=SMALL)
    with precision(True):
        run = jax.jit(
            lambda keys: run_experiment(
                config, snn_params(config, params), scenario(1), keys=keys,
                n_learn=1, n_test=1, max_steps=3, block=1, record=True, keep_states=True,
            )
        )  # fmt: skip
        out = run(jax.random.split(jax.random.key(0), 1))
    assert out.states.weights.hidden.dtype == jnp.float64
    assert out.learning.steps.tolist() == [[3]] and bool(jnp.isfinite(out.learning.path).all())
