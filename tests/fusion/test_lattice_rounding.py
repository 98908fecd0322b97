"""No violation in any floating type and any range, after a projection and after the update."""

from __future__ import annotations

from typing import Any

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.lattice import (
    CategoricalConfig,
    LatticeConfig,
    LinearConfig,
    PWLConfig,
    categorical,
    lattice_layer,
    linear,
    pwl,
)
from fusion.lattice.lattice_config import LatticeParams
from fusion.lattice.pwl import PWLParams
from fusion.lattice.rounding import frame, onto, snap
from tests.reference import lattice_qp as qp

Range = tuple[float | None, float | None]
KINDS: dict[str, tuple[Any, Any]] = {
    "pwl": (pwl, lambda r: PWLConfig(3, 6, (0.0, 1.0), (1, -1, 0), r, missing_value=-1.0)),
    "convex": (
        pwl,
        lambda r: PWLConfig(4, 5, (0.0, 1.0), (1, 0, -1, 1), r, convexity=(1, 1, -1, -1)),
    ),
    "categorical": (categorical, lambda r: CategoricalConfig(4, ((0, 1), (1, 3), (0, 2)), r)),
    "lattice": (lattice_layer, lambda r: LatticeConfig((3, 4), (1, -1), output_range=r)),
    "valley": (lattice_layer, lambda r: LatticeConfig((5, 2), (0, 1), (1, 0), output_range=r)),
    "trust": (
        lattice_layer,
        lambda r: LatticeConfig((3, 3), (1, 0), edgeworth_trust=((0, 1, 1),), output_range=r),
    ),
    "trapezoid": (
        lattice_layer,
        lambda r: LatticeConfig((3, 3), (1, 0), trapezoid_trust=((0, 1, 1),), output_range=r),
    ),
    "dominance": (
        lattice_layer,
        lambda r: LatticeConfig(
            (3, 3), (1, -1), dominance=((0, 1),), trapezoid_trust=((0, 1, 1),), output_range=r
        ),
    ),
    "joint": (
        lattice_layer,
        lambda r: LatticeConfig((3, 3), joint_monotonicity=((0, 1, 1),), output_range=r),
    ),
    "joint_valley": (
        lattice_layer,
        lambda r: LatticeConfig((4, 3), joint_unimodality=(((0, 1), 1),), output_range=r),
    ),
    "linear": (linear, lambda r: LinearConfig(4, 2, (1, 1, -1, 0), dominance=((0, 1),))),
    "average": (linear, lambda r: LinearConfig(4, 1, (1, 1, 1, 1), normalized=True)),
}
RANGES: tuple[Range, ...] = (
    (0.0, 1.0), (1e5, 1e5 + 1), (1e3, 1e3 + 1), (-1e-3, 1e-3), (-7.0, 0.1), (None, None),
    (0.3, None), (None, -0.7), (1e4, None),
)  # fmt: skip
TYPES = ("float32", "bfloat16", "float16")


