"""Constraints between inputs: definitions on the function, exact projection, no violation left."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from fusion.lattice import LatticeConfig, check_tree, lattice_layer, linen, with_projection
from fusion.lattice.interior import interior
from fusion.lattice.lattice_config import LatticeParams
from tests.fusion._lattice_steps import violations
from tests.reference import lattice_qp as qp

Direction = Callable[[np.ndarray], np.ndarray]


def _along(*parts: float) -> Direction:
    return lambda x: np.array(parts)


def _from_middle(direction: int, *middles: int) -> Direction:
    """Away from the middle of the inputs of a group, nowhere in the others, which have -1."""
    middle = np.array(middles)
    return lambda x: direction * np.where(middle >= 0, x - middle, 0)


def _trapezoid(
    sizes: tuple[int, ...], main: int, conditional: int, low: int, direction: int
) -> np.ndarray:
    """Differences along the conditional input where the main input is at an end."""
    high = sizes[main] - 1 - low

    def ends(vertex: np.ndarray) -> list[tuple[int, int, float]]:
        at = int(vertex[conditional])
        if vertex[main] not in (low, high) or at + 1 == sizes[conditional]:
            return []
        sign = direction * (1 if vertex[main] == high else -1)
        return [(conditional, at + 1, sign), (conditional, at, -sign)]

    return qp.range_rows(sizes, ends)


def _ranges(sizes: tuple[int, ...], strong: int, weak: int, weak_low: int = 0) -> np.ndarray:
    """The range over a rising dominant input less that over the weak one."""
    top, high = sizes[strong] - 1, sizes[weak] - 1 - weak_low
    return qp.range_rows(
        sizes,
        lambda v: [(strong, top, 1), (strong, 0, -1), (weak, high, -1), (weak, weak_low, 1)],
    )


# Options of a lattice, and rows made from the definitions in another way.
CASES: dict[str, tuple[LatticeConfig, np.ndarray]] = {
    "trapezoid": (
        LatticeConfig((3, 3), (1, 0), trapezoid_trust=((0, 1, 1),), output_range=(-0.6, 0.8)),
        _trapezoid((3, 3), 0, 1, 0, 1),
    ),
    "trapezoid_falling": (
        LatticeConfig(
            (2, 3, 2), (-1, 0, 1), edgeworth_trust=((2, 1, 1),), trapezoid_trust=((0, 1, -1),)
        ),
        _trapezoid((2, 3, 2), 0, 1, 1, -1),
    ),
    "trapezoid_of_monotone": (
        LatticeConfig((3, 3), (1, 1), trapezoid_trust=((0, 1, 1),)),
        _trapezoid((3, 3), 0, 1, 0, 1),
    ),
    "two_trapezoids": (
        LatticeConfig((2, 2, 3), (1, 1, 0), trapezoid_trust=((0, 2, 1), (1, 2, 1))),
        np.concatenate([_trapezoid((2, 2, 3), main, 2, 0, 1) for main in (0, 1)]),
    ),
    "dominance": (
        LatticeConfig((3, 3), (1, -1), dominance=((0, 1),), output_range=(-0.6, 0.8)),
        qp.slope_rows((3, 3), _along(1, 1)),
    ),
    "range_dominance": (
        LatticeConfig((3, 3), (1, 1), range_dominance=((0, 1),)), _ranges((3, 3), 0, 1)
    ),
    "range_dominance_falling": (
        LatticeConfig((2, 2, 4), (0, 1, -1), range_dominance=((1, 2),)),
        _ranges((2, 2, 4), 1, 2, 3),
    ),
    "joint": (
        LatticeConfig((3, 3), joint_monotonicity=((0, 1, 1),), output_range=(-0.6, 0.8)),
        qp.slope_rows((3, 3), _along(1, 1)),
    ),
    "joint_falling": (
        LatticeConfig((2, 2, 3), (0, 1, 0), joint_monotonicity=((2, 0, -1),)),
        qp.slope_rows((2, 2, 3), _along(-1, 0, -1)),
    ),
    "joint_valley": (
        LatticeConfig((3, 3), joint_unimodality=(((0, 1), 1),), output_range=(-0.6, 0.8)),
        qp.slope_rows((3, 3), _from_middle(1, 1, 1)),
    ),
    "joint_peak": (
        LatticeConfig((4, 2, 3), (0, 1, 0), joint_unimodality=(((2, 0), -1),)),
        qp.slope_rows((4, 2, 3), _from_middle(-1, 2, -1, 1)),
    ),
}  # fmt: skip


MANY = (
    "trapezoid_of_monotone", "trapezoid_falling", "two_trapezoids", "range_dominance_falling",
    "joint_falling", "joint_peak",
)  # fmt: skip
EACH = [pytest.param(name, marks=pytest.mark.slow if name in MANY else ()) for name in CASES]
"""Every case; those that take another program for what others show as well are slow."""


@functools.cache
def _projected(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Two random lattices and the nearest ones inside the constraints."""
    config = dataclasses.replace(CASES[name][0], n_iterations=1500)
    x = np.random.default_rng(5).normal(size=(2, *config.sizes)).astype(np.float32)
    project = jax.jit(jax.vmap(lambda v: lattice_layer.project(config, LatticeParams(v)).vertices))
    return x, np.asarray(project(x))


