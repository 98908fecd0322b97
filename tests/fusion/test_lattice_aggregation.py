"""Functions of sets: equal to a loop over the items, blind to order and padding, in shape."""

from __future__ import annotations

import dataclasses
import doctest
import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx

from fusion.lattice import (
    Feature,
    aggregation,
    check_tree,
    lattice_layer,
    linen,
    premade,
    pwl,
    with_projection,
)
from fusion.lattice import nnx as lattice_nnx
from fusion.lattice.aggregation import AggregationConfig
from fusion.lattice.nnx import check_model
from fusion.lattice.premade import CalibratedConfig
from fusion.lattice.ragged import padded, segment_mean
from tests.fusion._lattice_steps import violations

FEATURES = (Feature("stars", 1, keypoints=(0.0, 0.5, 1.0)), Feature("kind", n_categories=3))
CONFIG = AggregationConfig(
    CalibratedConfig(FEATURES, n_output_keypoints=3), n_functions=2, lattice_size=3,
    n_output_keypoints=4, output_range=(0.0, 5.0),
)  # fmt: skip
SIZES = (3, 1, 0, 5)


def _moved(params: Any, dtype: Any = jnp.float32) -> Any:
    """Feasible parameters far from the first ones."""
    leaves, tree = jax.tree.flatten(params)
    rng = np.random.default_rng(1)
    drawn = [leaf + 0.2 * rng.normal(size=leaf.shape) for leaf in leaves]
    return aggregation.project(
        CONFIG, jax.tree.unflatten(tree, [jnp.asarray(a, dtype) for a in drawn])
    )


@pytest.fixture(scope="module")
def params() -> Any:
    return jax.jit(_moved)(aggregation.init(jax.random.key(0), CONFIG))


@pytest.fixture(scope="module")
def items() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [
        np.column_stack([rng.uniform(size=n), rng.integers(0, 3, n)]).astype(np.float32)
        for n in SIZES
    ]


def _by_loop(params: Any, items: list[np.ndarray]) -> np.ndarray:
    """Item by item, example by example, with the parts of the model."""
    read = jax.jit(lambda p, x: premade.apply(CONFIG.reader, p, x))
    found = []
    for example in items:
        means = np.array(params.empty)
        for k in range(CONFIG.n_functions if len(example) else 0):
            own = jax.tree.map(lambda leaf, k=k: leaf[k], params.items)
            means[k] = np.mean([read(own, jnp.asarray(row)) for row in example])
        h = lattice_layer.apply(CONFIG.lattice, params.lattice, jnp.asarray(means, jnp.float32))
        found.append(float(pwl.apply(CONFIG.output, params.output, h[None])[0]))
    return np.array(found)


def test_padding_and_rows_equal_a_loop(params: Any, items: list[np.ndarray]) -> None:
    expected = _by_loop(params, items)
    assert np.ptp(expected) > 0.1
    x, mask = padded(items, 6)
    found = jax.jit(lambda x: aggregation.apply(CONFIG, params, x, mask))(x)
    np.testing.assert_allclose(found, expected, atol=2e-6)
    rows = np.concatenate([*items, [[0.4, 1.0]]]).astype(np.float32)
    ids = np.append(np.repeat(np.arange(4), SIZES), -1)
    order = np.random.default_rng(3).permutation(len(rows))
    segments = jax.jit(
        lambda x, ids: aggregation.apply_segments(CONFIG, params, x, ids, 4)
    )(jnp.asarray(rows[order]), jnp.asarray(ids[order], jnp.int32))  # fmt: skip
    np.testing.assert_allclose(segments, expected, atol=2e-6)


