"""Sensor failures: masks of the three protocols, readings of failed channels, refusals."""

from __future__ import annotations

import functools
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from fusion.failure_kinds import FAILURE_KINDS, apply_failure
from fusion.failures import (
    Protocol,
    corrupt,
    draw_mask,
    fixed_failing,
    generalisation,
    no_failure,
    random_failing,
)

K = 5
NAMES = ("a", "b", "c", "d", "e")
N = 240

PROTOCOL = random_failing(NAMES, n_clean=2)
ALL = jnp.ones((N, K), bool)

_mask = jax.jit(draw_mask, static_argnums=(0, 1))


def run_mask(key: jax.Array, n: int, protocol: Protocol) -> jax.Array:
    return _mask(protocol, n, key=key)


@functools.cache
def windows(t: int) -> jax.Array:
    return jax.random.uniform(jax.random.key(1), (N, K, t), minval=-1.0, maxval=1.0)


@jax.jit
def fail(key: jax.Array, x: jax.Array, mask: jax.Array) -> dict[str, tuple[jax.Array, jax.Array]]:
    """Every kind, on some channels and on all of them."""
    return {
        kind: (apply_failure(x, mask, kind, key=key), apply_failure(x, ALL, kind, key=key))
        for kind in FAILURE_KINDS
    }


@functools.cache
def failed(t: int) -> dict[str, tuple[jax.Array, jax.Array]]:
    mask = run_mask(jax.random.key(5), N, PROTOCOL)
    return fail(jax.random.key(9), windows(t), mask)


@pytest.mark.parametrize(
    ("n", "protocol"),
    [
        (16, Protocol(9, 2, 7)),
        (7, Protocol(3, 3, 3, clean_fraction=0.5)),
        (5, Protocol(4, 1, 1, clean_fraction=0.0)),
    ],
)
@given(seed=st.integers(0, 2**31 - 1))
@settings(max_examples=20, deadline=None)
def test_mask_counts(n: int, protocol: Protocol, seed: int) -> None:
    """The clean share is exact, and each other example has low..high failed channels."""
    counts = np.asarray(run_mask(jax.random.key(seed), n, protocol)).sum(axis=1)
    assert (counts == 0).sum() == round(protocol.clean_fraction * n)
    assert ((counts == 0) | ((counts >= protocol.low) & (counts <= protocol.high))).all()


def test_fixed_and_empty_protocols() -> None:
    mask = np.asarray(run_mask(jax.random.key(0), N, fixed_failing(NAMES, ("d", "b"))))
    assert np.unique(mask.any(axis=1).sum()) == 160
    assert (mask[mask.any(axis=1)] == [False, True, False, True, False]).all()
    assert not np.asarray(run_mask(jax.random.key(0), N, no_failure(NAMES))).any()


def test_every_failing_set_and_every_count_is_equally_likely() -> None:
    """Chi-square over the 10 sets of three of five channels, and over counts 1..4."""
    mask = np.asarray(run_mask(jax.random.key(2), 9000, random_failing(NAMES, n_clean=2)))
    corrupted = mask[mask.any(axis=1)]
    codes = corrupted @ (1 << np.arange(K))
    _, counts = np.unique(codes, return_counts=True)
    assert counts.size == math.comb(5, 3) and counts.sum() == 6000
    assert stats.chisquare(counts).pvalue > 1e-3
    train, test = generalisation(NAMES, (1, 2), (1, 4))
    assert (train.low, train.high, test.low, test.high) == (1, 2, 1, 4)
    failed = np.asarray(run_mask(jax.random.key(3), 9000, test)).sum(axis=1)
    assert stats.chisquare(np.bincount(failed)[1:]).pvalue > 1e-3
    # Clean examples sit at random places: as many in the first half as chance allows.
    assert abs((failed[:4500] == 0).sum() - 1500) < 4 * (9000 * 1 / 3 * 2 / 3 / 4) ** 0.5


