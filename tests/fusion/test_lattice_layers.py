"""Layers of the lattice library: recorded outputs of other libraries, closed forms, bad input."""

from __future__ import annotations

import dataclasses
import doctest
import importlib
import itertools
import math
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.lattice import (
    CategoricalConfig,
    DeepLatticeConfig,
    EnsembleConfig,
    LatticeConfig,
    LinearConfig,
    PWLConfig,
    categorical,
    deep_lattice,
    ensemble,
    lattice_layer,
    linear,
    pwl,
    regularizers,
)
from fusion.lattice.categorical import CategoricalParams
from fusion.lattice.checks import require_key
from fusion.lattice.deep_lattice import DeepLatticeParams
from fusion.lattice.lattice_config import LatticeParams
from fusion.lattice.lattice_layer import vertices
from fusion.lattice.linear import LinearParams
from fusion.lattice.pwl import PWLParams, keypoints
from fusion.lattice.subsets import random_features
from fusion.targets import TargetConfig

MODULES = (
    "checks",
    "lattice_config",
    "quantiles",
    "rounding",
    "projections",
    "pwl",
    "categorical",
    "linear",
    "lattice_layer",
    "ensemble",
    "deep_lattice",
)


@pytest.fixture(scope="module")
def peers() -> dict[str, dict[str, np.ndarray]]:
    """Recorded by tests/golden/lattice_make.py."""
    cases: dict[str, dict[str, np.ndarray]] = {}
    path = Path(__file__).resolve().parents[1] / "golden" / "lattice_peers.npz"
    with np.load(path) as file:
        for key in file.files:
            case, name = key.split(".")
            cases.setdefault(case, {})[name] = file[key]
    return cases


def _same(found: jax.Array, case: dict[str, np.ndarray], atol: float = 1e-6) -> None:
    compared = [name for name in ("tfl", "ptl") if name in case]
    assert compared
    for name in compared:
        np.testing.assert_allclose(found, case[name], rtol=0, atol=atol, err_msg=name)


# The same outputs as TensorFlow Lattice and PyTorch Lattice on the same weights.


def test_pwl_equals_peers(peers: dict) -> None:
    case = peers["pwl"]
    config = PWLConfig(
        1, 5, keypoints=(tuple(case["where"].tolist()),), missing_value=float(case["x"][-1])
    )
    params = PWLParams(jnp.asarray(case["outputs"])[None], None, jnp.asarray(case["missing"]))
    _same(pwl.apply(config, params, jnp.asarray(case["x"])[:, None])[:, 0], case)


def test_pwl_with_learned_keypoints_equals_peer(peers: dict) -> None:
    case = peers["pwl_learned"]
    config = PWLConfig(
        1, 5, keypoints=(tuple(case["where"].tolist()),), learned_keypoints=True
    )  # fmt: skip
    params = PWLParams(jnp.asarray(case["outputs"])[None], jnp.asarray(case["logits"])[None])
    _same(pwl.apply(config, params, jnp.asarray(case["x"])[:, None])[:, 0], case)


def test_categorical_equals_peers(peers: dict) -> None:
    case = peers["categorical"]
    config = CategoricalConfig(4, missing_value=-1)
    params = CategoricalParams(jnp.asarray(case["outputs"]), jnp.asarray(case["missing"][0]))
    _same(categorical.apply(config, params, jnp.asarray(case["x"], jnp.int32)), case)


def test_linear_equals_peers(peers: dict) -> None:
    case = peers["linear"]
    params = LinearParams(jnp.asarray(case["weights"])[None], jnp.asarray(case["bias"]))
    config = LinearConfig(6, bias=True)
    _same(linear.apply(config, params, jnp.asarray(case["x"]))[:, 0], case)


def test_linear_normalisation_equals_peer(peers: dict) -> None:
    case = peers["linear_norm"]
    config = LinearConfig(6, monotonicity=tuple(case["signs"].tolist()), normalized=True)
    _same(linear.project(config, LinearParams(jnp.asarray(case["weights"])[None])).weights[0], case)


