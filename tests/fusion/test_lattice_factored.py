"""Factored lattices and CDF layers: formulas by numpy, nearest points, no violation ever."""

from __future__ import annotations

import doctest
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.lattice import cdf, kronecker, with_projection
from fusion.lattice.cdf import CDFConfig, CDFParams
from fusion.lattice.kronecker import KroneckerConfig, KroneckerParams

MIXED = KroneckerConfig(3, size=3, n_terms=4, monotonicity=(1, -1, 0))
BOUNDED = KroneckerConfig(3, size=3, n_terms=3, monotonicity=(1, -1, 0), output_range=(-1.0, 2.0))


def random_kernel(config: KroneckerConfig, seed: int, dtype: Any = jnp.float32) -> KroneckerParams:
    shape = config.n_terms, config.n_inputs, config.size
    values = 0.6 + np.random.default_rng(seed).normal(size=shape)
    return KroneckerParams(jnp.asarray(values, dtype), jnp.asarray(0.25, dtype))


def table(config: KroneckerConfig, params: KroneckerParams) -> np.ndarray:
    """The table that the layer factors, by outer products."""
    kernel = np.asarray(params.kernel, np.float64)
    products = []
    for term in kernel:
        whole = term[0]
        for curve in term[1:]:
            whole = np.multiply.outer(whole, curve)
        products.append(whole)
    low, high = config.output_range
    signed = [(-1) ** m * p for m, p in enumerate(products)]
    if low is None or high is None:
        return float(params.bias) + np.sum(signed, axis=0)
    shares = [p if m % 2 == 0 else 1 - p for m, p in enumerate(products)]
    return low + (high - low) * np.mean(shares, axis=0)


def interpolated(whole: np.ndarray, x: np.ndarray) -> float:
    """Multilinear interpolation, corner by corner."""
    base = np.minimum(x.astype(int), np.array(whole.shape) - 2)
    total = 0.0
    for corner in itertools.product((0, 1), repeat=x.size):
        weight = np.prod([1 - abs(x[d] - base[d] - c) for d, c in enumerate(corner)])
        total += weight * whole[tuple(base + corner)]
    return float(total)


@pytest.mark.parametrize("config", [MIXED, BOUNDED])
def test_a_factored_lattice_is_the_lattice_of_its_table(config: KroneckerConfig) -> None:
    params = kronecker.project(config, random_kernel(config, 0))
    x = np.random.default_rng(1).uniform(0, 2, (20, 3)).astype(np.float32)
    whole = table(config, params)
    found = kronecker.apply(config, params, jnp.asarray(x))
    np.testing.assert_allclose(found, [interpolated(whole, row) for row in x], atol=1e-5)
    # Outside of the lattice inputs are clipped.
    ends = kronecker.apply(config, params, jnp.array([[-3.0, 9.0, 0.0]]))
    np.testing.assert_allclose(ends, [whole[0, 2, 0]], atol=1e-5)


def test_the_projection_is_the_nearest_point() -> None:
    optimize = pytest.importorskip("scipy.optimize")
    params = random_kernel(BOUNDED, 3)
    found = np.asarray(kronecker.project(BOUNDED, params).kernel)
    for m, d in itertools.product(range(3), range(3)):
        curve, sign = np.asarray(params.kernel[m, d], np.float64), (-1) ** m * (1, -1, 0)[d]
        order = [{"type": "ineq", "fun": lambda z, i=i: z[i + 1] - z[i]} for i in range(2)]
        nearest = optimize.minimize(
            lambda z, goal=curve * (sign or 1): ((z - goal) ** 2).sum(),
            np.zeros(3),
            bounds=[(0, 1) if (sign or 1) > 0 else (-1, 0)] * 3,
            constraints=order if sign else [],
            options={"ftol": 1e-12},
        )
        np.testing.assert_allclose(found[m, d], nearest.x * (sign or 1), atol=1e-5)


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    signs=st.tuples(*[st.sampled_from((-1, 0, 1))] * 3),
    bounded=st.booleans(),
)
def test_projected_layers_never_violate_order_or_bounds(
    seed: int, signs: tuple[int, ...], bounded: bool
) -> None:
    given_range = (-1.0, 2.0) if bounded else (None, None)
    config = KroneckerConfig(3, 3, 4, signs, given_range)
    params = kronecker.project(config, random_kernel(config, seed))
    assert float(kronecker.check(config, params)) == 0.0
    whole = table(config, params)
    for d, sign in enumerate(signs):
        assert (sign * np.diff(whole, axis=d)).min(initial=0.0) >= -1e-12 * np.abs(whole).max()
    if bounded:
        assert whole.min() >= -1.0 - 1e-12 and whole.max() <= 2.0 + 1e-12


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
@pytest.mark.parametrize("config", [MIXED, BOUNDED])
@pytest.mark.relaxed
def test_no_violation_is_left_after_an_optimizers_update(
    config: KroneckerConfig, dtype: Any
) -> None:
    params = kronecker.project(config, random_kernel(config, 5, dtype))
    optimizer = with_projection(optax.sgd(0.3), lambda p: kronecker.project(config, p))
    state = optimizer.init(params)
    for seed in range(5):
        slopes = jax.tree.map(lambda p, s=seed: p + jnp.asarray(s, dtype) - 2, params)
        updates, state = optimizer.update(slopes, state, params)
        params = optax.apply_updates(params, updates)
        assert float(kronecker.check(config, params)) == 0.0