@pytest.mark.parametrize("t", [1, 32])
@pytest.mark.parametrize("kind", FAILURE_KINDS)
def test_only_failed_channels_change(kind: str, t: int) -> None:
    x = windows(t)
    y, full = failed(t)[kind]
    mask = np.asarray(run_mask(jax.random.key(5), N, PROTOCOL))
    assert y.shape == x.shape and y.dtype == x.dtype
    same = np.asarray((y == x).all(axis=2))
    assert same[~mask].all()
    np.testing.assert_array_equal(np.asarray(y)[mask], np.asarray(full)[mask])
    assert np.isfinite(np.asarray(y)).all()
    changed = 1.0 - same[mask].mean()
    # A burst misses a lone sample half of the time; the other kinds nearly always show.
    assert changed > (0.35 if kind == "dropout" and t == 1 else 0.85)


def test_the_mask_depends_on_the_key_and_not_on_the_kind() -> None:
    run, key = jax.jit(corrupt, static_argnums=(0, 2)), jax.random.key(5)
    x = windows(1)
    y, mask = run(PROTOCOL, x, "uniform", key=key)
    zero, same = run(PROTOCOL, x, "zero", key=key)
    np.testing.assert_array_equal(mask, same)
    np.testing.assert_array_equal(zero[:, :, 0] == 0.0, mask)
    other, moved = run(PROTOCOL, x, "uniform", key=jax.random.key(6))
    assert not np.array_equal(mask, moved) and not np.array_equal(y, other)
    np.testing.assert_array_equal(run(PROTOCOL, x, "uniform", key=key)[0], y)


def failed_all(kind: str, t: int) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(windows(t), np.float64), np.asarray(failed(t)[kind][1], np.float64)


def test_noise_has_the_distribution_of_the_source() -> None:
    for kind, cdf in (("uniform", stats.uniform(-1.0, 2.0).cdf), ("gaussian", stats.norm.cdf)):
        x, y = failed_all(kind, 32)
        assert stats.kstest(y.ravel(), cdf).pvalue > 1e-3
        assert abs(np.corrcoef(x.ravel(), y.ravel())[0, 1]) < 0.02
        assert abs(np.corrcoef(y[:, 0].ravel(), y[:, 1].ravel())[0, 1]) < 0.05


def test_stuck_repeats_the_last_reading() -> None:
    x, y = failed_all("stuck", 32)
    held = y[:, :, -1:]
    frozen = np.argmax(x == held, axis=2)  # first time at which the last value was read
    before = np.arange(32) <= frozen[:, :, None]
    np.testing.assert_array_equal(y, np.where(before, x, held))
    assert stats.chisquare(np.bincount(frozen.ravel(), minlength=32)).pvalue > 1e-3
    x, y = failed_all("stuck", 1)
    for k in range(K):
        np.testing.assert_array_equal(np.sort(y[:, k, 0]), np.sort(x[:, k, 0]))
        assert (x[:, k] != y[:, k]).all()


def test_drift_is_a_ramp_after_its_onset() -> None:
    x, y = failed_all("drift", 32)
    offset = (y - x) * np.sign((y - x)[:, :, -1:])
    slope = np.diff(offset, axis=2)
    assert (slope > -1e-6).all() and (np.diff(slope, axis=2)[:, :, :-1] > -1e-5)[
        :, :, 1:
    ].mean() > 0.9
    steepest = slope[offset[:, :, 0] > 0].mean(axis=1) * 32
    assert ((steepest > 0.5 - 1e-4) & (steepest < 2.0 + 1e-4)).all()
    assert 0.4 < ((y - x)[:, :, -1] > 0).mean() < 0.6
    x, y = failed_all("drift", 1)
    assert (np.abs(y - x) < 2.0).all() and np.abs(y - x).mean() == pytest.approx(0.625, abs=0.1)


def test_dropout_loses_half_of_the_samples_in_bursts() -> None:
    for t in (1, 32):
        x, y = failed_all("dropout", t)
        lost = y == 0.0
        np.testing.assert_array_equal(y[~lost], x[~lost])
        assert lost.mean() == pytest.approx(1.0 - 0.8**3, abs=0.04)
    starts = (lost & ~np.roll(lost, 1, axis=2)).sum(axis=2)
    assert starts.max() <= 3


