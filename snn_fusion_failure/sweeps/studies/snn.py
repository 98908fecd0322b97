"""Study `snn`: a robot learns to steer, then is tested; one trial is one robot's whole life.

Axes are the leaves of `jaxsnn.config.NetworkParams`: `gamma`, `stdp.tau_z`, `reward.k` ...
Time constants are swept in milliseconds. Trials that run side by side (`--chunk-size`) run as long
as the slowest of them; 4 to 8 keep their weights in a CPU's cache. With halving a robot goes on
from the network that it had (its chunk's file holds it); it is tested when it has learnt all.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsnn import scenarios
from jaxsnn.agents import snn_agent, snn_params
from jaxsnn.config import check_network
from jaxsnn.experiment import TEST_TRIALS, learning_circles, phase_keys
from jaxsnn.status import Status
from jaxsnn.trials import TrialResult, run_phase
from snn_fusion_failure.runs.networks import changed_preset
from snn_fusion_failure.sweeps.study import Carry, Metric, Study

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

    learner, frozen = snn_agent(config), snn_agent(config, plastic=False)

    def prepare(params: Any) -> Any:
        return jax.vmap(lambda p: snn_params(config, p))(params)

    def start(params: Any, keys: Any) -> Any:
        """Naive networks, and how each learning trial ended: none of them has."""
        states = jax.vmap(learner.init)(jax.vmap(phase_keys)(keys)[:, 0], prepare(params))
        return states, jnp.full((keys.shape[0], n_learn), Status.NOT_RUN, jnp.int32)

    def advance(params: Any, keys: Any, carry: Any, begin: int, end: int) -> Any:
        """Learning trials `begin` to `end - 1` and, after the last one, the testing trials."""
        states, ended = carry
        prepared, split = prepare(params), jax.vmap(phase_keys)(keys)
        # A robot whose state broke in an earlier part stays as it was, as within one part.
        stopped = jnp.any(ended == Status.NON_FINITE, axis=1)
        learnt, phase = run_phase(
            learner, prepared, map, states, keys=split[:, 1], n_trials=end - begin, first=begin,
            circles=None if circles is None else circles[begin:end], max_steps=max_steps,
            params_axis=0,
        )  # fmt: skip
        states = jax.tree.map(
            lambda old, new: jnp.where(stopped.reshape(-1, *[1] * (new.ndim - 1)), old, new),
            states, learnt,
        )  # fmt: skip
        statuses = jnp.where(stopped[:, None], jnp.int32(Status.NOT_RUN), phase.status)
        ended = ended.at[:, begin:end].set(statuses)
        metrics = {"sr_learning": _success(ended[:, :end])}
        if end < n_learn:
            nan = jnp.full(stopped.shape, jnp.nan)
            return (states, ended), metrics | {"sr_testing": nan, "n_mv": nan, "path": nan}
        _, testing = run_phase(
            frozen, prepared, map, states, keys=split[:, 2], n_trials=tests, max_steps=max_steps,
            params_axis=0,
        )  # fmt: skip
        return (states, ended), metrics | {
            "sr_testing": _success(testing.status),
            "n_mv": _mean_of_arrivals(testing, testing.steps.astype(jnp.float32)),
            "path": _mean_of_arrivals(testing, testing.path),
        }

    def run(params: Any, keys: Any) -> dict[str, Any]:
        return advance(params, keys, start(params, keys), 0, n_learn)[1]

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
        objective="sr_testing",
        unit_of=_unit,
        check=check,
        budget_text="learning trials",
        carry=Carry(start, advance, n_learn, objective="sr_learning"),
    )


def _success(status: Any) -> Any:
    """Arrivals in percent; NaN for a robot whose state broke."""
    share = 100.0 * jnp.mean((status == Status.ARRIVED).astype(jnp.float32), axis=-1)
    return jnp.where(jnp.any(status == Status.NON_FINITE, axis=-1), jnp.nan, share)


def _mean_of_arrivals(phase: TrialResult, values: Any) -> Any:
    """Mean over the trials that arrived; NaN when none did."""
    arrived = phase.status == Status.ARRIVED
    count = jnp.sum(arrived, axis=-1).astype(jnp.float32)
    return jnp.sum(jnp.where(arrived, values, 0.0), axis=-1) / count