@pytest.mark.parametrize("interpolation", ["hypercube", "simplex"])
def test_lattice_equals_peers(peers: dict, interpolation: str) -> None:
    case = peers[f"lattice_{interpolation}"]
    config = LatticeConfig((3, 2, 4), interpolation=interpolation)
    _same(
        lattice_layer.apply(
            config, LatticeParams(jnp.asarray(case["vertices"])), jnp.asarray(case["x"])
        ),
        case,
    )


def test_regularizers_equal_peer(peers: dict) -> None:
    case = peers["pwl_regularizers"]
    params = PWLParams(jnp.asarray(case["outputs"])[None])
    kinds = (regularizers.pwl_laplacian, regularizers.pwl_hessian, regularizers.pwl_wrinkle)
    strengths = ({"l1": 0.3}, {"l2": 0.7}, {"l1": 0.3, "l2": 0.7})
    found = [kind(params, **strength) for kind in kinds for strength in strengths]
    np.testing.assert_allclose(np.array(found), case["tfl"], rtol=1e-6, atol=1e-6)
    case = peers["lattice_regularizers"]
    lattice = LatticeParams(jnp.asarray(case["vertices"]))
    found = [
        regularizers.lattice_laplacian(lattice, l1=0.3, l2=0.7),
        regularizers.lattice_laplacian(lattice, l1=(0.1, 0.2, 0.3)),
        regularizers.lattice_torsion(lattice, l1=0.3),
        regularizers.lattice_torsion(lattice, l1=0.3, l2=0.7),
    ]
    np.testing.assert_allclose(np.array(found), case["tfl"], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "constraints"),
    [
        ("monotone", {"monotonicity": (1, 0, 1)}),
        ("valley", {"monotonicity": (0, 1), "unimodality": (1, 0)}),
        ("trust", {"monotonicity": (1, 0), "edgeworth_trust": ((0, 1, -1),)}),
    ],
)
def test_lattice_projection_equals_peer(peers: dict, name: str, constraints: dict) -> None:
    case = peers[f"project_{name}"]
    config = LatticeConfig(case["vertices"].shape, n_iterations=400, **constraints)
    params = LatticeParams(jnp.asarray(case["vertices"]))
    _same(jax.jit(lambda p: lattice_layer.project(config, p))(params).vertices, case, atol=1e-4)


def test_deep_lattice_equals_peer(peers: dict) -> None:
    case = peers["deep"]
    config = DeepLatticeConfig(
        4, (-1, 0, 0, 0), (0.0, 4.0), n_keypoints=6, n_lattices=2, lattice_size=3
    )
    params = DeepLatticeParams(
        PWLParams(jnp.asarray(case["inputs"])),
        LinearParams(jnp.asarray(case["weights"])),
        PWLParams(jnp.asarray(case["hidden"])),
        LatticeParams(jnp.asarray(case["vertices"])),
    )
    _same(deep_lattice.apply(config, params, jnp.asarray(case["x"])), case)


# Closed forms.


@pytest.mark.parametrize("interpolation", ["hypercube", "simplex"])
def test_lattice_returns_its_vertices_and_is_linear_between(interpolation: str) -> None:
    config = LatticeConfig((3, 2, 4), interpolation=interpolation)
    table = jnp.asarray(np.random.default_rng(0).normal(size=config.sizes).astype(np.float32))
    coordinates, held = vertices(config, LatticeParams(table))
    points = np.array(list(itertools.product(*coordinates)), np.float32)
    found = lattice_layer.apply(config, LatticeParams(table), jnp.asarray(points))
    np.testing.assert_allclose(found.reshape(config.sizes), held, atol=1e-6)
    plane = LatticeParams(jnp.asarray(np.indices(config.sizes).sum(0), jnp.float32))
    x = jnp.array([[0.3, 0.9, 2.4], [9.0, -1.0, 1.5]])
    np.testing.assert_allclose(lattice_layer.apply(config, plane, x), [3.6, 3.5], atol=1e-6)


