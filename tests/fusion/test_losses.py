"""Equations 3.1 and 3.2 against a plain numpy reading of them, and where gradients flow."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.losses import (
    LossConfig,
    LossParams,
    argate_loss,
    cross_entropy,
    gate_penalty,
    loss_targets,
)
from fusion.targets import (
    TargetConfig,
    apply_targets,
    check_targets,
    init_targets,
    project_targets,
)

RNG = np.random.default_rng(0)
LOGITS = RNG.standard_normal((5, 6)).astype(np.float32)
AUX = RNG.standard_normal((5, 9, 6)).astype(np.float32)
LABELS = RNG.integers(0, 6, 5).astype(np.int32)
W = np.exp(RNG.standard_normal((5, 9)))
W = (W / W.sum(1, keepdims=True)).astype(np.float32)


def _softmax(x: np.ndarray) -> np.ndarray:
    e = np.exp(x - x.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def _ce(logits: np.ndarray, labels: np.ndarray) -> np.ndarray:
    return -np.log(_softmax(logits.astype(np.float64))[np.arange(len(labels)), labels])


def _aux_losses() -> np.ndarray:
    return np.stack([_ce(AUX[:, k], LABELS) for k in range(9)], axis=1)


def test_printed_loss_equals_the_equation() -> None:
    losses = _aux_losses()
    target = _softmax(1 / (1 + np.exp(-np.exp(-losses))))
    expected = (
        _ce(LOGITS, LABELS).mean()
        + 0.7 * (W * losses).sum(1).mean()
        + 2.5 * ((W - target) ** 2).sum(1).mean()
    )
    config = LossConfig(learned_targets=False, fixed_targets="softmax_sigmoid", label_smoothing=0.0)
    labels = jnp.broadcast_to(jnp.asarray(LABELS)[:, None], (5, 9))
    aux = cross_entropy(jnp.asarray(AUX), labels)
    terms = argate_loss(
        config, LossParams(0.7, 2.5), jnp.asarray(LOGITS), jnp.asarray(LABELS), jnp.asarray(W), aux
    )
    np.testing.assert_allclose(terms.total, expected, rtol=1e-5)


def test_learned_targets_replace_the_fixed_ones() -> None:
    aux = jnp.asarray(_aux_losses(), jnp.float32)
    targets = jnp.asarray(W[::-1].copy())
    terms = argate_loss(
        LossConfig(label_smoothing=0.0, uniform_floor=1.0),
        LossParams(1.0, 1.0, 0.5, 2.0),
        jnp.asarray(LOGITS),
        jnp.asarray(LABELS),
        jnp.asarray(W),
        aux,
        targets,
    )
    np.testing.assert_allclose(terms.regularization, ((W - W[::-1]) ** 2).sum(1).mean(), rtol=1e-5)
    fixed = _softmax(-_aux_losses() / 0.5)
    np.testing.assert_allclose(terms.anchor, ((W[::-1] - fixed) ** 2).sum(1).mean(), rtol=1e-4)
    np.testing.assert_allclose(terms.auxiliary, _aux_losses().mean(), rtol=1e-5)
    total = terms.main + terms.auxiliary + terms.regularization + 2.0 * terms.anchor
    np.testing.assert_allclose(terms.total, total, rtol=1e-6)


def test_targets_from_other_losses_in_the_examples_that_count() -> None:
    other, counted = _aux_losses()[::-1].copy(), np.array([1.0, 0, 1, 1, 0], np.float32)
    config = LossConfig(learned_targets=False, label_smoothing=0.0, uniform_floor=1.0)
    terms = gate_penalty(
        config, LossParams(1.0, 1.0, 0.5), jnp.asarray(W), jnp.asarray(_aux_losses(), jnp.float32),
        target_losses=jnp.asarray(other, jnp.float32), counted=jnp.asarray(counted),
    )  # fmt: skip
    squares = ((W - _softmax(-other / 0.5)) ** 2).sum(1)
    np.testing.assert_allclose(terms.regularization, (counted * squares).mean(), rtol=1e-4)
    np.testing.assert_allclose(terms.auxiliary, _aux_losses().mean(), rtol=1e-5)


def test_range_of_the_printed_targets() -> None:
    best = jnp.asarray([[0.0] + [50.0] * 8])
    worst = jnp.asarray([[50.0] + [0.0] * 8])
    high = loss_targets(best, "softmax_sigmoid")[0, 0]
    low = loss_targets(worst, "softmax_sigmoid")[0, 0]
    np.testing.assert_allclose([low, high], [0.090, 0.136], atol=5e-4)


def test_label_smoothing_is_the_mixture() -> None:
    smoothed = cross_entropy(jnp.asarray(LOGITS), jnp.asarray(LABELS), 0.1)
    q = np.full((5, 6), 0.1 / 6)
    q[np.arange(5), LABELS] += 0.9
    np.testing.assert_allclose(smoothed, -(q * np.log(_softmax(LOGITS))).sum(1), rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "to_weights", "to_aux"),
    [
        ({"stop_weights": True, "regularization": False, "learned_targets": False}, False, True),
        ({"stop_weights": False, "regularization": False, "learned_targets": False}, True, True),
    ],
)
def test_alpha_term_gradient_paths(
    options: dict[str, bool], to_weights: bool, to_aux: bool
) -> None:
    config = LossConfig(**options)

    def total(w: jax.Array, aux: jax.Array) -> jax.Array:
        return argate_loss(
            config, LossParams(), jnp.asarray(LOGITS), jnp.asarray(LABELS), w, aux
        ).total

    gw, ga = jax.grad(total, (0, 1))(jnp.asarray(W), jnp.asarray(_aux_losses(), jnp.float32))
    assert bool(jnp.any(gw != 0)) is to_weights
    assert bool(jnp.any(ga != 0)) is to_aux


def test_regularization_reaches_auxiliary_losses_only_when_asked() -> None:
    def regularization(aux: jax.Array, stop: bool) -> jax.Array:
        config = LossConfig(learned_targets=False, stop_targets=stop)
        terms = argate_loss(
            config, LossParams(), jnp.asarray(LOGITS), jnp.asarray(LABELS), jnp.asarray(W), aux
        )
        return terms.regularization

    aux = jnp.asarray(_aux_losses(), jnp.float32)
    assert not jnp.any(jax.grad(regularization)(aux, True))
    assert jnp.any(jax.grad(regularization)(aux, False))


def test_combinations_that_mean_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match="expected auxiliary=True with it"):
        LossConfig(auxiliary=False)
    with pytest.raises(ValueError, match="expected regularization=True with it"):
        LossConfig(regularization=False)
    with pytest.raises(ValueError, match=r"uniform_floor=1\.5"):
        LossConfig(uniform_floor=1.5)


def test_targets_fall_with_the_own_loss_whatever_the_parameters() -> None:
    config = TargetConfig()
    params = init_targets(jax.random.key(0), config, 4)
    noise = jax.tree.map(
        lambda p: p + jax.random.normal(jax.random.key(1), p.shape, p.dtype), params
    )
    assert check_targets(config, noise) > 0
    projected = jax.jit(project_targets, static_argnums=0)(config, noise)
    apply = jax.jit(apply_targets, static_argnums=0)
    assert check_targets(config, projected) == 0
    others = jax.random.uniform(jax.random.key(2), (16, 4), maxval=4.0)
    grid = jnp.linspace(0.0, 5.0, 21)
    for k in range(4):
        losses = jnp.broadcast_to(others[:, None], (16, 21, 4)).at[:, :, k].set(grid)
        targets = apply(config, projected, losses.reshape(-1, 4)).reshape(16, 21, 4)
        assert jnp.all(jnp.diff(targets[:, :, k], axis=1) <= 1e-6)
    assert jnp.all((targets >= 0) & (targets <= 1))
