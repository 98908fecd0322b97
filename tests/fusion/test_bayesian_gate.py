"""Distributions over the gate's parameters: moments, divergence, draws, training."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from fusion.bayesian_gate import (
    VariationalGate,
    gate_divergence,
    gaussian_divergence,
    relu_moments,
)
from fusion.config import HyperParams, ModelConfig, TrainConfig
from fusion.encoders import EncoderConfig
from fusion.failures import random_failing
from fusion.gating import Gate
from fusion.losses import LossParams
from fusion.models import export, init, predict
from fusion.train import batch_loss, make_train

pytestmark = pytest.mark.relaxed

SMALL = ModelConfig(
    "argate_plus",
    n_sensors=3,
    n_times=1,
    n_classes=2,
    encoder=EncoderConfig(features=4, frequencies=2),
    gate_width=5,
    head_widths=(6,),
    dropout=0.0,
    gate_kind="variational",
    gate_prior=0.5,
)


def moved(params: Any, by: float = 0.4, seed: int = 0) -> Any:
    """Parameters off their start, where most of a gate is zero."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda p: jnp.asarray(p + by * rng.normal(size=p.shape), jnp.float32), params
    )


def gate_of(**changes: Any) -> tuple[VariationalGate, Any, jax.Array]:
    """A gate away from its start, and features."""
    gate = VariationalGate(5, "softmax", **changes)
    z = jax.random.normal(jax.random.key(1), (3, 4, 2))
    return gate, moved(gate.init(jax.random.key(0), z)), z


def test_the_divergence_is_the_integral_that_defines_it() -> None:
    mean, spread, prior = np.array([0.3, -1.0]), np.array([-1.0, 0.4]), 0.7
    wanted = 0.0
    for m, r in zip(mean, spread, strict=True):
        q, p = stats.norm(m, prior * np.exp(r)), stats.norm(0.0, prior)
        wanted += integrate.quad(lambda a, q=q, p=p: q.pdf(a) * (q.logpdf(a) - p.logpdf(a)), -9, 9)[
            0
        ]
    found = gaussian_divergence(jnp.asarray(mean), jnp.asarray(spread), prior)
    assert float(found) == pytest.approx(wanted, rel=1e-4)
    assert float(gaussian_divergence(jnp.zeros(3), jnp.zeros(3), prior)) == 0.0


@pytest.mark.parametrize(("m", "v"), [(0.0, 1.0), (1.5, 0.25), (-1.0, 4.0)])
def test_moments_of_a_rectified_gaussian_are_those_of_quadrature(m: float, v: float) -> None:
    density = stats.norm(m, v**0.5).pdf
    first = integrate.quad(lambda a: a * density(a), 0.0, 20.0)[0]
    second = integrate.quad(lambda a: a * a * density(a), 0.0, 20.0)[0]
    found = relu_moments(jnp.float32(m), jnp.float32(v))
    np.testing.assert_allclose(found, [first, second - first**2], atol=1e-5)


def test_without_variance_the_moments_are_the_rectified_mean() -> None:
    mean, variance = relu_moments(jnp.array([-1.0, 2.0]), jnp.zeros(2))
    np.testing.assert_allclose(mean, [0.0, 2.0], atol=1e-5)
    np.testing.assert_allclose(variance, 0.0, atol=1e-5)


def test_moments_of_the_scores_are_those_of_drawn_parameters() -> None:
    gate, variables, z = gate_of(own_scores=True, prior=0.5)
    p = jax.tree.map(np.asarray, variables["params"])
    joined = np.transpose(np.asarray(z), (1, 0, 2)).reshape(4, -1)
    hidden = np.maximum(joined @ p["fc_con"]["kernel"] + p["fc_con"]["bias"], 0.0)
    rng = np.random.default_rng(0)

    def draw(of: dict, name: str) -> np.ndarray:
        sd = 0.5 * np.exp(of[f"{name}_spread"])
        return of[name] + sd * rng.normal(size=(20000, *of[name].shape))

    split = p["split"]
    scores = np.einsum("bh,shk->sbk", hidden, draw(split, "kernel"))
    scores += draw(split, "bias")[:, None] + np.einsum("kbf,skf->sbk", z, draw(p, "own"))
    mean, variance = gate.apply(variables, z, method="moments")
    np.testing.assert_allclose(mean, scores.mean(0), atol=0.03)
    np.testing.assert_allclose(variance, scores.var(0), rtol=0.06)


def test_moments_of_a_whole_gate_are_close_to_its_draws() -> None:
    """Exact but for the hidden units, whose joint distribution is taken to be independent."""
    gate, variables, z = gate_of(whole=True, prior=0.3)
    keys = jax.random.split(jax.random.key(2), 4000)
    draws = jax.jit(jax.vmap(lambda k: gate.apply(variables, z, k)))(keys)
    logs = np.log(np.asarray(draws))
    mean, variance = map(np.asarray, gate.apply(variables, z, method="moments"))
    # Draws are seen through the softmax, which keeps differences of scores.
    gap = logs[:, :, 0] - logs[:, :, 1]
    np.testing.assert_allclose(gap.mean(0), mean[:, 0] - mean[:, 1], atol=0.06)
    np.testing.assert_allclose(gap.var(0), variance[:, 0] + variance[:, 1], rtol=0.15)


