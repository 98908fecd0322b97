"""The built-in studies: small trials, batched as one by one, and what their numbers mean."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

from snn_fusion_failure.sweeps.program import compile_study
from snn_fusion_failure.sweeps.study import load_study

SMALL_NETWORK = (
    "config.hidden_exc=12,config.hidden_inh=12,config.group_exc=4,config.group_inh=4,"
    "config.control_steps=40,config.hold_steps=20,params.gain_input=3,params.gain_output=6"
)


def numbers(study: Any, columns: dict[str, list[float]], width: int) -> dict[str, np.ndarray]:
    n = len(next(iter(columns.values())))
    program = compile_study(study, root=0, width=width)
    words = np.zeros((n, 2), np.uint32)
    return program({k: np.asarray(v) for k, v in columns.items()}, words, np.arange(n))[0]


SMALL = {
    "snn": ["n_learn=2", "n_test=2", "max_steps=12", f"changes={SMALL_NETWORK}"],
    "argate": ["model=netgated", "epochs=3"],
    "failure": ["n_init=8", "n_total=20", "refit_every=6", "candidates=64", "threshold=0.3"],
    "lif": ["steps=20"],
}


# optax's Adam raises a float to an integer power, which strict promotion forbids.
@pytest.mark.relaxed
@pytest.mark.parametrize("name", SMALL)
def test_a_study_is_batched_and_returns_its_metrics(name) -> None:
    """Traced, not compiled: one number per trial and metric."""
    study = load_study(name, SMALL[name])
    with jax.enable_x64(study.dtype == "float64"):
        shape = jax.ShapeDtypeStruct((3,), study.dtype)
        params = jax.tree.map(lambda leaf: shape, study.params)
        keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), 3))
        out = jax.eval_shape(study.run, params, keys)
    assert set(out) == set(study.metrics)
    assert {v.shape for v in out.values()} == {(3,)}
    assert study.leaves and all(isinstance(study.unit_of(leaf), str) for leaf in study.leaves)


@pytest.mark.slow
def test_snn_side_by_side_is_one_by_one() -> None:
    study = load_study("snn", SMALL["snn"])
    columns = {"gamma": [1e-3, 1e-2, 2e-2], "stdp.tau_z": [5.0, 25.0, 100.0]}
    one, three = numbers(study, columns, 1), numbers(study, columns, 3)
    for name in study.metrics:
        np.testing.assert_array_equal(one[name], three[name], err_msg=name)
    assert set(np.unique(one["sr_testing"])) <= {0.0, 50.0, 100.0}
    assert study.unit_of("stdp.tau_z") == "ms" and study.unit_of("reward.d_safe") == "px"
    assert study.carry.objective == "sr_learning" and study.objective == "sr_testing"


def test_snn_times_are_in_milliseconds() -> None:
    study = load_study("snn", [])
    short = study.params._replace(stdp=study.params.stdp._replace(tau_z=np.array([2.5e-5])))
    with pytest.raises(ValueError, match=r"tau_z=0.025: expected at least the step .* or 0.025s"):
        study.check(short)
    for options, message in [
        (["scenario=4"], "scenario=4"),
        (["model=S5"], "S5"),
        (["n_learn=0"], "n_learn=0"),
    ]:
        with pytest.raises(ValueError, match=message):
            load_study("snn", options)


def test_argate_refuses_what_cannot_train() -> None:
    study = load_study("argate", [])
    with pytest.raises(ValueError, match="learning_rate = 0: expected a positive"):
        study.check(study.params._replace(learning_rate=np.array([0.0])))
    with pytest.raises(ValueError, match="kind='rust': expected"):
        load_study("argate", ["kind=rust"])


@pytest.mark.slow
@pytest.mark.relaxed
def test_argate_learns_and_diverges() -> None:
    study = load_study("argate", SMALL["argate"])
    columns = {"learning_rate": [5e-3, 1e30], "loss.alpha": [1.0, 1.0]}
    out = numbers(study, columns, 1)
    assert out["accuracy"][0] > 33.0  # four classes; chance is 25, its standard error 2
    assert out["accuracy_clean"][0] > out["accuracy_corrupted"][0]
    assert np.isnan(out["accuracy"][1])


@pytest.mark.slow
@pytest.mark.relaxed
def test_argate_side_by_side_is_one_by_one() -> None:
    study = load_study("argate", ["epochs=2"])
    columns = {"learning_rate": [2e-3, 5e-3, 1e-2]}
    one, three = numbers(study, columns, 1), numbers(study, columns, 3)
    np.testing.assert_allclose(one["loss"], three["loss"], rtol=1e-3)
    np.testing.assert_allclose(one["accuracy"], three["accuracy"], atol=1.0)


@pytest.mark.slow
def test_failure_search_beats_its_initial_design() -> None:
    study = load_study("failure", SMALL["failure"])
    columns = {"size": [3.0, 3.0, 1.0], "weight": [0.5, 0.2, 0.5]}
    one, three = numbers(study, columns, 1), numbers(study, columns, 3)
    for name in study.metrics:
        np.testing.assert_allclose(one[name], three[name], rtol=1e-9, err_msg=name)
    assert (one["worst"] >= one["worst_initial"]).all()
    assert (one["worst"][:2] > one["worst_initial"][:2]).all()
    assert one["worst"][2] < one["worst"][:2].min()  # a smaller box holds less
    hit = one["worst"] > 0.3
    np.testing.assert_array_equal(one["hit"], 100.0 * hit)
    np.testing.assert_array_equal(np.isfinite(one["first_hit"]), hit)


def test_failure_refuses_what_makes_no_search() -> None:
    study = load_study("failure", [])
    for leaf, value in [("size", 0.0), ("weight", 1.5), ("region", 0.0)]:
        tree = jax.tree.map(lambda x: np.array([x]), study.params)
        with pytest.raises(ValueError, match=rf"{leaf} = {value:g}: expected"):
            study.check(tree._replace(**{leaf: np.array([value])}))
    with pytest.raises(ValueError, match="n_init=60"):
        load_study("failure", ["n_init=60"])
    with pytest.raises(ValueError, match=r"expected one of .dcdc"):
        load_study("failure", ["circuit=opamp"])


def test_a_study_needs_an_objective() -> None:
    study = load_study("lif")
    with pytest.raises(ValueError, match="objective='rate': expected one of error"):
        dataclasses.replace(study, objective="rate")