def test_simplex_is_the_largest_coordinate_on_a_max_table() -> None:
    """The Lovasz extension of "any" is the maximum; the multilinear one is not."""
    table = jnp.asarray((np.indices((2, 2, 2)).sum(0) > 0).astype(np.float32))
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(20, 3)).astype(np.float32))
    config = LatticeConfig((2, 2, 2), interpolation="simplex")
    np.testing.assert_allclose(
        lattice_layer.apply(config, LatticeParams(table), x), np.max(x, axis=1), atol=1e-6
    )
    smooth = lattice_layer.apply(LatticeConfig((2, 2, 2)), LatticeParams(table), x)
    np.testing.assert_allclose(smooth, 1 - np.prod(1 - np.asarray(x), axis=1), atol=1e-6)


def test_pwl_interpolates_like_numpy_and_takes_nan_as_missing() -> None:
    config = PWLConfig(2, 4, ((0.0, 3.0), (-1.0, 2.0)), missing_value=math.nan)
    params = pwl.init(jax.random.key(0), config)
    rng = np.random.default_rng(2)
    params = params._replace(
        outputs=jnp.asarray(rng.normal(size=(2, 4)).astype(np.float32)),
        missing=jnp.array([7.0, 8.0]),
    )
    x = rng.uniform(-2, 4, size=(6, 2)).astype(np.float32)
    where, outputs = keypoints(config, params)
    expected = np.stack([np.interp(x[:, i], where[i], outputs[i]) for i in (0, 1)], axis=1)
    x[1, 0], expected[1, 0] = np.nan, 7.0
    np.testing.assert_allclose(pwl.apply(config, params, jnp.asarray(x)), expected, atol=1e-6)
    grads = jax.grad(lambda p: jnp.sum(pwl.apply(config, p, jnp.asarray(x))))(params)
    assert all(bool(jnp.all(jnp.isfinite(g))) for g in jax.tree.leaves(grads))
    assert float(grads.missing[0]) == 1.0 and float(grads.missing[1]) == 0.0


def test_learned_keypoints_stay_in_order_and_inside() -> None:
    config = PWLConfig(1, 6, (-1.0, 2.0), learned_keypoints=True)
    params = pwl.init(jax.random.key(0), config)
    where, _ = keypoints(config, params)
    np.testing.assert_allclose(where[0], np.linspace(-1, 2, 6), atol=1e-6)
    spacing = 3.0 * jax.random.normal(jax.random.key(1), (1, 5))
    moved, _ = keypoints(config, params._replace(spacing=spacing))
    assert float(moved[0, 0]) == -1.0 and float(moved[0, -1]) == 2.0
    assert np.all(np.diff(moved) > 0)


def test_unknown_category_gives_nan() -> None:
    params = categorical.init(jax.random.key(0), CategoricalConfig(3))
    found = categorical.apply(CategoricalConfig(3), params, jnp.array([0, 3, -1]))
    np.testing.assert_array_equal(np.isnan(found), [False, True, True])


def test_disconnected_weights_do_nothing() -> None:
    config = LinearConfig(3, 2, connected=((1, 1, 0), (0, 0, 1)))
    params = LinearParams(jnp.ones((2, 3)))
    np.testing.assert_array_equal(
        linear.apply(config, params, jnp.array([1.0, 2.0, 4.0])), [3.0, 4.0]
    )
    np.testing.assert_array_equal(linear.project(config, params).weights == 0, ~config.links)


def test_torsion_of_a_sum_is_zero() -> None:
    rows, columns = jnp.array([0.0, 5.0, 1.0])[:, None], jnp.array([2.0, -1.0])[None, :]
    assert float(regularizers.lattice_torsion(LatticeParams(rows + columns), l1=1.0)) == 0.0


def test_random_features_use_every_input_equally() -> None:
    subsets = random_features(0, 7, 14, 3)
    assert subsets == random_features(0, 7, 14, 3) != random_features(1, 7, 14, 3)
    assert np.bincount(np.concatenate(subsets), minlength=7).tolist() == [6] * 7
    assert all(len(set(subset)) == 3 for subset in subsets)


