"""The predictive distribution: draws against loops, one pass against draws, abstention."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from fusion.config import ModelConfig
from fusion.encoders import EncoderConfig
from fusion.models import export, init, predict, variational_gate
from fusion.uncertainty import (
    abstain,
    abstention_threshold,
    expected_softmax,
    one_pass_predictive,
    sample_predictive,
    summarize_draws,
)

pytestmark = pytest.mark.relaxed

CONFIG = ModelConfig(
    "netgated",
    n_sensors=3,
    n_times=1,
    n_classes=4,
    encoder=EncoderConfig(features=4, frequencies=2),
    gate_width=5,
    head_widths=(8,),
    dropout=0.2,
    gate_kind="variational",
)
X = jax.random.normal(jax.random.key(1), (6, 3, 1))
X = X.at[0, 1].set(jnp.nan)


def network(config: ModelConfig = CONFIG, spread: float = -2.5) -> Any:
    """A network away from its start, with the given log standard deviations."""
    rng = np.random.default_rng(0)

    def move(path: Any, p: jax.Array) -> jax.Array:
        if str(path[-1].key).endswith("_spread"):
            return jnp.full(p.shape, spread, jnp.float32)
        return jnp.asarray(p + 0.5 * rng.normal(size=p.shape), jnp.float32)

    return jax.tree_util.tree_map_with_path(move, export(init(jax.random.key(0), config)))


MAIN = network()
draw_many = jax.jit(sample_predictive, static_argnums=0, static_argnames=("n_draws", "level"))
in_one_pass = jax.jit(one_pass_predictive, static_argnums=0)


def test_one_call_gives_what_a_loop_over_the_draws_gives() -> None:
    found = draw_many(CONFIG, MAIN, X, key=jax.random.key(2), n_draws=16, level=0.5)
    features = predict(CONFIG, MAIN, X).features
    gate = variational_gate(CONFIG)
    p, w = [], []
    for one in jax.random.split(jax.random.key(2), 16):
        given = gate.apply({"params": MAIN["gate"]}, features, one)
        out = predict(CONFIG, MAIN, X, weights=given)
        p.append(special.softmax(np.asarray(out.logits, np.float64), axis=-1))
        w.append(np.asarray(out.weights))
    mean = np.mean(p, axis=0)
    np.testing.assert_allclose(found.probabilities, mean, atol=1e-5)
    np.testing.assert_allclose(found.weights, np.mean(w, axis=0), atol=1e-5)
    np.testing.assert_allclose(found.weight_low, np.quantile(w, 0.25, axis=0), atol=1e-5)
    np.testing.assert_allclose(found.weight_high, np.quantile(w, 0.75, axis=0), atol=1e-5)
    entropy = special.entr(mean).sum(-1)
    np.testing.assert_allclose(found.entropy, entropy, atol=1e-5)
    apart = entropy - np.mean([special.entr(one).sum(-1) for one in p], axis=0)
    np.testing.assert_allclose(found.epistemic, apart, atol=1e-5)


def test_an_absent_sensor_has_no_weight_and_no_interval() -> None:
    for found in (
        draw_many(CONFIG, MAIN, X, key=jax.random.key(2)),
        in_one_pass(CONFIG, MAIN, X),
    ):
        for part in (found.weights, found.weight_low, found.weight_high):
            assert float(part[0, 1]) == 0.0
        np.testing.assert_allclose(np.sum(found.weights, axis=1), 1.0, rtol=1e-5)


@pytest.mark.parametrize(("gap", "variance"), [(0.0, 4.0), (1.5, 1.0), (-3.0, 9.0)])
def test_the_expected_softmax_of_two_is_that_of_quadrature(gap: float, variance: float) -> None:
    nodes, shares = np.polynomial.hermite_e.hermegauss(80)
    wanted = shares @ special.expit(gap + variance**0.5 * nodes) / shares.sum()
    pairs = variance * (1.0 - np.eye(2, dtype=np.float32))
    found = expected_softmax(jnp.array([gap, 0.0]), jnp.asarray(pairs))
    assert float(found[0]) == pytest.approx(wanted, abs=0.02)


def test_the_expected_softmax_of_six_is_near_that_of_draws() -> None:
    rng = np.random.default_rng(0)
    mean, sd = rng.normal(size=6), rng.uniform(0.2, 1.5, 6)
    draws = special.softmax(mean + sd * rng.normal(size=(200_000, 6)), axis=1).mean(0)
    pairs = jnp.asarray((sd[:, None] ** 2 + sd**2) * (1.0 - np.eye(6)), jnp.float32)
    found = expected_softmax(jnp.asarray(mean, jnp.float32), pairs)
    np.testing.assert_allclose(found, draws, atol=0.05)
    plain = special.softmax(mean)
    assert np.abs(np.asarray(found) - draws).sum() < 0.7 * np.abs(plain - draws).sum()
    still = expected_softmax(jnp.asarray(mean, jnp.float32), jnp.zeros((6, 6)))
    np.testing.assert_allclose(still, plain, rtol=1e-5)


@pytest.mark.parametrize("kind", ["variational", "variational_whole"])
@pytest.mark.parametrize("normalizer", ["softmax", "softmax_sigmoid"])
def test_one_pass_is_near_many_draws(kind: str, normalizer: Any) -> None:
    config = dataclasses.replace(CONFIG, gate_kind=kind, normalizer=normalizer)
    main = network(config)
    drawn = draw_many(config, main, X, key=jax.random.key(3), n_draws=4000)
    found = in_one_pass(config, main, X)
    np.testing.assert_allclose(found.weights, drawn.weights, atol=0.02)
    np.testing.assert_allclose(found.probabilities, drawn.probabilities, atol=0.05)
    plain = predict(config, main, X).weights
    error, without = (jnp.abs(w - drawn.weights).mean() for w in (found.weights, plain))
    assert float(error) < float(without)
    np.testing.assert_allclose(found.weight_low, drawn.weight_low, atol=0.05)
    np.testing.assert_allclose(found.weight_high, drawn.weight_high, atol=0.05)
    # Second order in the spread of the logits: right in size, not to the digit.
    assert float(drawn.epistemic.max()) > 5e-4
    ratio = np.asarray(found.epistemic) / np.asarray(drawn.epistemic)
    assert 0.5 < float(np.median(ratio)) < 2.0


def test_a_gate_without_spread_has_no_epistemic_doubt_and_predicts_as_its_mean() -> None:
    main = network(spread=-20.0)
    plain = predict(CONFIG, main, X)
    for found in (draw_many(CONFIG, main, X, key=jax.random.key(2)), in_one_pass(CONFIG, main, X)):
        np.testing.assert_allclose(found.epistemic, 0.0, atol=1e-5)
        wanted = jax.nn.softmax(plain.logits, axis=-1)
        np.testing.assert_allclose(found.probabilities, wanted, atol=1e-5)
        np.testing.assert_allclose(found.weight_high, found.weight_low, atol=1e-4)


def test_draws_that_disagree_are_epistemic_and_draws_that_doubt_are_not() -> None:
    weights = jnp.ones((2, 1, 1))
    sure = jnp.array([[[20.0, 0.0]], [[0.0, 20.0]]])
    apart = summarize_draws(sure, weights)
    assert float(apart.epistemic[0]) == pytest.approx(np.log(2.0), abs=1e-4)
    alike = summarize_draws(jnp.zeros((2, 1, 2)), weights)
    assert float(alike.entropy[0]) == pytest.approx(np.log(2.0), abs=1e-5)
    assert float(alike.epistemic[0]) == pytest.approx(0.0, abs=1e-6)


def test_the_threshold_leaves_the_share_that_was_asked_for() -> None:
    p = np.random.default_rng(0).dirichlet(np.ones(3), 400)
    threshold = abstention_threshold(p, coverage=0.75)
    refused = np.asarray(abstain(jnp.asarray(p, jnp.float32), threshold))
    assert refused.mean() == pytest.approx(0.25, abs=0.01)
    assert p[refused].max(1).max() <= p[~refused].max(1).min() + 1e-6


def test_a_gate_without_distributions_is_refused() -> None:
    plain = dataclasses.replace(CONFIG, gate_kind="deterministic")
    main = export(init(jax.random.key(0), plain))
    with pytest.raises(ValueError, match="gate_kind='deterministic': expected a variational gate"):
        sample_predictive(plain, main, X, key=jax.random.key(0))
    with pytest.raises(ValueError, match="gate_kind='deterministic'"):
        one_pass_predictive(plain, main, X)
    with pytest.raises(ValueError, match=r"level=1.5: expected a number in \(0, 1\)"):
        sample_predictive(CONFIG, MAIN, X, key=jax.random.key(0), level=1.5)
    with pytest.raises(ValueError, match="coverage=0"):
        abstention_threshold(np.full((2, 2), 0.5), coverage=0.0)