def _worst(kind: str, output_range: Range, dtype: str, seed: int) -> list[float]:
    """Violations of three projections in a row, and of the parameters that updates lead to."""
    module, make = KINDS[kind]
    config = make(output_range)
    low, high = output_range
    offset = low if low is not None else high or 0.0
    width = 1.0 if low is None or high is None else high - low
    shapes = jax.eval_shape(lambda key: module.init(key, config), jax.random.key(0))
    rng = np.random.default_rng(seed)

    def draw(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        most = float(jnp.finfo(dtype).max)
        drawn = offset + width * rng.normal(size=leaf.shape)
        return jnp.asarray(np.clip(drawn, -most, most), dtype)

    project = jax.jit(lambda p: module.project(config, p))
    check = jax.jit(lambda p: module.check(config, p))
    found = []
    params = project(jax.tree.map(draw, shapes))
    for _ in range(3):
        found.append(float(check(params)))
        moved = project(jax.tree.map(draw, shapes))
        assert all(leaf.dtype == jnp.dtype(dtype) for leaf in jax.tree.leaves(moved))
        updates = jax.tree.map(jnp.subtract, moved, params)
        params = jax.tree.map(jnp.add, params, updates)
        found.append(float(check(params)))
    return found


def _holds(kind: str, output_range: Range, dtype: str, seed: int) -> None:
    try:
        found = _worst(kind, output_range, dtype, seed)
    except ValueError as error:
        # No, or too few, numbers of the type lie in the range: said before anything is computed.
        assert "output_range" in str(error) and "steps" in str(error)
        low, high = output_range
        assert low is not None and high is not None
        eps = float(jnp.finfo(dtype).eps)
        assert (high - low) / max(abs(low), abs(high)) < (8 * eps if kind in "pwl" else 300 * eps)
        return
    assert max(found) == 0.0, (kind, output_range, dtype, found)


@pytest.mark.parametrize(
    ("kind", "output_range", "dtype"),
    [
        ("pwl", (0.0, 1.0), "bfloat16"),
        ("pwl", (1e5, 1e5 + 1), "float32"),
        ("lattice", (1e5, 1e5 + 1), "float32"),
        ("convex", (1e3, 1e3 + 1), "float32"),
        ("trust", (0.0, 1.0), "float16"),
        ("trapezoid", (-7.0, 0.1), "bfloat16"),
        ("dominance", (1e3, 1e3 + 1), "float32"),
        ("joint", (0.0, 1.0), "bfloat16"),
        ("joint_valley", (0.3, None), "float16"),
    ],
)
def test_half_precision_and_offsets_leave_no_violation(
    kind: str, output_range: Range, dtype: str
) -> None:
    assert max(_worst(kind, output_range, dtype, 0)) == 0.0


@hypothesis.settings(derandomize=True, deadline=None, database=None, max_examples=6)
@hypothesis.given(
    st.sampled_from(sorted(KINDS)), st.sampled_from(RANGES), st.sampled_from(TYPES),
    st.integers(0, 1000),
)  # fmt: skip
def test_no_violation_for_any_type_and_range(
    kind: str, output_range: Range, dtype: str, seed: int
) -> None:
    _holds(kind, output_range, dtype, seed)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("output_range", RANGES)
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_no_violation_for_every_type_and_range(kind: str, output_range: Range, dtype: str) -> None:
    _holds(kind, output_range, dtype, 1)


def test_a_flat_curve_stays_flat_at_an_offset() -> None:
    config = PWLConfig(1, 5, monotonicity=1, output_range=(1e3, 1e3 + 1))
    flat = PWLParams(jnp.full((1, 5), 1000.3))
    found = np.asarray(pwl.project(config, flat).outputs)
    assert np.ptp(found) == 0.0
    np.testing.assert_allclose(found, 1000.3, atol=1e-4)


def test_a_range_without_numbers_is_refused() -> None:
    config = PWLConfig(1, 3, output_range=(1e5, 1e5 + 1))
    with pytest.raises(ValueError, match=r"output_range=.*: expected .* bfloat16 .*; keep"):
        pwl.project(config, PWLParams(jnp.zeros((1, 3), jnp.bfloat16)))


def test_steps_are_powers_of_two_and_bounds_lie_inside() -> None:
    for output_range in ((0.0, 0.7), (0.1, None), (None, -3.3), (None, None)):
        place = frame(jnp.array([0.3, -5.0, 2.0]), output_range)
        assert float(np.log2(place.step)) % 1 == 0
        for side, given, sign in (
            (place.low, output_range[0], 1),
            (place.high, output_range[1], -1),
        ):
            if given is not None:
                assert 0 <= sign * (np.float64(side) - given) <= float(place.step)
    place = frame(jnp.zeros(3), (0.0, 0.7))
    found = onto(place, jnp.array([-1.0, 0.7, 3.0]))
    assert float(found[0]) == 0.0 and 0.699999 < float(found[1]) == float(found[2]) <= 0.7
    assert snap(jnp.array(0.3), jnp.array(0.25)) == 0.25


@pytest.mark.parametrize("signs", [(0, 0), (1, -1), (-1, 1)])
def test_convex_projection_equals_qp(signs: tuple[int, int]) -> None:
    where = ((0.0, 1.0, 1.5, 4.0, 5.0), (-1.0, 0.0, 1.0, 2.0, 3.0))
    config = PWLConfig(
        2, 5, keypoints=where, monotonicity=signs, convexity=(1, -1), output_range=(-0.5, 0.8),
        n_iterations=1000,
    )  # fmt: skip
    x = np.random.default_rng(3).normal(size=(2, 5)).astype(np.float32)
    y = jax.jit(lambda p: pwl.project(config, p))(PWLParams(jnp.asarray(x))).outputs
    for row in (0, 1):
        k, bend = np.asarray(where[row]), (1, -1)[row]
        rows = [
            _slopes(k, i, bend) for i in range(3)
        ] + [_step(i, signs[row]) for i in range(4) if signs[row]]  # fmt: skip
        np.testing.assert_allclose(y[row], qp.project(x[row], np.array(rows), -0.5, 0.8), atol=3e-4)


def _slopes(k: np.ndarray, i: int, bend: int) -> np.ndarray:
    """The slope after keypoint i + 1 less the slope before it."""
    row = np.zeros(5)
    row[i + 1 : i + 3] += np.array([-1.0, 1.0]) / (k[i + 2] - k[i + 1])
    row[i : i + 2] -= np.array([-1.0, 1.0]) / (k[i + 1] - k[i])
    return bend * row


def _step(i: int, sign: int) -> np.ndarray:
    row = np.zeros(5)
    row[i], row[i + 1] = -sign, sign
    return row


def test_vertices_of_large_lattices_start_feasible() -> None:
    config = LatticeConfig((2,) * 12, (1,) * 12, output_range=(0.0, 1.0))
    start = lattice_layer.init(jax.random.key(0), config)
    values = np.asarray(start.vertices)
    assert all((np.diff(values, axis=axis) >= 0).all() for axis in range(12))
    assert values.min() == 0.0 and values.max() == 1.0
    free = LatticeConfig((3, 2, 4), (1, 0, 0), output_range=(-1.0, 2.0))
    assert float(lattice_layer.check(free, lattice_layer.init(jax.random.key(1), free))) == 0.0
    assert isinstance(start, LatticeParams)