def test_ensemble_is_the_mean_of_its_lattices() -> None:
    config = EnsembleConfig(4, ((0, 1), (2, 3), (1, 3)), 3, (1, 0, -1, 0), (0.0, 1.0))
    params = ensemble.init(jax.random.key(0), config)
    x = jnp.asarray(np.random.default_rng(0).uniform(0, 2, (5, 4)).astype(np.float32))
    one = LatticeConfig((3, 3))
    each = [
        lattice_layer.apply(one, LatticeParams(table), x[:, np.array(subset)])
        for table, subset in zip(params.vertices, config.features, strict=True)
    ]
    found = ensemble.apply(config, params, x)
    np.testing.assert_allclose(found, np.mean(each, axis=0), atol=1e-6)
    uniform = dataclasses.replace(config, features=((0, 1),), monotonicity=(1, 1, 0, 0))
    broken = LatticeParams(jnp.array([[[1.0, 0.0, 0.2], [0.3, 0.9, 0.1], [0.5, 0.4, 2.0]]]))
    alone = lattice_layer.project(
        LatticeConfig((3, 3), (1, 1), output_range=(0.0, 1.0)),
        LatticeParams(broken.vertices[0]),
    )
    np.testing.assert_allclose(
        ensemble.project(uniform, broken).vertices[0], alone.vertices, atol=1e-6
    )


# Bad input, refused before anything is compiled.


def unchecked(kind: type, **fields: object) -> object:
    """A configuration made without the type checker of the tests, as in a user's program."""
    config = object.__new__(kind)
    for field in dataclasses.fields(kind):
        object.__setattr__(config, field.name, fields.get(field.name, field.default))
    config.__post_init__()
    return config


BAD = [
    (lambda: PWLConfig(1, output_range=(0.0, math.inf)), "finite bounds"),
    (lambda: TargetConfig(loss_range=(4.0, 0.0)), "loss_range=.* expected low < high"),
    (lambda: TargetConfig(lattice_size=1), "lattice_size=1: expected 2 or more"),
    (lambda: unchecked(LatticeConfig, sizes=(2,), interpolation="cubic"), "'cubic': expected"),
    (lambda: PWLConfig(0), "n_inputs=0: expected 1 or more"),
    (lambda: PWLConfig(1, 1), "n_keypoints=1: expected 2"),
    (lambda: PWLConfig(2, monotonicity=(1, 2)), r"monotonicity=\(1, 2\): expected"),
    (lambda: PWLConfig(1, input_range=(1.0, 1.0)), "input_range"),
    (lambda: PWLConfig(1, output_range=(2.0, 1.0)), "low < high"),
    (lambda: PWLConfig(1, 3, keypoints=((0.0, 1.0, 1.0),)), "increase strictly"),
    (lambda: CategoricalConfig(0), "n_categories=0: expected"),
    (lambda: CategoricalConfig(3, missing_value=1), "missing_value=1: expected .* is a category"),
    (lambda: CategoricalConfig(3, ((0, 1), (1, 0))), "circle"),
    (lambda: LinearConfig(2, monotonicity=(1,)), "monotonicity"),
    (lambda: LinearConfig(2, monotonicity=(1, 0), dominance=((0, 1),)), "both -1"),
    (lambda: LinearConfig(2, monotonicity=(1, 1), range_dominance=((0, 1),)), "input_range"),
    (lambda: LinearConfig(2, 1, connected=((0, 0),)), "connected"),
    (lambda: LatticeConfig((1, 2)), "sizes"),
    (lambda: LatticeConfig((2, 2), (1,)), "monotonicity"),
    (lambda: LatticeConfig((2,), (1,), (1,)), "both monotone and unimodal"),
    (lambda: LatticeConfig((2, 2), edgeworth_trust=((0, 0, 1),)), "two different inputs"),
    (
        lambda: LatticeConfig((2, 2), edgeworth_trust=((0, 1, 1), (1, 0, -1))),
        "opposite directions",
    ),
    (lambda: LatticeConfig((2, 2), n_iterations=0), "n_iterations"),
    (lambda: EnsembleConfig(3, ((0, 1), (2,))), "same number of inputs"),
    (lambda: EnsembleConfig(3, ((0, 3),)), "different inputs"),
    (lambda: random_features(0, 5, 2, 2), "more lattices"),
    (lambda: random_features(0, 5, 2, 6), "rank=6: expected"),
    (lambda: DeepLatticeConfig(3, (1, 0)), "each of 3 inputs"),
    (lambda: DeepLatticeConfig(3, (1, 0, 0), n_monotone=0), "n_monotone=0: expected"),
    (lambda: DeepLatticeConfig(1, (1,), n_monotone=1), "all inputs are monotone"),
    (lambda: DeepLatticeConfig(3, embedding_dim=0), "embedding_dim=0: expected"),
    (
        lambda: regularizers.lattice_laplacian(LatticeParams(jnp.ones((2, 2))), l1=(1.0,)),
        "expected a float or 2",
    ),
]