@pytest.mark.parametrize("whole", [False, True])
def test_the_mean_gate_is_the_deterministic_gate(whole: bool) -> None:
    gate, variables, z = gate_of(own_scores=True, whole=whole)
    p = variables["params"]
    kept = {
        name: {n: v for n, v in p[name].items() if not n.endswith("_spread")}
        for name in ("fc_con", "split")
    }
    plain = Gate(5, "softmax", own_scores=True).apply({"params": kept | {"own": p["own"]}}, z)
    np.testing.assert_array_equal(gate.apply(variables, z), plain)


def test_the_loss_holds_the_divergence_over_the_training_rows() -> None:
    params = moved(init(jax.random.key(0), SMALL), 0.1)
    x, y = jax.random.normal(jax.random.key(1), (4, 3, 1)), jnp.array([0, 1, 0, 1])
    batch = x, y, jnp.zeros((4, 3), bool)

    def total(weight: jax.Array, n: int | None) -> jax.Array:
        hyper = HyperParams(loss=LossParams()._replace(divergence=weight))
        return batch_loss(SMALL, hyper, params, *batch, n_examples=n)[0]

    split = jax.tree.map(np.asarray, params["main"]["gate"]["split"])
    wanted = 0.0
    for name in ("kernel", "bias"):
        sd = 0.5 * np.exp(split[f"{name}_spread"])
        wanted += np.sum(np.log(0.5 / sd) + (sd**2 + split[name] ** 2) / (2 * 0.25) - 0.5)
    slope = jax.jit(jax.grad(total), static_argnums=1)
    assert float(slope(jnp.float32(0.3), 1000)) == pytest.approx(wanted / 1000, rel=1e-4)
    assert float(slope(jnp.float32(0.3), None)) == pytest.approx(wanted / 4, rel=1e-4)
    assert float(gate_divergence(params["main"]["gate"], 0.5)) == pytest.approx(wanted, rel=1e-5)


def test_the_weight_of_the_divergence_is_swept_without_compiling_anew() -> None:
    """Two weights in one program; the heavy one leaves the gate nearer to its prior."""
    rng = np.random.default_rng(0)
    y = rng.integers(0, 2, 256)
    x = (np.where(y == 1, 0.5, -0.5)[:, None, None] + 0.2 * rng.normal(size=(256, 3, 1))).astype(
        np.float32
    )
    protocol = random_failing(("a", "b", "c"), n_clean=1)
    run = make_train(SMALL, TrainConfig(epochs=20, batch_size=32), 256, protocol)

    def train(weight: jax.Array) -> Any:
        hyper = HyperParams(5e-2, loss=LossParams()._replace(divergence=weight))
        return run(hyper, jnp.asarray(x), jnp.asarray(y), key=jax.random.key(0))

    state, metrics = jax.jit(jax.vmap(train))(jnp.array([0.0, 30.0]))
    gates = [jax.tree.map(lambda v, i=i: v[i], state.params["main"]["gate"]) for i in (0, 1)]
    free, bound = (float(gate_divergence(gate, 0.5)) for gate in gates)
    assert np.isfinite(metrics.loss.total).all()
    assert bound < 0.5 * free
    assert float(metrics.accuracy[0, -1]) > 0.85


def test_given_weights_replace_those_of_the_gate() -> None:
    main = moved(export(init(jax.random.key(0), SMALL)))
    x = jax.random.normal(jax.random.key(1), (4, 3, 1))
    own = predict(SMALL, main, x)
    again = predict(SMALL, main, x, weights=own.weights)
    np.testing.assert_array_equal(own.logits, again.logits)
    other = jnp.tile(jnp.array([1.0, 0.0, 0.0]), (4, 1))
    found = predict(SMALL, main, x, weights=other)
    np.testing.assert_array_equal(found.weights, other)
    assert float(jnp.abs(found.logits - own.logits).max()) > 1e-3
    absent = predict(SMALL, main, x.at[:, 2].set(jnp.nan), weights=own.weights)
    w = np.asarray(own.weights)[:, :2]
    np.testing.assert_allclose(absent.weights[:, :2], w / w.sum(1, keepdims=True), rtol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gate_kind": "bayes"}, "gate_kind='bayes': expected one of"),
        ({"gate_prior": 0.0}, "gate_prior=0.0: expected a number > 0"),
        ({"model": "baseline"}, "expected a model with a learned gate, 'baseline' has none"),
    ],
)
def test_what_cannot_be_a_gate_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SMALL, **changes)


def test_a_negative_weight_of_the_divergence_is_refused() -> None:
    with pytest.raises(ValueError, match="divergence=-1"):
        LossParams(divergence=-1)


@pytest.mark.parametrize(
    ("gate", "kind"), [("bayesian", "variational"), ("bayesian_whole", "variational_whole")]
)
def test_the_command_builds_the_gate_that_was_asked_for(gate: Any, kind: str) -> None:
    from fusion.data import load
    from snn_fusion_failure.commands.argate_runs import Config, build_settings

    options = Config(dataset="simulated", gate=gate, changes=("model.gate_prior=0.3",))
    model = build_settings(options, load("simulated")).model
    assert (model.gate_kind, model.gate_prior) == (kind, 0.3)
    with pytest.raises(ValueError, match="'baseline' has none"):
        build_settings(dataclasses.replace(options, model="baseline"), load("simulated"))
