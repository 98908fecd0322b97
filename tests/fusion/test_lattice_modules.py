"""Flax modules of lattices: same numbers as the functions, projected wherever optax sees them."""

from __future__ import annotations

import doctest
import importlib
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import nnx, serialization

from fusion.lattice import (
    CategoricalConfig,
    DeepLatticeConfig,
    EnsembleConfig,
    LatticeConfig,
    LinearConfig,
    PWLConfig,
    check_tree,
    linen,
    project_tree,
    with_projection,
)
from fusion.lattice import nnx as lattice_nnx
from fusion.lattice.cdf import CDFConfig
from fusion.lattice.kronecker import KroneckerConfig
from fusion.lattice.nnx import check_model
from fusion.lattice.tagged import Tagged, layer_of, tag

pytestmark = pytest.mark.relaxed  # flax and optax promote types

CURVES = PWLConfig(3, 5, monotonicity=1, output_range=(0.0, 1.0))
TABLE = LatticeConfig((3, 2), (1, 1))
X = jax.random.normal(jax.random.key(1), (8, 3))
Y = jnp.sum(X, axis=1)

LAYERS: dict[str, tuple[Any, jax.Array]] = {
    "PWLCalibration": (CURVES, X),
    "CategoricalCalibration": (CategoricalConfig(4, ((0, 1), (1, 3))), jnp.arange(4)),
    "Linear": (LinearConfig(3, 2, (1, 0, -1), normalized=True), X),
    "Lattice": (LatticeConfig((3, 2, 2), (1, 0, -1)), X),
    "Ensemble": (EnsembleConfig(3, ((0, 1), (1, 2)), monotonicity=(1, 0, 0)), X),
    "KroneckerLattice": (KroneckerConfig(3, monotonicity=(1, 0, -1)), X),
    "CDF": (CDFConfig(3, 2, 4), X),
    "DeepLattice": (DeepLatticeConfig(3, (1, 0, 0), n_keypoints=3, n_hidden_keypoints=3), X),
}


