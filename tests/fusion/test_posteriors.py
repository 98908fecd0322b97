"""Ensembles, dropout and Laplace on the gate, against loops and matrices written out."""

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
from fusion.gating import normalize
from fusion.models import export, init, predict
from fusion.posteriors import (
    dropout_predictive,
    ensemble_predictive,
    fit_laplace,
    gate_curvature,
    laplace_moments,
    laplace_predictive,
)

pytestmark = pytest.mark.relaxed

CONFIG = ModelConfig(
    "netgated",
    n_sensors=2,
    n_times=1,
    n_classes=3,
    encoder=EncoderConfig(features=3, frequencies=1),
    gate_width=3,
    head_widths=(5,),
    dropout=0.3,
)
X = jax.random.normal(jax.random.key(1), (7, 2, 1))


def network(seed: int = 0) -> Any:
    rng = np.random.default_rng(seed)
    start = export(init(jax.random.key(seed), CONFIG))
    return jax.tree.map(
        lambda p: jnp.asarray(p + 0.5 * rng.normal(size=p.shape), jnp.float32), start
    )


MAIN = network()


def logits_of(split: dict[str, Any]) -> jax.Array:
    main = MAIN | {"gate": MAIN["gate"] | {"split": split}}
    return predict(CONFIG, main, X).logits


def written_out() -> np.ndarray:
    """The curvature from the whole Jacobian in the layer's parameters."""
    jacobian = jax.jit(jax.jacobian(logits_of))(MAIN["gate"]["split"])
    rows = np.concatenate([jacobian["kernel"], jacobian["bias"][:, :, None, :]], axis=2)
    j = np.asarray(rows, np.float64).reshape(7, 3, -1)
    p = special.softmax(np.asarray(logits_of(MAIN["gate"]["split"]), np.float64), axis=-1)
    inner = p[:, :, None] * np.eye(3) - p[:, :, None] * p[:, None, :]
    return np.einsum("bci,bcd,bdj->ij", j, inner, j)


def test_the_curvature_is_that_of_the_whole_jacobian() -> None:
    found = np.asarray(jax.jit(gate_curvature, static_argnums=0)(CONFIG, MAIN, X))
    np.testing.assert_allclose(found.reshape(8, 8), written_out(), atol=2e-5)


def test_the_covariance_is_the_inverse_with_the_prior_whatever_the_chunks() -> None:
    wanted = np.linalg.inv(written_out() + np.eye(8) / 0.5**2)
    for size in (3, 256):
        found = fit_laplace(CONFIG, MAIN, X, prior=0.5, batch_size=size)
        np.testing.assert_allclose(np.asarray(found.covariance).reshape(8, 8), wanted, atol=1e-5)


def test_draws_of_laplace_have_its_moments() -> None:
    laplace = fit_laplace(CONFIG, MAIN, X)
    features = predict(CONFIG, MAIN, X).features
    mean, covariance = laplace_moments(MAIN, laplace, features)
    np.testing.assert_allclose(
        normalize(mean, "softmax"), predict(CONFIG, MAIN, X).weights, atol=1e-6
    )
    found = laplace_predictive(CONFIG, MAIN, laplace, X, key=jax.random.key(0), n_draws=16000)
    c = np.asarray(covariance)
    sd = np.sqrt(c[:, 0, 0] + c[:, 1, 1] - 2 * c[:, 0, 1])
    gap = np.asarray(mean[:, 0] - mean[:, 1])
    # Of two weights, the log odds are the difference of the scores.
    high = special.logit(np.asarray(found.weight_high[:, 0], np.float64))
    np.testing.assert_allclose(high, gap + 1.645 * sd, atol=0.15)


def test_an_ensemble_is_the_mean_of_its_members() -> None:
    members = [network(seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *p: jnp.stack(p), *members)
    found = jax.jit(ensemble_predictive, static_argnums=0)(CONFIG, stacked, X)
    each = [predict(CONFIG, main, X) for main in members]
    p = np.mean([special.softmax(np.asarray(out.logits), axis=-1) for out in each], axis=0)
    np.testing.assert_allclose(found.probabilities, p, atol=1e-5)
    w = np.mean([out.weights for out in each], axis=0)
    np.testing.assert_allclose(found.weights, w, atol=1e-6)
    assert float(found.epistemic.min()) > 0.0


def test_dropout_draws_are_those_of_a_loop_and_leave_the_weights_alone() -> None:
    found = dropout_predictive(CONFIG, MAIN, X, key=jax.random.key(5), n_draws=6)
    p = [
        special.softmax(np.asarray(predict(CONFIG, MAIN, X, key=one).logits), axis=-1)
        for one in jax.random.split(jax.random.key(5), 6)
    ]
    np.testing.assert_allclose(found.probabilities, np.mean(p, axis=0), atol=1e-5)
    np.testing.assert_allclose(found.weight_low, found.weight_high, atol=1e-6)
    with pytest.raises(ValueError, match=r"dropout=0\.0: expected a rate"):
        without = dataclasses.replace(CONFIG, dropout=0.0)
        dropout_predictive(without, MAIN, X, key=jax.random.key(5))


@pytest.mark.parametrize(
    "changes", [{"model": "baseline"}, {"gate_kind": "variational"}], ids=["none", "variational"]
)
def test_laplace_needs_a_learned_deterministic_gate(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected a learned, deterministic gate"):
        fit_laplace(dataclasses.replace(CONFIG, **changes), MAIN, X)
    with pytest.raises(ValueError, match="prior=0"):
        fit_laplace(CONFIG, MAIN, X, prior=0.0)