def test_neither_order_nor_padding_is_read(params: Any, items: list[np.ndarray]) -> None:
    x, mask = padded(items, 6)
    turn = np.random.default_rng(4).permutation(6)
    dirty = jnp.where(mask[..., None], x, jnp.full_like(x, jnp.nan))

    @jax.jit
    def of(x: jax.Array, mask: jax.Array) -> tuple[jax.Array, Any]:
        def total(p: Any) -> tuple[jax.Array, jax.Array]:
            y = aggregation.apply(CONFIG, p, x, mask)
            return jnp.sum(y), y

        slopes, y = jax.grad(total, has_aux=True)(params)
        return y, slopes

    y, slopes = of(x, mask)
    again, turned_slopes = of(dirty[:, turn], mask[:, turn])
    np.testing.assert_allclose(again, y, atol=1e-6)
    for a, b in zip(jax.tree.leaves(slopes), jax.tree.leaves(turned_slopes), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
        assert np.isfinite(a).all()


def test_the_output_rises_with_a_feature_of_any_item(params: Any, items: list[np.ndarray]) -> None:
    x, mask = padded(items, 5)
    apply = jax.jit(lambda x: aggregation.apply(CONFIG, params, x, mask))
    base, rose = np.asarray(apply(x)), []
    for item in range(5):
        better = x.at[:, item, 0].set(jnp.minimum(1.0, x[:, item, 0] + 0.3))
        rose.append(np.asarray(apply(better)) - base)
    assert np.min(rose) > -1e-6 and np.max(rose) > 0.01
    assert np.all(np.array(rose)[:, 2] == 0.0)  # the example without items


def test_means_of_rows_that_are_nowhere() -> None:
    found = segment_mean(jnp.array([[1.0], [5.0]]), jnp.array([7, -3]), 2, jnp.array([0.5]))
    assert found.tolist() == [[0.5], [0.5]]


@pytest.mark.relaxed  # flax and optax promote types
@pytest.mark.parametrize("dtype", [jnp.float32, pytest.param(jnp.bfloat16, marks=pytest.mark.slow)])
def test_no_violation_after_large_steps(dtype: Any, items: list[np.ndarray]) -> None:
    model = linen.Aggregation(CONFIG, param_dtype=dtype)
    x, mask = padded(items)
    params = jax.jit(model.init)(jax.random.key(0), x.astype(dtype), mask)["params"]
    optimizer = with_projection(optax.adam(0.4))
    assert float(check_tree(params)) == 0.0
    assert violations(params, optimizer, 10).max() == 0.0


@pytest.mark.slow
@pytest.mark.relaxed
def test_modules_equal_the_functions(items: list[np.ndarray]) -> None:
    x, mask = padded(items)
    rows = jnp.asarray(np.concatenate(items))
    ids = jnp.asarray(np.repeat(np.arange(4), SIZES), jnp.int32)
    module = linen.Aggregation(CONFIG)
    found, variables = jax.jit(module.init_with_output)(jax.random.key(3), x, mask)
    node = variables["params"]["layer"]
    expected = jax.jit(lambda p: aggregation.apply(CONFIG, p, x, mask))(node.value)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    by_rows = module.apply(variables, rows, segment_ids=ids, n_examples=4)
    np.testing.assert_allclose(by_rows, expected, atol=2e-6)
    twin = lattice_nnx.Aggregation(CONFIG, rngs=nnx.Rngs(3))
    expected = aggregation.apply(CONFIG, twin.params, x, mask)
    np.testing.assert_allclose(twin(x, mask), expected, atol=1e-6)
    assert jax.tree.structure(twin.params) == jax.tree.structure(node.value)
    broken = jax.tree.map(lambda a: -a, nnx.to_pure_dict(nnx.state(twin, nnx.Param)))
    nnx.update(twin, lattice_nnx.projection(twin)(broken))
    assert float(check_tree(variables)) == float(check_model(twin)) == 0.0


def test_what_means_nothing_is_refused(params: Any) -> None:
    x = jnp.zeros((2, 3, 2))
    with pytest.raises(ValueError, match=r"mask\.shape=\(2, 3, 2\): expected \(2, 3\), one .*; le"):
        aggregation.apply(CONFIG, params, x, jnp.ones((2, 3, 2), bool))
    with pytest.raises(ValueError, match=r"expected \[\.\.\., 2\]"):
        aggregation.apply(CONFIG, params, x[..., :1], jnp.ones((2, 3), bool))
    with pytest.raises(ValueError, match=r"segment_ids\.shape=\(4,\): expected \[n_rows\]"):
        aggregation.apply_segments(CONFIG, params, x[0], jnp.zeros(4, jnp.int32), 2)
    with pytest.raises(ValueError, match=r"arguments=\('segment_ids',\): expected mask, or segm"):
        aggregation.apply_either(CONFIG, params, x[0], None, jnp.zeros(3, jnp.int32), None)
    bounded = dataclasses.replace(CONFIG.item, output_range=(0.0, 1.0))
    for change, message in (
        ({"item": bounded}, r"item\.output_range=\(0\.0, 1\.0\): expected \(None, None\)"),
        ({"n_functions": 0}, "n_functions=0: expected 1 or more"),
        ({"n_functions": 30}, "n_functions=30: expected at most 2"),
        ({"lattice_size": 1}, "lattice_size=1: expected 2 or more"),
    ):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(CONFIG, **change)
    with pytest.raises(ValueError, match=r"items=\[\(1, 2\), \(1, 3\)\]: expected arrays"):
        padded([np.zeros((1, 2)), np.zeros((1, 3))])
    with pytest.raises(ValueError, match="n_items=1: expected 2 or more"):
        padded([np.zeros((2, 2))], 1)


@pytest.mark.parametrize("name", ["aggregation", "ragged"])
def test_examples_in_docstrings(name: str) -> None:
    result = doctest.testmod(importlib.import_module(f"fusion.lattice.{name}"))
    assert result.failed == 0 and result.attempted > 0