@pytest.mark.parametrize("name", EACH)
def test_projection_equals_qp(name: str) -> None:
    config, rows = CASES[name]
    orders = qp.lattice_rows(
        config.sizes, tuple(config.signs.tolist()), (0,) * config.rank, config.edgeworth_trust
    )
    for given, found in zip(*_projected(name), strict=True):
        assert float(lattice_layer.check(config, LatticeParams(jnp.asarray(found)))) == 0.0
        assert float(lattice_layer.check(config, LatticeParams(jnp.asarray(given)))) > 0.1
        expected = qp.project(given, np.concatenate([orders, rows]), *config.output_range)
        np.testing.assert_allclose(found, expected, atol=3e-4)


@pytest.mark.parametrize("name", CASES)
def test_check_measures_what_the_definition_says(name: str) -> None:
    config, rows = CASES[name]
    table = np.random.default_rng(2).normal(size=config.sizes).astype(np.float32)
    bare = dataclasses.replace(config, edgeworth_trust=(), output_range=(None, None))
    without = lattice_layer.check(
        LatticeConfig(config.sizes, config.monotonicity), LatticeParams(jnp.asarray(table))
    )
    worst = max(float(np.max(-rows @ table.ravel().astype(np.float64))), float(without), 0.0)
    assert float(lattice_layer.check(bare, LatticeParams(jnp.asarray(table)))) == pytest.approx(
        worst, rel=1e-5
    )


def _function(name: str) -> Callable[[np.ndarray], np.ndarray]:
    """The interpolated function of a projected lattice, at points `[n, 2]`."""
    vertices = LatticeParams(jnp.asarray(_projected(name)[1][0]))
    apply = jax.jit(lambda x: lattice_layer.apply(LatticeConfig((3, 3)), vertices, x))
    return lambda x: np.asarray(apply(jnp.asarray(x, jnp.float32)), np.float64)


def _points(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 2, (400, 2))


def test_the_range_over_the_main_input_widens() -> None:
    f, x, y = _function("trapezoid"), _points(0), _points(1)
    less, more = np.minimum(x[:, 1], y[:, 1]), np.maximum(x[:, 1], y[:, 1])
    low, high = np.zeros(400), np.full(400, 2.0)
    widened = [
        sign * (f(np.stack([end, more], 1)) - f(np.stack([end, less], 1)))
        for end, sign in ((low, -1), (high, 1))
    ]
    assert np.min(widened) > -1e-6
    assert np.max(widened) > 0.05


def test_a_step_in_the_dominant_input_does_more() -> None:
    f, x = _function("dominance"), _points(0) / 2 + np.array([0.0, 1.0])
    step = np.random.default_rng(3).uniform(0, 1, (400, 1))
    # Outputs fall with the weak input: a step down raises them.
    strong, weak = f(x + step * np.array([1.0, 0.0])), f(x - step * np.array([0.0, 1.0]))
    assert np.min(strong - weak) > -1e-6
    assert np.min(weak - f(x)) > -1e-6


def test_the_range_over_the_dominant_input_is_wider() -> None:
    f, x = _function("range_dominance"), _points(0)
    ends = [np.zeros(400), np.full(400, 2.0)]
    strong = f(np.stack([ends[1], x[:, 1]], 1)) - f(np.stack([ends[0], x[:, 1]], 1))
    weak = f(np.stack([x[:, 0], ends[1]], 1)) - f(np.stack([x[:, 0], ends[0]], 1))
    assert np.min(strong - weak) > -1e-6


def test_joint_growth_never_lowers_the_output() -> None:
    f, x = _function("joint"), _points(0) / 2
    step = np.random.default_rng(4).uniform(0, 1, (400, 1))
    assert np.min(f(x + step) - f(x)) > -1e-6
    assert np.min(f(x + step * np.array([1.0, 0.0])) - f(x)) < -0.05  # free in each input alone


def test_outputs_rise_along_every_ray_of_a_valley() -> None:
    f, x = _function("joint_valley"), _points(0)
    nearer = 1.0 + np.random.default_rng(4).uniform(0, 1, (400, 1)) * (x - 1.0)
    assert np.min(f(x) - f(nearer)) > -1e-6


@pytest.mark.parametrize("name", EACH)
def test_first_parameters_are_feasible_and_span_the_range(name: str) -> None:
    config = CASES[name][0]
    start = lattice_layer.init(jax.random.key(0), config)
    assert float(lattice_layer.check(config, start)) == 0.0
    low, high = config.output_range
    width = 1.0 if low is None or high is None else high - low
    assert float(jnp.ptp(start.vertices)) > 0.45 * width