@pytest.mark.parametrize(("call", "message"), BAD, ids=[m for _, m in BAD])
def test_bad_input_is_named(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_every_error_has_the_same_form() -> None:
    for call, _ in BAD:
        with pytest.raises(ValueError, match=r"^[\w(), ]+=(.|\n)+: expected .+; .+$"):
            call()


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        (LatticeConfig, {"sizes": [2, 2]}),
        (LatticeConfig, {"sizes": np.array([2, 2])}),
        (PWLConfig, {"n_inputs": 2, "n_keypoints": 2, "keypoints": [[0.0, 1.0], [0.0, 2.0]]}),
        (EnsembleConfig, {"n_inputs": 2, "features": ([0, 1],)}),
    ],
)
def test_lists_are_refused_with_the_tuple_to_write(kind: type, fields: dict) -> None:
    with pytest.raises(TypeError, match=r"expected tuples, .*; write \("):
        unchecked(kind, **fields)


@pytest.mark.parametrize(
    ("kind", "fields"), [(PWLConfig, {"n_inputs": 1.5}), (LatticeConfig, {"sizes": (2, True)})]
)
def test_fractions_and_flags_are_no_counts(kind: type, fields: dict) -> None:
    with pytest.raises(TypeError, match="expected a whole number"):
        unchecked(kind, **fields)


def test_legacy_keys_are_refused() -> None:
    with pytest.raises(ValueError, match=r"key=uint32: expected a typed key; use jax\.random\.key"):
        require_key(jax.random.PRNGKey(0))
    require_key(jax.random.key(0))


@pytest.mark.parametrize("layer", ["pwl", "linear", "lattice_layer", "ensemble"])
def test_inputs_of_another_width_are_refused(layer: str) -> None:
    module, config = {
        "pwl": (pwl, PWLConfig(3)),
        "linear": (linear, LinearConfig(3)),
        "lattice_layer": (lattice_layer, LatticeConfig((2, 2, 2))),
        "ensemble": (ensemble, EnsembleConfig(3, ((0, 1, 2),))),
    }[layer]
    params = jax.eval_shape(lambda key: module.init(key, config), jax.random.key(0))
    with pytest.raises(ValueError, match=r"expected \[\.\.\., 3\]"):
        jax.eval_shape(lambda p: module.apply(config, p, jnp.ones((5, 1))), params)


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings(name: str) -> None:
    module = importlib.import_module(f"fusion.lattice.{name}")
    result = doctest.testmod(module)
    assert result.failed == 0


@pytest.mark.relaxed  # optax promotes dtypes
def test_examples_of_the_optimizer() -> None:
    assert doctest.testmod(importlib.import_module("fusion.lattice.optimizer")).attempted > 0


def test_the_first_parameters_of_many_monotone_inputs_are_quick() -> None:
    config = LatticeConfig((2,) * 12, (1,) * 12)
    key = jax.block_until_ready(jax.random.key(3))
    start = time.process_time()
    params = jax.block_until_ready(lattice_layer.init(key, config))
    assert time.process_time() - start < 0.5  # 6.4 s when every axis was projected
    assert lattice_layer.check(config, params) == 0.0