class Mixed(nn.Module):
    """Calibrators, a free layer, three lattices under `nn.vmap`."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        h = nn.Dense(2)(linen.PWLCalibration(CURVES)(x))
        tables = nn.vmap(
            linen.Lattice, variable_axes={"params": 0}, split_rngs={"params": True},
            in_axes=None, axis_size=3,
        )  # fmt: skip
        return jnp.mean(tables(TABLE)(nn.sigmoid(h)), axis=0)


@pytest.fixture(scope="module")
def variables() -> Any:
    return jax.jit(Mixed().init)(jax.random.PRNGKey(0), X)


def _worst(optimizer: Any, params: Any, steps: int = 4) -> np.ndarray:
    """`check_tree` after each of some large steps."""

    def loss(p: Any) -> jax.Array:
        return 5.0 * jnp.mean((Mixed().apply({"params": p}, X) - Y) ** 2)

    def step(carry: Any, _: None) -> Any:
        params, state = carry
        updates, state = optimizer.update(jax.grad(loss)(params), state, params)
        params = optax.apply_updates(params, updates)
        return (params, state), check_tree(params)

    @jax.jit
    def run(params: Any) -> Any:
        return jax.lax.scan(step, (params, optimizer.init(params)), None, length=steps)[1]

    return np.asarray(run(params))


def _group(params: Any) -> Any:
    return jax.tree_util.tree_map_with_path(
        lambda path, _: "free" if "Dense" in str(path) else "bound", params
    )


def _bound(params: Any) -> Any:
    return jax.tree.map(lambda group: group == "bound", _group(params))


OPTIMIZERS: dict[str, Callable[[], Any]] = {
    "alone": lambda: with_projection(optax.adam(0.5)),
    "chain": lambda: optax.chain(
        optax.clip_by_global_norm(1.0), optax.add_decayed_weights(1e-2),
        with_projection(optax.sgd(0.5, momentum=0.9)),
    ),
    "multi_steps": lambda: optax.MultiSteps(with_projection(optax.adam(0.5)), 2),
    "partition": lambda: optax.partition(
        {"free": optax.sgd(0.1), "bound": with_projection(optax.adam(0.5))}, _group
    ),
    "masked": lambda: optax.masked(with_projection(optax.adam(0.5)), _bound),
}  # fmt: skip


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_layers_are_found_and_projected_inside(name: str, variables: Any) -> None:
    assert _worst(OPTIMIZERS[name](), variables["params"]).max() == 0.0


def test_without_projection_they_are_violated(variables: Any) -> None:
    assert _worst(optax.adam(0.5), variables["params"]).min() > 0.1


def test_a_mask_through_a_layer_is_refused(variables: Any) -> None:
    config = PWLConfig(1, 3, monotonicity=1, missing_value=-1.0)
    params = {"layer": tag(config, layer_of(config).init(jax.random.key(0), config))}
    half = jax.tree_util.tree_map_with_path(lambda path, _: "missing" in str(path), params)
    optimizer = optax.masked(with_projection(optax.sgd(0.1)), half)
    with pytest.raises(ValueError, match="all or nothing"):
        optimizer.update(params, optimizer.init(params), params)


def test_a_tree_without_tags_is_refused(variables: Any) -> None:
    for function in (project_tree, check_tree):
        with pytest.raises(ValueError, match="a tree with a tagged layer"):
            function(nn.unbox(variables["params"]))
    with pytest.raises(TypeError, match="expected one of PWLConfig"):
        tag("PWL", {})


@pytest.mark.parametrize("name", LAYERS)
def test_modules_equal_the_functions(name: str) -> None:
    config, x = LAYERS[name]
    functions = layer_of(config)
    module = getattr(linen, name)(config)
    found, variables = jax.jit(module.init_with_output)(jax.random.PRNGKey(3), x)
    node = variables["params"]["layer"]
    assert isinstance(node, Tagged) and node.config == config
    expected = jax.jit(lambda p: functions.apply(config, p, x))(node.value)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    twin = getattr(lattice_nnx, name)(config, rngs=nnx.Rngs(3))
    assert jax.tree.structure(twin.params) == jax.tree.structure(node.value)
    expected = jax.jit(lambda p: functions.apply(config, p, x))(twin.params)
    np.testing.assert_allclose(twin(x), expected, atol=1e-6)
    assert float(check_tree(variables)) == float(check_model(twin)) == 0.0


def test_tags_survive_saving_and_loading(variables: Any) -> None:
    stored = serialization.to_bytes(variables["params"])
    blank = jax.tree.map(jnp.zeros_like, variables["params"])
    loaded = jax.tree.map(jnp.asarray, serialization.from_bytes(blank, stored))
    jax.tree.map(np.testing.assert_array_equal, loaded, variables["params"])
    assert float(check_tree(project_tree(loaded))) == 0.0


def test_half_precision_modules_stay_feasible() -> None:
    module = linen.PWLCalibration(CURVES, param_dtype=jnp.bfloat16)
    variables = module.init(jax.random.key(0), X.astype(jnp.bfloat16))
    assert all(leaf.dtype == jnp.bfloat16 for leaf in jax.tree.leaves(variables))
    noise = jax.tree.map(
        lambda a: jax.random.normal(jax.random.key(2), a.shape, a.dtype), variables
    )
    optimizer = with_projection(optax.sgd(1.0))
    updates, _ = optimizer.update(noise, optimizer.init(variables), variables)
    moved = optax.apply_updates(variables, updates)
    assert all(leaf.dtype == jnp.bfloat16 for leaf in jax.tree.leaves(moved))
    assert float(check_tree(moved)) == 0.0


class Twin(nnx.Module):
    """The same kinds of layers in nnx."""

    def __init__(self, rngs: nnx.Rngs) -> None:
        self.curves = lattice_nnx.PWLCalibration(CURVES, rngs=rngs)
        self.free = nnx.Linear(3, 2, rngs=rngs)
        self.tables = nnx.List([lattice_nnx.Lattice(TABLE, rngs=rngs) for _ in range(2)])

    def __call__(self, x: jax.Array) -> jax.Array:
        h = nnx.sigmoid(self.free(self.curves(x)))
        return sum(table(h) for table in self.tables)


@pytest.mark.parametrize("wrap", ["alone", "chain", "masked"])
def test_nnx_optimizer_projects_every_layer(wrap: str) -> None:
    model = Twin(nnx.Rngs(0))
    projected = with_projection(optax.adam(0.5), lattice_nnx.projection(model))
    if wrap == "chain":
        projected = optax.chain(optax.clip(1.0), projected)
    if wrap == "masked":
        projected = optax.masked(
            projected,
            lambda p: jax.tree_util.tree_map_with_path(lambda k, _: "free" not in str(k), p),
        )
    optimizer = nnx.Optimizer(model, projected, wrt=nnx.Param)

    @nnx.jit
    def step(model: Twin, optimizer: nnx.Optimizer) -> jax.Array:
        loss, grads = nnx.value_and_grad(lambda m: jnp.mean((m(X) - Y) ** 2))(model)
        optimizer.update(model, grads)
        return loss

    losses = []
    for _ in range(5):
        losses.append(float(step(model, optimizer)))
        assert float(nnx.jit(check_model)(model)) == 0.0
    assert losses[-1] < losses[0]
    with pytest.raises(ValueError, match="expected a model with a layer"):
        lattice_nnx.projection(model.free)


def test_examples_of_the_modules() -> None:
    for name in ("tagged", "nnx", "optimizer"):
        result = doctest.testmod(importlib.import_module(f"fusion.lattice.{name}"))
        assert result.failed == 0 and result.attempted > 0
