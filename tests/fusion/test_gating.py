"""Fusion weights: normalizers in closed form, the oracle, modality dropout and EmbraceNet."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.gating import (
    Gate,
    apply_weights,
    drop_modalities,
    embrace,
    normalize,
    oracle_weights,
)


def test_printed_normalizer_is_confined_as_the_docs_say() -> None:
    one_high = jnp.asarray([[40.0] + [-40.0] * 8])
    one_low = -one_high
    high = normalize(one_high, "softmax_sigmoid")[0, 0]
    low = normalize(one_low, "softmax_sigmoid")[0, 0]
    np.testing.assert_allclose(high, np.e / (np.e + 8), rtol=1e-5)
    np.testing.assert_allclose(low, 1 / (1 + 8 * np.e), rtol=1e-5)
    np.testing.assert_allclose([low, high], [0.044, 0.254], atol=5e-4)
    assert normalize(one_high, "softmax")[0, 0] > 0.999


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-8, 8, width=32), min_size=2, max_size=6))
def test_weights_are_positive_sum_to_one_and_keep_the_order(scores: list[float]) -> None:
    s = jnp.asarray(scores, jnp.float32)
    for normalizer in ("softmax", "softmax_sigmoid"):
        w = np.asarray(normalize(s, normalizer))
        assert (w > 0).all()
        np.testing.assert_allclose(w.sum(), 1.0, rtol=1e-5)
        order = np.argsort(scores, kind="stable")
        assert (np.diff(w[order]) >= -1e-6).all()


def test_unknown_names_are_refused() -> None:
    with pytest.raises(ValueError, match="normalizer='sparsemax'"):
        normalize(jnp.zeros(3), "sparsemax")  # type: ignore[arg-type]
    z, w = jnp.zeros((2, 1, 3)), jnp.full((1, 2), 0.5)
    with pytest.raises(ValueError, match="fusion='product'"):
        apply_weights(z, w, "product", "mean")


def test_gate_starts_at_equal_weights() -> None:
    features = jax.random.normal(jax.random.key(0), (4, 3, 5))
    gate = Gate(8, "softmax")
    weights = gate.apply(gate.init(jax.random.key(1), features), features)
    np.testing.assert_allclose(weights, np.full((3, 4), 0.25), rtol=1e-6)


def test_equal_weights_are_the_identity() -> None:
    features = jax.random.normal(jax.random.key(0), (4, 3, 5))
    joined = apply_weights(features, jnp.full((3, 4), 0.25), "concat", "mean")
    np.testing.assert_allclose(joined, features.transpose(1, 0, 2).reshape(3, -1), rtol=1e-6)
    summed = apply_weights(features, jnp.full((3, 4), 0.25), "sum", "mean")
    np.testing.assert_allclose(summed, features.mean(0), rtol=1e-5, atol=1e-6)


def test_oracle_shares_its_weight_among_the_healthy() -> None:
    failed = jnp.asarray([[True, False, False, True], [True, True, True, True]])
    np.testing.assert_array_equal(
        oracle_weights(failed), [[0.0, 0.5, 0.5, 0.0], [0.0, 0.0, 0.0, 0.0]]
    )


def test_modality_dropout_drops_whole_sensors_never_all() -> None:
    features = jnp.ones((3, 4000, 2))
    dropped = np.asarray(drop_modalities(features, 0.6, key=jax.random.key(0)))
    kept = dropped[:, :, 0] > 0
    assert kept.any(axis=0).all()
    np.testing.assert_array_equal(dropped[:, :, 0], dropped[:, :, 1])
    np.testing.assert_allclose(dropped.sum(axis=0), 3.0, rtol=1e-6)
    # 0.4 kept, plus the third of 0.216 all-dropped examples that is given back.
    np.testing.assert_allclose(kept.mean(), 0.4 + 0.6**3 / 3, atol=0.02)


def test_embrace_takes_each_feature_from_one_available_sensor() -> None:
    features = jnp.arange(3.0)[:, None, None] * jnp.ones((3, 500, 8))
    keep = jnp.asarray([[1.0, 0.0, 1.0]]) * jnp.ones((500, 1))
    drawn = np.asarray(embrace(features, keep, key=jax.random.key(0)))
    assert set(np.unique(drawn)) == {0.0, 2.0}
    np.testing.assert_allclose(drawn.mean(), 1.0, atol=0.06)
    np.testing.assert_allclose(embrace(features, keep), 1.0)
    same = np.asarray(embrace(features, keep, key=jax.random.key(0), shared=True))
    assert set(np.unique(same)) == {0.0, 2.0} and (same == same[0]).all()
