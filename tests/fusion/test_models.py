"""Models: matched sizes, ablations, what inference needs, and that it needs nothing else."""

from __future__ import annotations

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.config import MODELS, ModelConfig
from fusion.encoders import EncoderConfig
from fusion.losses import LossConfig
from fusion.models import (
    auxiliary_logits,
    export,
    init,
    predict,
)
from fusion.prediction import predict_batches
from fusion.sizes import count_parameters, match_parameters

SMALL = ModelConfig(
    n_sensors=3,
    n_times=1,
    n_classes=4,
    encoder=EncoderConfig(features=8, frequencies=4),
    gate_width=8,
    head_widths=(24,),
    embrace_width=12,
)
X = jax.random.uniform(jax.random.key(9), (7, 3, 1), minval=-1.0)
FAILED = jnp.zeros((7, 3), bool).at[:, 0].set(True)


@pytest.mark.parametrize(
    "reference",
    [
        SMALL,
        ModelConfig(),
        ModelConfig(n_sensors=15, n_times=1, n_classes=10, head_widths=(128, 128)),
    ],
)
def test_all_models_match_within_two_percent(reference: ModelConfig) -> None:
    wanted = count_parameters(reference)["total"]
    for name in MODELS:
        matched = match_parameters(dataclasses.replace(reference, model=name), reference)
        assert abs(count_parameters(matched)["total"] - wanted) <= 0.02 * wanted, name


def test_matching_says_when_it_cannot() -> None:
    huge = dataclasses.replace(SMALL, model="baseline", encoder=EncoderConfig(features=200))
    with pytest.raises(ValueError, match="parameters within 2 %"):
        match_parameters(huge, SMALL)


@pytest.mark.parametrize("name", MODELS)
def test_export_gives_the_same_logits_to_the_bit(name: str) -> None:
    chex.clear_trace_counter()
    config = dataclasses.replace(SMALL, model=name)
    params = init(jax.random.key(0), config)
    recipe = MODELS[name]
    told = FAILED if config.reads_failed else None
    assert set(params) == {"main"} | ({"aux"} if recipe.loss.auxiliary else set()) | (
        {"targets"} if recipe.loss.learned_targets else set()
    )

    @jax.jit
    @chex.assert_max_traces(n=1)
    def in_training(params: dict) -> jax.Array:
        out = predict(config, params["main"], X, told)
        if recipe.loss.auxiliary:
            assert auxiliary_logits(config, params, X, out.features).shape == (7, 3, 4)
        return out.logits

    main = export(params)
    names = {jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(main)}
    assert not any("aux" in n or "lattice" in n for n in names)
    exported = jax.jit(lambda main: predict(config, main, X, told).logits)(main)
    np.testing.assert_array_equal(exported, in_training(params))


def test_without_weight_sharing_the_auxiliary_paths_have_encoders_of_their_own() -> None:
    config = dataclasses.replace(SMALL, model="argate_ws", weight_sharing=False)
    params = init(jax.random.key(0), config)
    shared = dataclasses.replace(config, weight_sharing=True)
    assert "encoder" in params["aux"]
    assert count_parameters(config)["aux"] > count_parameters(shared)["aux"]
    features = predict(config, export(params), X).features
    moved = jax.tree.map(lambda p: p + 1.0, params["main"])
    unchanged = auxiliary_logits(config, params | {"main": moved}, X, features)
    np.testing.assert_array_equal(auxiliary_logits(config, params, X, features), unchanged)


def test_ablations_reach_the_loss() -> None:
    config = dataclasses.replace(SMALL, model="argate_l", loss=LossConfig(learned_targets=False))
    assert "targets" not in init(jax.random.key(0), config)
    assert config.recipe.loss == MODELS["argate_plus"].loss
    assert dataclasses.replace(config, loss=None).recipe == MODELS["argate_l"]
    with pytest.raises(ValueError, match=r"loss.loss_weighting=True: expected a model with a"):
        dataclasses.replace(SMALL, model="baseline", loss=LossConfig())


def test_embracenet_draws_at_inference_and_alike_in_every_batch() -> None:
    config = dataclasses.replace(SMALL, model="embracenet", embrace_width=64)
    main = export(init(jax.random.key(0), config))
    whole = predict(config, main, X).logits
    alone = jnp.concatenate([predict(config, main, X[i : i + 1]).logits for i in range(len(X))])
    np.testing.assert_allclose(whole, alone, rtol=1e-5, atol=1e-6)
    # One sensor left means that all features are drawn from it.
    only = jnp.zeros((7, 3), bool).at[:, 1].set(True)
    told = predict(config, main, X, available=only).logits
    moved = predict(config, main, X.at[:, 0].set(0.9), available=only).logits
    np.testing.assert_array_equal(told, moved)
    assert float(jnp.abs(whole - told).max()) > 1e-3


def test_oracle_needs_the_mask_and_uses_it() -> None:
    config = dataclasses.replace(SMALL, model="oracle")
    params = init(jax.random.key(0), config)
    with pytest.raises(ValueError, match="failed=None: expected the mask"):
        predict(config, export(params), X)
    a = predict(config, export(params), X, FAILED).logits
    b = predict(config, export(params), X.at[:, 0].set(0.7), FAILED).logits
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", [n for n in MODELS if n != "oracle"])
def test_a_mask_that_a_model_cannot_read_is_refused(name: str) -> None:
    config = dataclasses.replace(SMALL, model=name)
    assert not config.reads_failed
    wanted = r"failed=mask of \(7, 3\): expected None for model='.*give available=~failed"
    with pytest.raises(ValueError, match=wanted):
        predict(config, {}, X, FAILED)
    with pytest.raises(ValueError, match=wanted):
        jax.eval_shape(lambda x: predict_batches(config, {}, x, FAILED), X)


def test_what_would_hide_a_mask_or_have_no_use_for_it_is_refused() -> None:
    oracle = dataclasses.replace(SMALL, model="oracle")
    assert oracle.reads_failed
    with pytest.raises(ValueError, match="expected None beside weights"):
        predict(oracle, {}, X, FAILED, weights=jnp.ones((7, 3)))
    with pytest.raises(ValueError, match="failed=None: expected the mask"):
        # Without a mask all sensors were once taken for working ones.
        predict_batches(oracle, export(init(jax.random.key(0), oracle)), X)
    with pytest.raises(ValueError, match=r"excluded=mask of \(7, 7\): expected None for head="):
        predict(SMALL, {}, X, excluded=jnp.eye(7, dtype=bool))


def test_bad_configs_name_the_value_and_the_known_ones() -> None:
    with pytest.raises(ValueError, match="model='argate': expected one of 'baseline', 'netgated'"):
        ModelConfig(model="argate")
    with pytest.raises(ValueError, match=r"dropout=1\.0"):
        ModelConfig(dropout=1.0)
    with pytest.raises(ValueError, match="n_classes=0"):
        ModelConfig(n_classes=0)