def test_a_violation_is_measured() -> None:
    params = kronecker.init(jax.random.key(0), BOUNDED)
    assert float(kronecker.check(BOUNDED, params)) == 0.0
    worse = params._replace(kernel=params.kernel.at[0, 0].set(jnp.array([0.75, 0.25, 0.5])))
    assert float(kronecker.check(BOUNDED, worse)) == pytest.approx(0.5)
    worse = params._replace(kernel=params.kernel.at[1, 2, 0].set(1.25))
    assert float(kronecker.check(BOUNDED, worse)) == pytest.approx(0.25)


def test_twenty_monotone_inputs_start_apart_and_rise() -> None:
    config = KroneckerConfig(20, n_terms=6, monotonicity=(1,) * 20)
    params = kronecker.init(jax.random.key(1), config)
    assert sum(leaf.size for leaf in params) == config.n_parameters == 241
    ends = kronecker.apply(config, params, jnp.stack([jnp.zeros(20), jnp.ones(20)]))
    assert ends[1] - ends[0] > 0.5
    grads = jax.grad(lambda p: kronecker.apply(config, p, jnp.full(20, 0.5)))(params)
    assert bool(jnp.all(jnp.abs(grads.kernel) > 1e-3))


@pytest.mark.parametrize("activation", ["relu6", "sigmoid"])
@pytest.mark.parametrize("reduction", ["mean", "geometric_mean"])
def test_a_cdf_layer_is_its_formula_and_monotone(activation: Any, reduction: Any) -> None:
    config = CDFConfig(3, 2, 5, (1, -1, 1), activation, reduction)
    params = cdf.init(jax.random.key(0), config)
    x = np.random.default_rng(0).uniform(-0.5, 1.5, (30, 3)).astype(np.float32)
    found = np.asarray(cdf.apply(config, params, jnp.asarray(x)))
    keypoints, scaling = (np.asarray(a, np.float64) for a in params)
    for n, o in itertools.product(range(30), range(2)):
        curves = []
        for d, sign in enumerate((1, -1, 1)):
            u = scaling[o, d] * sign * (x[n, d] - keypoints[o, d])
            steps = 1 / (1 + np.exp(-u)) if activation == "sigmoid" else np.clip(u + 0.5, 0, 1)
            curves.append(steps.mean())
        wanted = np.mean(curves) if reduction == "mean" else np.prod(curves) ** (1 / 3)
        assert found[n, o] == pytest.approx(wanted, abs=2e-5)
    for d, sign in enumerate((1, -1, 1)):
        moved = x.copy()
        moved[:, d] += 0.1
        step = sign * (np.asarray(cdf.apply(config, params, jnp.asarray(moved))) - found)
        assert step.min() >= -1e-6 and step.max() > 1e-3


def test_slopes_of_a_geometric_mean_stay_finite_where_a_curve_is_zero() -> None:
    config = CDFConfig(2, n_keypoints=3, reduction="geometric_mean")
    params = cdf.init(jax.random.key(0), config)
    x = jnp.array([[-5.0, 0.5], [0.5, 0.5]])
    grads = jax.grad(lambda p: cdf.apply(config, p, x).sum())(params)
    assert all(bool(jnp.isfinite(g).all()) for g in grads)
    assert float(cdf.apply(config, params, x)[0, 0]) == 0.0


def test_negative_scalings_are_a_violation_that_the_projection_takes_away() -> None:
    config = CDFConfig(2)
    params = CDFParams(jnp.zeros((1, 2, 10)), jnp.array([[-0.5, 2.0]]))
    assert float(cdf.check(config, params)) == 0.5
    moved = cdf.project(config, params)
    assert moved.scaling.tolist() == [[0.0, 2.0]] and float(cdf.check(config, moved)) == 0.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: KroneckerConfig(2, output_range=(0.0, None)), "two bounds or none"),
        (lambda: KroneckerConfig(2, size=1), "size=1: expected 2 or more"),
        (lambda: KroneckerConfig(2, monotonicity=(1,)), "for each of 2 inputs"),
        (lambda: CDFConfig(2, monotonicity=(1, 0)), "expected -1 or 1 for each input"),
        (lambda: CDFConfig(2, activation="relu"), "activation='relu'"),
        (lambda: CDFConfig(2, reduction="sum"), "reduction='sum'"),
    ],
)
def test_what_means_nothing_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("module", [kronecker, cdf])
def test_examples_run(module: Any) -> None:
    assert doctest.testmod(module).failed == 0