@pytest.mark.parametrize("name", CASES)
def test_the_interior_keeps_its_slack(name: str) -> None:
    config, rows = CASES[name]
    inside, ties = config.interior
    rise = rows @ inside.ravel()
    forced = np.zeros(len(rows), bool)
    if ties is not None:
        for i, row in enumerate(rows):
            classes = np.bincount(ties.ravel(), weights=row)
            forced[i] = np.all(np.abs(classes) < 1e-9)
        np.testing.assert_allclose(rise[forced], 0.0, atol=1e-9)
        assert forced.any() and not forced.all()
    moving = ~forced & np.any(rows != 0, axis=1)
    assert np.min(rise[moving]) > 0.2
    assert inside.min() >= 0.0 and inside.max() < 20.0


def test_unconnected_inputs_take_no_programme_together() -> None:
    config = LatticeConfig((2,) * 14, (1,) * 13 + (0,), trapezoid_trust=((3, 13, 1),))
    found = interior(config.sizes, config.steps, config.relations)
    assert found is not None and found.vertices.shape == config.sizes
    assert all(np.min(np.diff(found.vertices, axis=axis)) >= 0.5 for axis in range(13) if axis != 3)


STEPPED = {
    "trusts": LatticeConfig(
        (3, 2, 3), (1, 1, 0), edgeworth_trust=((1, 2, 1),), trapezoid_trust=((0, 2, 1),),
        dominance=((0, 1),), output_range=(0.0, 1.0),
    ),
    "joint": LatticeConfig(
        (3, 3, 2), (0, 0, 1), joint_unimodality=(((0, 1), -1),), joint_monotonicity=((0, 2, 1),)
    ),
    "ranges": LatticeConfig(
        (3, 3), (1, -1), range_dominance=((0, 1),), trapezoid_trust=((0, 1, 1),)
    ),
}  # fmt: skip


@pytest.mark.relaxed  # flax and optax promote types
@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("joint", jnp.float32),
        pytest.param("trusts", jnp.bfloat16, marks=pytest.mark.slow),
        pytest.param("trusts", jnp.float32, marks=pytest.mark.slow),
        pytest.param("joint", jnp.bfloat16, marks=pytest.mark.slow),
        pytest.param("ranges", jnp.float32, marks=pytest.mark.slow),
        pytest.param("ranges", jnp.bfloat16, marks=pytest.mark.slow),
    ],
)
def test_no_violation_after_large_steps_of_a_flax_module(name: str, dtype: Any) -> None:
    config = STEPPED[name]
    model = linen.Lattice(config, param_dtype=dtype)
    x = jnp.zeros((1, config.rank))
    params = jax.jit(model.init)(jax.random.key(0), x)
    optimizer = with_projection(optax.chain(optax.scale_by_adam(), optax.scale(-0.7)))
    assert float(check_tree(params)) == 0.0
    assert violations(params, optimizer, 15).max() == 0.0


REFUSED = [
    ({"trapezoid_trust": ((1, 0, 1),)}, r"trapezoid_trust=\(1, 0, 1\): expected a monotone main"),
    ({"trapezoid_trust": ((0, 0, 1),)}, "two different inputs of 0..1 and direction"),
    ({"trapezoid_trust": ((0, 1),)}, r"trapezoid_trust=\(0, 1\): expected \(main, conditional"),
    ({"trapezoid_trust": (0, 1, 1)}, "trapezoid_trust=0: expected"),
    ({"dominance": ((0, 1),)}, "expected two monotone inputs, not the free input 1"),
    ({"range_dominance": ((0, 2),)}, r"\(dominant, weak\) with two different inputs of 0..1"),
    ({"joint_monotonicity": ((0, 1, 2),)}, "direction -1 or 1"),
    (
        {"joint_monotonicity": ((0, 1, 1), (1, 0, -1))},
        "one direction for inputs .* not opposite directions; keep one",
    ),
    ({"joint_unimodality": ((0, 1),)}, r"joint_unimodality=\(0, 1\): expected \(\(inputs\), direc"),
    ({"joint_unimodality": (((0, 1), 1),)}, "input 0 has 3 and monotonicity 1"),
    ({"monotonicity": (1, 1), "dominance": ((0, 1), (1, 0))}, "leaves room to the others"),
    (
        {"joint_monotonicity": ((0, 1, -1),), "monotonicity": (1, 1)},
        r"joint_monotonicity=\(0, 1, -1\): expected a constraint that leaves room",
    ),
    (
        {"joint_monotonicity": ((0, 1, 1),), "interpolation": "simplex"},
        "expected 'hypercube' beside joint_monotonicity",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("options", "message"), REFUSED, ids=[str(i) for i in range(len(REFUSED))])
def test_what_means_nothing_is_refused(options: dict, message: str) -> None:
    settings = {"sizes": (3, 4), "monotonicity": (1, 0), **options}
    config = object.__new__(LatticeConfig)
    for field in dataclasses.fields(LatticeConfig):
        object.__setattr__(config, field.name, settings.get(field.name, field.default))
    with pytest.raises(ValueError, match=message) as refused:
        config.__post_init__()
    assert "; " in str(refused.value)
