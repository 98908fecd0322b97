"""Study `snn`: a robot learns to steer, then is tested; one trial is one robot's whole life.

Axes are the leaves of `jaxsnn.config.NetworkParams`: `gamma`, `stdp.tau_z`, `reward.k` ...
Time constants are swept in milliseconds. Trials that run side by side (`--chunk-size`) run as long
as the slowest of them; 4 to 8 keep their weights in a CPU's cache.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsnn import scenarios
from jaxsnn.agents import snn_params
from jaxsnn.config import check_network
from jaxsnn.experiment import TEST_TRIALS, learning_circles, run_experiment
from jaxsnn.status import Status
from jaxsnn.trials import TrialResult
from snn_fusion_failure.runs.networks import changed_preset
from snn_fusion_failure.sweeps.study import Metric, Study

_TIMES = ("tau_m", "t_ref", "tau_plus", "tau_minus", "tau_z")
_MILLIVOLTS = ("v_rest", "v_reset", "v_th", "w_max", "w_max_low", "w_min", "a_plus", "a_minus")


def _unit(leaf: str) -> str:
    name = leaf.rpartition(".")[2]
    if name in _TIMES:
        return "ms"
    if name in _MILLIVOLTS:
        return "mV"
    if name in ("d_safe", "d_target"):
        return "px"
    return "Hz" if name in ("rate_hidden", "rate_output") else ""


def make(
    model: str = "S4",
    reading: str = "tuned",
    scenario: int = 1,
    n_learn: int = 20,
    n_test: int = 0,
    max_steps: int = 200,
    changes: tuple[str, ...] = (),
) -> Study:
    """A preset of a network on one of the source's maps; `n_test=0`: as in the source."""
    if scenario not in TEST_TRIALS:
        raise ValueError(f"scenario={scenario}: expected one of {sorted(TEST_TRIALS)}; choose one")
    tests = n_test or TEST_TRIALS[scenario]
    if min(n_learn, tests, max_steps) < 1:
        raise ValueError(f"{n_learn=}, {n_test=}, {max_steps=}: expected at least 1; raise them")
    config, constants = changed_preset(model, reading, tuple(changes))
    map = scenarios.scenario(scenario)
    circles = learning_circles(scenario, n_learn)

    def run(params: Any, keys: Any) -> dict[str, Any]:
        prepared = jax.vmap(lambda p: snn_params(config, p))(params)
        out = run_experiment(
            config, prepared, map, keys=keys, n_learn=n_learn, n_test=tests, max_steps=max_steps,
            block=keys.shape[0], circles=circles, params_axis=0,
        )  # fmt: skip
        return {
            "sr_testing": _success(out.testing),
            "sr_learning": _success(out.learning),
            "n_mv": _mean_of_arrivals(out.testing, out.testing.steps.astype(jnp.float32)),
            "path": _mean_of_arrivals(out.testing, out.testing.path),
        }

    def check(params: Any) -> None:
        check_network(config, params)
        for tree in (params.hidden, params.output, params.stdp):
            for name in _TIMES:
                values = np.asarray(getattr(tree, name, 1.0))
                if ((values > 0.0) & (values < config.dt)).any():
                    least = 1e3 * float(values[values > 0.0].min())
                    raise ValueError(
                        f"{name}={least:g}: expected at least the step of {1e3 * config.dt:g} ms; "
                        "times are swept in milliseconds, so write 25 or 25ms or 0.025s"
                    )

    def with_budget(budget: int) -> Study:
        # Ranked by the learning trials so far; one testing trial is the least that can be run.
        return make(model, reading, scenario, budget, 1, max_steps, changes)

    return Study(
        name="snn",
        options={},
        params=constants,
        run=run,
        metrics={
            "sr_testing": Metric("%", "testing trials that arrived, weights frozen", "max"),
            "sr_learning": Metric("%", "learning trials that arrived", "max"),
            "n_mv": Metric("", "control steps of testing trials that arrived", "min", True),
            "path": Metric("px", "way driven in testing trials that arrived", "min", True),
        },
        objective="sr_testing" if n_test != 1 else "sr_learning",
        unit_of=_unit,
        check=check,
        with_budget=with_budget,
        budget_text="learning trials",
    )


def _success(phase: TrialResult) -> Any:
    """Arrivals in percent; NaN for a robot whose state broke."""
    share = 100.0 * jnp.mean((phase.status == Status.ARRIVED).astype(jnp.float32), axis=-1)
    return jnp.where(jnp.any(phase.status == Status.NON_FINITE, axis=-1), jnp.nan, share)


def _mean_of_arrivals(phase: TrialResult, values: Any) -> Any:
    """Mean over the trials that arrived; NaN when none did."""
    arrived = phase.status == Status.ARRIVED
    count = jnp.sum(arrived, axis=-1).astype(jnp.float32)
    return jnp.sum(jnp.where(arrived, values, 0.0), axis=-1) / count
