"""Projections against a QP solver; nothing left of a violation after optimizer steps."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import optax
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
    with_projection,
)
from fusion.lattice.lattice_config import LatticeParams
from fusion.lattice.linear import LinearParams
from fusion.lattice.projections import (
    dykstra,
    isotonic,
    order_closure,
    order_depth,
    pair_projections,
    repair_order,
)
from fusion.lattice.pwl import PWLParams

_REFERENCE = Path(__file__).resolve().parents[1] / "reference" / "lattice_qp.py"
SETTINGS = hypothesis.settings(
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=list(hypothesis.HealthCheck),
)


@pytest.fixture(scope="module")
def qp() -> ModuleType:
    spec = importlib.util.spec_from_file_location("lattice_qp", _REFERENCE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _random(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


# Closed forms and the QP solver.


@pytest.mark.parametrize("n", [1, 2, 3, 7, 20])
def test_isotonic_is_the_projection(qp: ModuleType, n: int) -> None:
    x = _random(n, 4, n)
    y = np.asarray(isotonic(jnp.asarray(x)))
    assert np.all(np.diff(y, axis=-1) >= 0)
    rows = qp.order_rows(n, [(i, i + 1) for i in range(n - 1)])
    for given, found in zip(x, y, strict=True):
        np.testing.assert_allclose(found, qp.project(given, rows), atol=2e-5)


def test_isotonic_along_another_axis() -> None:
    x = jnp.asarray(_random(0, 5, 3))
    np.testing.assert_array_equal(isotonic(x, axis=0), isotonic(x.T).T)


def test_dykstra_reaches_the_intersection_of_half_spaces(qp: ModuleType) -> None:
    pairs = [(0, 2), (1, 2), (2, 3), (1, 4)]
    x = _random(3, 5)
    closure = order_closure(pairs, 5)
    y = dykstra(jnp.asarray(x), pair_projections(closure), 300)
    np.testing.assert_allclose(y, qp.project(x, qp.order_rows(5, pairs)), atol=1e-5)
    np.testing.assert_array_equal(order_depth(closure), [0, 0, 1, 2, 1])


def test_repair_keeps_feasible_points_and_mends_others() -> None:
    closure = order_closure([(0, 1), (1, 2), (0, 3)], 4)
    feasible = jnp.array([[0.0, 1.0, 1.0, 5.0]])
    np.testing.assert_array_equal(repair_order(feasible, closure), feasible)
    mended = repair_order(jnp.array([[1.0, 0.0, 0.5, 2.0]]), closure)[0]
    assert mended[0] <= mended[1] <= mended[2] and mended[0] <= mended[3]


@pytest.mark.parametrize("pairs", [((0, 1), (1, 2), (2, 0)), ((0, 0),), ((0, 3),)])
def test_bad_orders_are_refused(pairs: tuple[tuple[int, int], ...]) -> None:
    with pytest.raises(ValueError, match=r"without a circle|two different elements"):
        order_closure(pairs, 3)


def test_pwl_projection_equals_qp(qp: ModuleType) -> None:
    config = PWLConfig(3, 8, monotonicity=(1, 0, -1), output_range=(-0.5, 0.8))
    x = _random(1, 3, 8)
    y = pwl.project(config, PWLParams(jnp.asarray(x))).outputs
    chain = qp.order_rows(8, [(i, i + 1) for i in range(7)])
    for row, sign in enumerate((1, 0, -1)):
        rows = chain * sign if sign else chain[:0]
        np.testing.assert_allclose(y[row], qp.project(x[row], rows, -0.5, 0.8), atol=1e-4)


@pytest.mark.parametrize(
    ("config", "pairs", "width"),
    [
        (LinearConfig(5, monotonicity=(1, 1, -1, 0, 1)), [], None),
        (
            LinearConfig(
                5, monotonicity=(1, 1, 1, 0, 1), dominance=((0, 1), (1, 2)), n_iterations=300
            ),
            [(1, 0), (2, 1)],
            None,
        ),
        (
            LinearConfig(
                4,
                monotonicity=(1, 1, 1, 1),
                range_dominance=((0, 1), (2, 1)),
                input_range=((0.0, 2.0), (0.0, 1.0), (-1.0, 0.5), (0.0, 1.0)),
                n_iterations=300,
            ),
            [(1, 0), (1, 2)],
            [2.0, 1.0, 1.5, 1.0],
        ),
        (LinearConfig(5, monotonicity=(1, 1, 1, 1, 1), normalized=True), [], None),
        (
            LinearConfig(
                4, monotonicity=(1,) * 4, dominance=((3, 0),), normalized=True, n_iterations=300
            ),
            [(0, 3)],
            None,
        ),
    ],
    ids=["signs", "dominance", "range_dominance", "average", "average_dominance"],
)
def test_linear_projection_equals_qp(
    qp: ModuleType, config: LinearConfig, pairs: list[tuple[int, int]], width: list[float] | None
) -> None:
    n = config.n_inputs
    for seed in range(3):
        x = _random(seed, 1, n)
        y = linear.project(config, LinearParams(jnp.asarray(x))).weights[0]
        order = qp.order_rows(n, pairs, None if width is None else np.asarray(width))
        rows = np.concatenate([order, np.diag(config.signs[0])[config.signs[0] != 0]])
        equal = np.ones(n) if config.normalized else None
        np.testing.assert_allclose(y, qp.project(x[0], rows, equal=equal), atol=1e-4)


LATTICES = {
    "monotone": LatticeConfig((3, 4), (1, -1)),
    "bounded": LatticeConfig((2, 3, 2), (1, 0, 1), output_range=(-0.3, 0.6)),
    "valley": LatticeConfig((5, 3), (0, 1), (1, 0)),
    "peak": LatticeConfig((4,), None, (-1,), output_range=(None, 0.5)),
    "trust": LatticeConfig((3, 4), (1, 0), edgeworth_trust=((0, 1, 1),)),
    "trust_bounded": LatticeConfig(
        (4, 3), (1, -1), edgeworth_trust=((0, 1, -1),), output_range=(-0.4, 0.7)
    ),
}


@pytest.mark.parametrize("name", LATTICES)
def test_lattice_projection_equals_qp(qp: ModuleType, name: str) -> None:
    base = LATTICES[name]
    config = LatticeConfig(
        base.sizes, base.monotonicity, base.unimodality, base.edgeworth_trust, base.output_range,
        n_iterations=2000,
    )  # fmt: skip
    zeros = (0,) * base.rank
    rows = qp.lattice_rows(
        base.sizes, base.monotonicity or zeros, base.unimodality or zeros, base.edgeworth_trust
    )
    x = _random(7, 3, *base.sizes)
    y = jax.jit(jax.vmap(lambda v: lattice_layer.project(config, LatticeParams(v)).vertices))(x)
    for given, found in zip(x, y, strict=True):
        np.testing.assert_allclose(found, qp.project(given, rows, *base.output_range), atol=1e-4)


def test_categorical_projection_equals_qp(qp: ModuleType) -> None:
    pairs = ((0, 1), (0, 2), (1, 3), (2, 3))
    config = CategoricalConfig(5, pairs, (-0.5, 1.0), n_iterations=300)
    x = _random(11, 5)
    y = categorical.project(config, categorical.CategoricalParams(jnp.asarray(x))).outputs
    np.testing.assert_allclose(
        y, qp.project(x, qp.order_rows(5, list(pairs)), -0.5, 1.0), atol=1e-4
    )


# After optimizer steps.

LEARNING_RATES = (1e-3, 0.1, 3.0)
_STEPS = 12


def _worst_after_steps(
    init: Callable[[Any], Any],
    project: Callable[[Any], Any],
    check: Callable[[Any], jax.Array],
    seed: int,
) -> np.ndarray:
    """Largest `check` over steps of three optimizers with random gradients, several scales."""
    key = jax.random.key(seed)

    def run(key: jax.Array, rate: jax.Array) -> jax.Array:
        start_key, run_key = jax.random.split(key)
        params = init(start_key)
        inner = optax.chain(optax.clip_by_global_norm(10.0), optax.scale_by_adam())
        optimizer = optax.chain(
            optax.add_decayed_weights(1e-3),
            with_projection(optax.chain(inner, optax.scale(-1.0), optax.scale(rate)), project),
        )

        def step(carry: tuple[Any, Any], key: jax.Array) -> tuple[tuple[Any, Any], Any]:
            params, state = carry
            leaves, tree = jax.tree.flatten(params)
            keys = jax.random.split(key, len(leaves))
            noise = [jax.random.normal(k, a.shape) for k, a in zip(keys, leaves, strict=True)]
            updates, state = optimizer.update(jax.tree.unflatten(tree, noise), state, params)
            params = optax.apply_updates(params, updates)
            return (params, state), params

        keys = jax.random.split(run_key, _STEPS)
        _, trace = jax.lax.scan(step, (params, optimizer.init(params)), keys)
        return jax.vmap(check)(trace)

    rates = jnp.asarray(LEARNING_RATES)
    worst = jax.jit(jax.vmap(run))(jax.random.split(key, len(rates)), rates)
    return np.asarray(worst)


@st.composite
def lattices(draw: Callable) -> dict[str, Any]:
    """Arguments of a LatticeConfig."""
    rank = draw(st.integers(1, 3))
    sizes = tuple(draw(st.integers(2, 4)) for _ in range(rank))
    kinds = [draw(st.sampled_from(["free", "up", "down", "valley", "peak"])) for _ in range(rank)]
    trust = []
    if rank > 1 and draw(st.booleans()):
        main, other = draw(st.permutations(range(rank)))[:2]
        trust.append((main, other, draw(st.sampled_from([-1, 1]))))
    low = draw(st.sampled_from([None, -0.5, 0.0]))
    high = draw(st.sampled_from([None, 0.75]))
    return {
        "sizes": sizes,
        "monotonicity": tuple({"up": 1, "down": -1}.get(k, 0) for k in kinds),
        "unimodality": tuple({"valley": 1, "peak": -1}.get(k, 0) for k in kinds),
        "edgeworth_trust": tuple(trust),
        "output_range": (low, high),
        "n_iterations": draw(st.sampled_from([1, 10])),
    }


def _check_lattice(arguments: dict[str, Any], seed: int) -> None:
    config = LatticeConfig(**arguments)
    worst = _worst_after_steps(
        lambda key: lattice_layer.init(key, config),
        lambda p: lattice_layer.project(config, p),
        lambda p: lattice_layer.check(config, p),
        seed,
    )
    assert worst.max() == 0.0, (config, worst.max())


@pytest.mark.relaxed  # optax promotes dtypes
@hypothesis.settings(SETTINGS, max_examples=6)
@hypothesis.given(arguments=lattices(), seed=st.integers(0, 1000))
def test_no_violation_after_any_step_lattice(arguments: dict[str, Any], seed: int) -> None:
    _check_lattice(arguments, seed)


@pytest.mark.slow
@pytest.mark.relaxed
@hypothesis.settings(SETTINGS, max_examples=60)
@hypothesis.given(arguments=lattices(), seed=st.integers(0, 1000))
def test_no_violation_after_any_step_many_lattices(arguments: dict[str, Any], seed: int) -> None:
    _check_lattice(arguments, seed)


LAYERS: dict[str, tuple[ModuleType, Any]] = {
    "pwl": (
        pwl,
        PWLConfig(
            4, 7, monotonicity=(0, 1, -1, 1), output_range=(-1.0, None), learned_keypoints=True,
            missing_value=math.nan,
        ),
    ),
    "categorical": (categorical, CategoricalConfig(5, ((0, 1), (1, 2), (0, 4)), (0.5, 2.0))),
    "linear": (
        linear,
        LinearConfig(
            5, 2, (1, 1, 1, 0, -1), range_dominance=((0, 1), (1, 2)),
            input_range=((0.0, 3.0), (0.0, 0.7), (0.0, 1.3), (0.0, 1.0), (0.0, 1.0)), bias=True,
        ),
    ),
    "average": (
        linear, LinearConfig(4, 3, (1, 1, 1, 1), dominance=((0, 1), (2, 1)), normalized=True)
    ),
    "ensemble": (
        ensemble,
        EnsembleConfig(
            4, ((0, 1, 2), (1, 2, 3), (3, 0, 1)), monotonicity=(1, 0, -1, 1),
            output_range=(0.0, 1.0),
        ),
    ),
    "deep": (
        deep_lattice,
        DeepLatticeConfig(
            5, (-1, 0, 1, 0, 0), (0.0, 4.0), n_lattices=2, embedding_dim=3, lattice_size=3,
            learned_keypoints=True,
        ),
    ),
}  # fmt: skip


@pytest.mark.relaxed
@pytest.mark.parametrize("name", LAYERS)
def test_no_violation_after_any_step_layers(name: str) -> None:
    module, config = LAYERS[name]
    worst = _worst_after_steps(
        lambda key: module.init(key, config),
        lambda p: module.project(config, p),
        lambda p: module.check(config, p),
        3,
    )
    assert worst.max() == 0.0


@pytest.mark.parametrize("name", LAYERS)
def test_check_sees_what_projection_removes(name: str) -> None:
    module, config = LAYERS[name]
    params = jax.jit(lambda key: module.init(key, config))(jax.random.key(0))
    check = jax.jit(lambda p: module.check(config, p))
    project = jax.jit(lambda p: module.project(config, p))
    assert float(check(params)) == 0.0
    leaves, tree = jax.tree.flatten(params)
    rng = np.random.default_rng(0)
    broken = jax.tree.unflatten(
        tree, [a + jnp.asarray(rng.normal(size=a.shape), a.dtype) for a in leaves]
    )
    assert float(check(broken)) > 0.1
    mended = project(broken)
    assert float(check(mended)) == 0.0
    again = project(mended)
    for a, b in zip(jax.tree.leaves(mended), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)


@pytest.mark.relaxed
def test_with_projection_needs_params() -> None:
    optimizer = with_projection(optax.sgd(0.1), lambda p: p)
    state = optimizer.init(jnp.ones(2))
    with pytest.raises(ValueError, match="params=None: expected"):
        optimizer.update(jnp.ones(2), state)


@pytest.mark.relaxed
def test_with_projection_equals_projecting_afterwards() -> None:
    config = LATTICES["bounded"]
    params = lattice_layer.init(jax.random.key(1), config)
    grads = jax.tree.map(lambda a: jnp.asarray(_random(5, *a.shape)), params)
    plain = optax.adam(0.5)
    optimizer = with_projection(plain, lambda p: lattice_layer.project(config, p))
    updates, _ = optimizer.update(grads, optimizer.init(params), params)
    free, _ = plain.update(grads, plain.init(params), params)
    expected = lattice_layer.project(config, optax.apply_updates(params, free))
    np.testing.assert_allclose(
        optax.apply_updates(params, updates).vertices, expected.vertices, atol=1e-6
    )
