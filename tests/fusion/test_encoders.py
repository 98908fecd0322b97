"""Encoders: two convolution backends, against scipy; features that separate noise from signal."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.encoders import (
    EncoderConfig,
    encoder,
    reading_levels,
)
from fusion.spectrum import spectral_features
from fusion.stacked import conv1d


def _draw(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@settings(max_examples=15, deadline=None)
@given(
    st.integers(1, 3), st.integers(1, 3), st.integers(1, 4), st.integers(1, 3), st.integers(8, 20)
)
def test_conv1d_equals_numpy_correlation(k: int, c: int, w: int, stride: int, t: int) -> None:
    x, kernel, bias = _draw(1, k, 2, t, c), _draw(2, k, w, c, 4), _draw(3, k, 4)
    n = (t - w) // stride + 1
    expected = np.zeros((k, 2, n, 4))
    for i in range(n):
        window = x[:, :, i * stride : i * stride + w].astype(np.float64)
        expected[:, :, i] = np.einsum("kbwc,kwcf->kbf", window, kernel) + bias[:, None]
    for backend in ("matmul", "conv"):
        y = conv1d(*map(jnp.asarray, (x, kernel, bias)), stride=stride, backend=backend)
        np.testing.assert_allclose(y, expected, rtol=1e-4, atol=1e-4)


def test_conv1d_gradients_agree_between_backends() -> None:
    arrays = tuple(map(jnp.asarray, (_draw(1, 2, 3, 16, 2), _draw(2, 2, 5, 2, 4), _draw(3, 2, 4))))

    def energy(kernel: jax.Array, backend: str) -> jax.Array:
        return jnp.sum(conv1d(arrays[0], kernel, arrays[2], stride=2, backend=backend) ** 2)

    gradients = [jax.grad(energy)(arrays[1], backend) for backend in ("matmul", "conv")]
    np.testing.assert_allclose(*gradients, rtol=1e-4)


def test_short_series_is_refused_with_the_length_it_needs() -> None:
    with pytest.raises(ValueError, match="n_times=10: expected at least 24 samples"):
        encoder(EncoderConfig(), 10, "encoder")
    with pytest.raises(ValueError, match="backend='fft'"):
        EncoderConfig(backend="fft")  # type: ignore[arg-type]


def test_spectrum_of_a_sine_peaks_at_its_frequency() -> None:
    t = np.arange(128)
    x = np.sin(2 * np.pi * 10 * t / 128)[None, None].astype(np.float32)
    features = np.asarray(spectral_features(jnp.asarray(x)))[0, 0]
    assert np.argmax(features[:64]) == 9  # bins start at one cycle per window
    np.testing.assert_allclose(features[65], 0.0, atol=1e-5)  # three times the mean


def test_novelty_is_low_on_known_readings_and_high_between_them() -> None:
    known = np.repeat(np.linspace(-1, 1, 9, dtype=np.float32), 3)[:, None, None]
    config = EncoderConfig(features=4, levels=reading_levels(known))
    assert len(config.levels[0]) == 9
    from fusion.encoders import _novelty

    x = jnp.asarray([[[-1.0], [0.25], [0.3], [3.0]]])
    novelty = np.asarray(_novelty(x, config.levels))[0, :, 0]
    assert novelty[0] == novelty[1] < novelty[2] < novelty[3]


@pytest.mark.parametrize("n_times", [1, 64])
def test_encoders_trace_once_and_keep_branches_apart(n_times: int) -> None:
    chex.clear_trace_counter()
    module = encoder(EncoderConfig(features=4, conv_features=(2, 2)), n_times, "encoder")
    x = jnp.asarray(_draw(0, 3, 5, n_times))
    params = module.init(jax.random.key(0), x)

    @jax.jit
    @chex.assert_max_traces(n=1)
    def apply(x: jax.Array) -> jax.Array:
        return module.apply(params, x)

    features = apply(x)
    assert features.shape == (3, 5, 4)
    changed = apply(x.at[1].add(0.5))
    np.testing.assert_array_equal(features[0], changed[0])
    np.testing.assert_array_equal(features[2], changed[2])
    assert not np.array_equal(features[1], changed[1])