def test_gain_and_clip() -> None:
    x, y = failed_all("gain", 32)
    factor = (y / x).mean(axis=2, keepdims=True)
    np.testing.assert_allclose(y, factor * x, rtol=1e-5)
    size = np.exp(np.abs(np.log(factor)))
    assert size.min() > 2.0 - 1e-4 and size.max() < 4.0 + 1e-4 and 0.4 < (factor > 1).mean() < 0.6
    x, y = failed_all("clip", 32)
    rail = np.abs(y).max(axis=2, keepdims=True)
    np.testing.assert_array_equal(y, np.clip(x, -rail, rail))
    assert rail.max() < 0.2


@pytest.mark.parametrize("kind", ["drift", "gaussian"])
def test_severity_is_the_way_from_clean_to_failed(kind: str) -> None:
    x, key = windows(32), jax.random.key(9)
    run = jax.jit(lambda s: apply_failure(x, ALL, kind, key=key, severity=s))
    full = np.asarray(failed(32)[kind][1])
    np.testing.assert_array_equal(run(jnp.float32(0.0)), x)
    np.testing.assert_allclose(run(jnp.float32(1.0)), full, atol=1e-6)
    np.testing.assert_allclose(run(jnp.float32(0.25)), 0.75 * x + 0.25 * full, atol=1e-6)


def test_one_trace_and_vmap_equals_loop() -> None:
    x, protocol = windows(1)[:12], random_failing(NAMES, n_clean=1)
    keys = jax.random.split(jax.random.key(0), 3)

    @chex.assert_max_traces(n=1)
    def step(key: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        return corrupt(protocol, x, "uniform", key=key)

    one = jax.jit(step)
    loop = [one(key, x) for key in keys]
    many = jax.jit(jax.vmap(lambda key: corrupt(protocol, x, "uniform", key=key)))(keys)
    np.testing.assert_array_equal(many[0], np.stack([y for y, _ in loop]))
    np.testing.assert_array_equal(many[1], np.stack([m for _, m in loop]))
    assert hash(protocol) == hash(random_failing(NAMES, n_clean=1))


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: random_failing(NAMES, 5), r"n_clean=5: expected a whole number 0..4.*no_failure"),
        (lambda: random_failing(NAMES, -1), r"n_clean=-1"),
        (lambda: random_failing(NAMES, 1, clean_fraction=1.2), r"clean_fraction=1.2"),
        (lambda: fixed_failing(NAMES, ["a", "x"]), r"failing='x': expected one of 'a', 'b'"),
        (lambda: fixed_failing(NAMES, []), r"expected one or more of"),
        (lambda: fixed_failing(NAMES, ["a", "a"]), r"expected different channels"),
        (
            lambda: generalisation(NAMES, (1, 2), (3, 6)),
            r"test\[1\]=6: expected a whole number 3..5",
        ),
        (lambda: generalisation(NAMES, (0, 2), (3, 5)), r"train\[0\]=0"),
        (lambda: Protocol(0, 0, 0), r"n_channels=0"),
        (lambda: Protocol(3, 2, 1), r"high=1: expected a whole number 2..3"),
        (lambda: Protocol(3, 1, 1, (3,)), r"failing\[0\]=3: expected a whole number 0..2"),
        (lambda: Protocol(3, 1, 2, (0, 1)), r"use fixed_failing"),
        (
            lambda: corrupt(no_failure("abc"), windows(1), "zero", key=jax.random.key(0)),
            r"x.shape=\(240, 5, 1\): expected \[N, 3, T\]",
        ),
        (
            lambda: corrupt(no_failure(NAMES), windows(1), "noise", key=jax.random.key(0)),
            r"kind='noise': expected one of 'uniform', 'gaussian'",
        ),
    ],
)
def test_bad_input_is_refused_before_anything_is_compiled(make, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        make()


def test_a_mixture_gives_every_example_one_of_its_kinds() -> None:
    """Clean readings are 0.5, which neither kind gives."""
    x = jnp.full((60, 2, 4), 0.5)
    failed = jnp.ones((60, 2), bool)
    key = jax.random.key(0)
    mixed = np.asarray(apply_failure(x, failed, ("zero", "gain"), key=key))
    zero = (mixed == 0.0).all(axis=(1, 2))
    assert 15 < zero.sum() < 45
    assert ((mixed[~zero] != 0.0) & (mixed[~zero] != 0.5)).all()
    for kinds in ((), ("zero", "zero"), ("zero", "sticky")):
        with pytest.raises(ValueError, match="kind="):
            apply_failure(x, failed, kinds, key=key)
