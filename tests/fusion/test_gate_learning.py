"""What the gate can be taught by: imitation, masks, held-out rows, the equations as printed."""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion import load, preset
from fusion.bilevel import held_out_gradient
from fusion.config import MODELS, HyperParams, ModelConfig, TrainConfig
from fusion.losses import (
    LossConfig,
    LossParams,
    distance_to_targets,
    loss_targets,
    mask_penalty,
    product_of_experts,
)
from fusion.modules import ARGate, ARGateLoss, LatticeTargets
from fusion.train import batch_loss, init_state, train_step


def test_the_divergence_is_that_of_numpy_and_zero_only_for_equal_shares() -> None:
    rng = np.random.default_rng(0)
    w, t = rng.dirichlet(np.full(4, 9.0), 5), rng.uniform(0.1, 1.0, (5, 4))
    share = t / t.sum(1, keepdims=True)
    wanted = (share * np.log(share / w)).sum(1)
    given = jnp.asarray(w, jnp.float32), jnp.asarray(t, jnp.float32)
    np.testing.assert_allclose(distance_to_targets(*given, "kl"), wanted, atol=1e-4)
    assert float(distance_to_targets(given[0], 3.0 * given[0], "kl").max()) < 1e-4
    np.testing.assert_allclose(distance_to_targets(*given), ((w - t) ** 2).sum(1), rtol=1e-5)
    with pytest.raises(ValueError, match="form='mse'"):
        distance_to_targets(*given, "mse")


def test_the_mask_penalty_is_least_for_equal_shares_of_working_sensors() -> None:
    failed = jnp.array([[True, False, False]])
    best = jnp.array([[0.0, 0.5, 0.5]])
    assert float(mask_penalty(best, failed)[0]) == pytest.approx(np.log(2.0), abs=1e-4)
    for other in ([[0.2, 0.4, 0.4]], [[0.0, 0.9, 0.1]]):
        assert mask_penalty(jnp.array(other), failed)[0] > mask_penalty(best, failed)[0]


def test_the_unrolled_gradient_is_that_of_finite_differences() -> None:
    """One weight, one target: the step is known by hand."""

    def penalized(p: dict, batch: tuple) -> jax.Array:
        return jnp.mean((p["main"] - p["targets"] * batch[0]) ** 2)

    def main(p: dict, batch: tuple) -> jax.Array:
        return jnp.mean((p["main"] - batch[0]) ** 2)

    params = {"main": jnp.float32(0.3), "targets": jnp.float32(0.8)}
    x = jnp.array([1.0, 2.0, -1.0, 0.5])
    found = held_out_gradient(params, (x,), 0.1, penalized=penalized, main=main)

    def after(f: float) -> float:
        moved = 0.3 - 0.1 * np.mean(2.0 * (0.3 - f * np.array([1.0, 2.0])))
        return float(np.mean((moved - np.array([-1.0, 0.5])) ** 2))

    assert float(found) == pytest.approx((after(0.801) - after(0.799)) / 0.002, rel=1e-3)


def test_printed_models_follow_the_equations_to_the_letter() -> None:
    data = load("simulated")
    for name in ("argate_plus_printed", "argate_l_printed"):
        model, _, hyper = preset(data, name)
        loss = model.recipe.loss
        assert model.normalizer == loss.fixed_targets == "softmax_sigmoid"
        assert loss.loss_weighting and loss.uniform_floor == 0.0 and not loss.stop_targets
        assert loss.label_smoothing == 0.0 and hyper.loss.anchor == 0.0
        assert loss.learned_targets == (name == "argate_l_printed")
    losses = jnp.array([[0.0, 1.8]])
    printed = jnp.exp(jax.nn.sigmoid(jnp.exp(-losses)))
    np.testing.assert_allclose(
        loss_targets(losses, "softmax_sigmoid"), printed / printed.sum(), rtol=1e-6
    )


def test_a_product_of_experts_trusts_the_path_that_is_right() -> None:
    """Two paths, the first right and the second wrong with the same confidence."""
    logits = jnp.log(jnp.array([[[0.8, 0.2], [0.2, 0.8]]]))
    y = jnp.array([0])
    slope = jax.grad(lambda f: product_of_experts(f, logits, y)[0])(jnp.array([[0.5, 0.5]]))
    # -log softmax of f_1 a - f_2 a with a = log 4, at equal exponents: slopes -a / 2 and a / 2.
    np.testing.assert_allclose(slope, [[-np.log(4.0) / 2, np.log(4.0) / 2]], rtol=1e-5)
    alone = product_of_experts(jnp.array([[1.0, 0.0]]), logits, y)
    assert float(alone[0]) == pytest.approx(-np.log(0.8), rel=1e-5)
    still = jax.grad(lambda z: product_of_experts(jnp.ones((1, 2)), z, y)[0])(logits)
    assert not np.any(still)


@pytest.mark.relaxed  # optax
def test_experts_train_the_targets_and_no_path() -> None:
    x, y = jnp.ones((8, 3, 1)), jnp.arange(8) % 2
    failed = jnp.zeros((8, 3), bool)
    key, grads = jax.random.key(0), {}
    for training in ("imitation", "experts"):
        # beta and the anchor alone would move nothing but the gate.
        loss = LossConfig(target_training=training, label_smoothing=0.0)
        model = ModelConfig("argate_l", n_sensors=3, n_times=1, n_classes=2, loss=loss)
        params = init_state(key, model, TrainConfig(batch_size=8)).params
        hyper = HyperParams(loss=LossParams(alpha=0.0, beta=1.0, anchor=0.0))
        grads[training] = jax.jit(
            jax.grad(lambda p, m=model, h=hyper: batch_loss(m, h, p, x, y, failed)[0])
        )(params)
    for part in ("main", "aux"):
        jax.tree.map(
            np.testing.assert_array_equal, grads["experts"][part], grads["imitation"][part]
        )
    apart = jax.tree.map(
        lambda a, b: float(jnp.abs(a - b).max()),
        grads["experts"]["targets"],
        grads["imitation"]["targets"],
    )
    assert max(jax.tree.leaves(apart)) > 1e-4


@pytest.mark.relaxed  # optax
def test_a_step_with_masks_and_held_out_rows_moves_gate_and_targets() -> None:
    loss = LossConfig(imitation="kl", target_training="held_out", mask_supervision=True)
    model = ModelConfig("argate_l", n_sensors=3, n_times=1, n_classes=2, loss=loss)
    config = TrainConfig(batch_size=8)
    state = init_state(jax.random.key(0), model, config)
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.normal(size=(8, 3, 1)), jnp.float32)
    y, failed = jnp.asarray(rng.integers(0, 2, 8)), jnp.asarray(rng.random((8, 3)) < 0.4)
    step = jax.jit(
        lambda hyper, state: train_step(
            model, config, hyper, state, jnp.float32(1e-2), x, y, failed, key=jax.random.key(1)
        )
    )
    new, metrics = step(HyperParams(), state)
    plain, _ = step(HyperParams(loss=LossParams(mask=0.0)), state)

    def moved(part: str, other: dict) -> float:
        pairs = zip(jax.tree.leaves(other[part]), jax.tree.leaves(state.params[part]), strict=True)
        return max(float(jnp.abs(a - b).max()) for a, b in pairs)

    assert np.isfinite(float(metrics.loss.total))
    assert moved("targets", new.params) > 0.0
    gate, unsupervised = new.params["main"]["gate"], plain.params["main"]["gate"]
    assert not np.array_equal(gate["split"]["kernel"], unsupervised["split"]["kernel"])


def test_what_the_gate_learns_from_is_checked() -> None:
    with pytest.raises(ValueError, match="imitation='mse'"):
        LossConfig(imitation="mse")
    with pytest.raises(ValueError, match="target_training='held_out'"):
        LossConfig(learned_targets=False, target_training="held_out")
    with pytest.raises(ValueError, match="target_training='experts'"):
        LossConfig(learned_targets=False, target_training="experts")
    for change in ({"mask_supervision": True}, {"target_training": "experts"}):
        (name,) = change
        net = ARGate((nn.Dense(2),) * 2, nn.Dense(2), (nn.Dense(2),) * 2, LatticeTargets())
        loss = ARGateLoss(net, LossConfig(label_smoothing=0.0, **change))
        with pytest.raises(ValueError, match=f"config.{name}="):
            loss.init(jax.random.key(0), LossParams(), [jnp.ones((4, 3))] * 2, jnp.arange(4) % 2)
    told = dataclasses.replace(MODELS["baseline"].loss, mask_supervision=True)
    with pytest.raises(ValueError, match="mask_supervision=True"):
        ModelConfig("baseline", loss=told)
