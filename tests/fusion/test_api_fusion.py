"""The numeric functions of `fusion` under jit, vmap, scan and grad: one table."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion import (
    bayesian_linear,
    failure_kinds,
    failures,
    gating,
    losses,
    stacked,
    targets,
)
from fusion.detection.geometry import encodings, overlaps, suppression
from fusion.detection.learning import detection_loss
from fusion.detection.network import crop
from fusion.lattice import (
    categorical,
    deep_lattice,
    ensemble,
    lattice_config,
    lattice_layer,
    linear,
    projections,
    pwl,
    regularizers,
    rounding,
)
from tests._api import Case, check

INTEGERS = "gives integers or booleans"
LOSS = losses.LossParams(*(np.float32(v) for v in (1.0, 0.5, 0.7, 0.2)))
TARGETS = targets.TargetConfig(n_keypoints=3, n_hidden_keypoints=3, lattice_size=2)
PWL = pwl.PWLConfig(2, 4, monotonicity=1, output_range=(0.0, 1.0))
LINEAR = linear.LinearConfig(3, 2, monotonicity=(1, 0, -1), normalized=True)
LATTICE = lattice_config.LatticeConfig((3, 2), monotonicity=(1, 0), output_range=(0.0, 1.0))
CATEGORIES = categorical.CategoricalConfig(4, order=((0, 1), (1, 3)))
ENSEMBLE = ensemble.EnsembleConfig(3, ((0, 1), (1, 2)), monotonicity=(1, 0, 0))
DEEP = deep_lattice.DeepLatticeConfig(2, monotonicity=(-1, 0), n_keypoints=3, n_hidden_keypoints=3)
CHANNELS = failures.random_failing(("a", "b", "c"), n_clean=1)
PLANE = np.array([0.0, -1.0, 0.0, 1.65], np.float32)
CLOSURE = projections.order_closure(((0, 1), (1, 2)), 3)


def f32(*values: Any) -> tuple:
    return tuple(np.asarray(v, np.float32) for v in values)


def key(rng: np.random.Generator) -> jax.Array:
    return jax.random.key(int(rng.integers(2**31)))


def normal(*shapes: tuple[int, ...]) -> Any:
    """Arguments drawn from a normal distribution."""
    return lambda rng: f32(*(rng.normal(size=shape) for shape in shapes))


def shares(rng: np.random.Generator, *shape: int) -> np.ndarray:
    raw = rng.uniform(0.2, 1.0, shape)
    return np.asarray(raw / raw.sum(-1, keepdims=True), np.float32)


@functools.cache
def start_of(module: Any, config: Any) -> Any:
    """A layer's first parameters."""
    return jax.jit(lambda k: module.init(k, config))(jax.random.key(0))


def layer(config: Any, module: Any, *inputs: Any) -> Any:
    """Parameters of a lattice layer, moved off their constraints, and inputs."""

    def make(rng: np.random.Generator) -> tuple:
        start = start_of(module, config)
        moved = jax.tree.map(
            lambda p: np.asarray(p + 0.3 * rng.normal(size=p.shape), np.float32), start
        )
        return (moved, *(x(rng) if callable(x) else x for x in inputs))

    return make


def layer_cases(name: str, module: Any, config: Any, inputs: Any) -> list[Case]:
    """`apply`, `project` and `check` of one kind of layer."""
    return [
        Case(
            f"lattice.{name}.apply",
            lambda p, x: module.apply(config, p, x),
            layer(config, module, inputs),
        ),
        Case(
            f"lattice.{name}.project",
            lambda p: module.project(config, p),
            layer(config, module),
            (),
            "a projection; the optimizer applies it after the step",
        ),
        Case(
            f"lattice.{name}.check",
            lambda p: module.check(config, p),
            layer(config, module),
            (),
            "a test of feasibility",
        ),
    ]


def unit(*shape: int) -> Any:
    return lambda rng: np.asarray(rng.uniform(0.05, 0.95, shape), np.float32)


def batch(rng: np.random.Generator) -> tuple:
    labels = rng.integers(0, 3, 4).astype(np.int32)
    return (
        LOSS,
        *f32(rng.normal(size=(4, 3))),
        labels,
        shares(rng, 4, 2),
        *f32(rng.uniform(0.2, 2.0, (4, 2))),
        shares(rng, 4, 2),
    )


def boxes(rng: np.random.Generator, n: int = 3) -> np.ndarray:
    """x, y, z, length, width, height, rotation in the camera frame of KITTI."""
    low, high = [-4, 1.4, 10, 3, 1.4, 1.3, -1.2], [4, 1.7, 20, 4.5, 1.9, 1.8, 1.2]
    return np.asarray(rng.uniform(low, high, (n, 7)), np.float32)


def anchors(rng: np.random.Generator) -> np.ndarray:
    return np.asarray(
        rng.uniform([-4, 1, 10, 3, 1.4, 1.3], [4, 2, 20, 5, 2, 2], (3, 6)), np.float32
    )


def upright(rng: np.random.Generator, n: int) -> np.ndarray:
    corner = rng.uniform(0, 5, (n, 2))
    return np.asarray(np.concatenate([corner, corner + rng.uniform(1, 5, (n, 2))], 1), np.float32)


CASES = [
    Case(
        "gating.normalize (softmax)", lambda s: gating.normalize(s, "softmax") ** 2, normal((4, 3))
    ),
    Case(
        "gating.normalize (softmax_sigmoid)",
        lambda s: gating.normalize(s, "softmax_sigmoid") ** 2,
        normal((4, 3)),
    ),
    Case(
        "gating.oracle_weights",
        gating.oracle_weights,
        lambda rng: (rng.random((4, 3)) < 0.5,),
        (),
        "of a mask",
    ),
    Case(
        "gating.apply_weights",
        lambda z, w: gating.apply_weights(z, w, "concat", "mean"),
        lambda rng: (*f32(rng.normal(size=(3, 4, 2))), shares(rng, 4, 3)),
        (0, 1),
    ),
    Case(
        "gating.drop_modalities",
        lambda k, z: gating.drop_modalities(z, 0.5, key=k),
        lambda rng: (key(rng), *f32(rng.normal(size=(3, 4, 2)))),
        (1,),
    ),
    Case(
        "gating.embrace",
        lambda z, k: gating.embrace(z, key=k),
        lambda rng: (*f32(rng.normal(size=(3, 4, 5))), key(rng)),
    ),
    Case(
        "losses.cross_entropy",
        lambda x, y: losses.cross_entropy(x, y, 0.05),
        lambda rng: (*f32(rng.normal(size=(4, 3))), rng.integers(0, 3, 4).astype(np.int32)),
    ),
    Case(
        "losses.loss_targets",
        lambda a, tau: losses.loss_targets(a, "softmax", tau) ** 2,
        lambda rng: f32(rng.uniform(0, 2, (4, 3)), 0.5),
        (0, 1),
    ),
    Case(
        "losses.argate_loss",
        lambda p, x, y, w, a, t: losses.argate_loss(
            losses.LossConfig(stop_targets=False), p, x, y, w, a, t
        ),
        batch,
        (0, 1, 3, 4, 5),
    ),
    Case(
        "losses.gate_penalty",
        lambda p, w, a, t: losses.gate_penalty(losses.LossConfig(stop_targets=False), p, w, a, t),
        lambda rng: (
            LOSS,
            shares(rng, 4, 2),
            *f32(rng.uniform(0.2, 2.0, (4, 2))),
            shares(rng, 4, 2),
        ),
        (0, 1, 2, 3),
    ),
    Case(
        "gating.available_weights",
        gating.available_weights,
        lambda rng: (shares(rng, 4, 3), rng.random((4, 3)) < 0.7),
    ),
    Case(
        "targets.apply_targets",
        lambda x: targets.apply_targets(TARGETS, _target_params(), x) ** 2,
        lambda rng: f32(rng.uniform(0.1, 3.0, (4, 2))),
    ),
    Case(
        "bayesian_linear.predict_linear",
        lambda x, y, new: bayesian_linear.predict_linear(
            bayesian_linear.fit_linear(x, y, iterations=3), new
        )[0],
        normal((8, 2), (8, 3), (4, 2)),
        (2,),
    ),
    Case(
        "stacked.conv1d",
        lambda x, w, b: stacked.conv1d(x, w, b, stride=2),
        normal((2, 3, 8, 2), (2, 3, 2, 4), (2, 4)),
        (0, 1, 2),
    ),
    Case(
        "failures.draw_mask",
        lambda k: failures.draw_mask(CHANNELS, 6, key=k),
        lambda rng: (key(rng),),
        (),
        INTEGERS,
    ),
    *(
        Case(
            f"failure_kinds.apply_failure ({kind})",
            lambda k, x, m, s, kind=kind: failure_kinds.apply_failure(
                x, m, kind, key=k, severity=s
            ),
            lambda rng: (
                key(rng),
                *f32(rng.uniform(-0.9, 0.9, (3, 2, 8))),
                np.array([[True, False]] * 3),
                *f32(0.8),
            ),
            (1,),
        )
        for kind in ("uniform", "drift", "stuck", "gain")
    ),
    Case(
        "failures.corrupt",
        lambda k, x: failures.corrupt(CHANNELS, x, "gaussian", key=k),
        lambda rng: (key(rng), *f32(rng.uniform(-0.9, 0.9, (6, 3, 4)))),
        (1,),
    ),
    *layer_cases("pwl", pwl, PWL, unit(5, 2)),
    *layer_cases("linear", linear, LINEAR, unit(5, 3)),
    *layer_cases("lattice_layer", lattice_layer, LATTICE, unit(5, 2)),
    *layer_cases("ensemble", ensemble, ENSEMBLE, unit(5, 3)),
    *layer_cases("deep_lattice", deep_lattice, DEEP, unit(5, 2)),
    *layer_cases(
        "categorical", categorical, CATEGORIES, lambda rng: rng.integers(0, 4, 5).astype(np.int32)
    ),
    *(
        Case(
            f"lattice.regularizers.{f.__name__}",
            lambda p, f=f: f(p, l1=0.1, l2=0.2),
            layer(config, module),
        )
        for f, module, config in (
            (regularizers.pwl_laplacian, pwl, PWL),
            (regularizers.pwl_hessian, pwl, PWL),
            (regularizers.pwl_wrinkle, pwl, PWL),
            (regularizers.lattice_laplacian, lattice_layer, LATTICE),
            (regularizers.lattice_torsion, lattice_layer, LATTICE),
        )
    ),
    Case("lattice.projections.isotonic", lambda v: projections.isotonic(v) ** 2, normal((2, 5))),
    Case(
        "lattice.rounding.onto",
        lambda v: rounding.onto(rounding.frame(v, (0.0, 1.0)), v),
        normal((4,)),
        (),
        "rounds to steps",
    ),
    Case(
        "lattice.projections.dykstra",
        lambda v: projections.dykstra(v, projections.pair_projections(CLOSURE), 4) ** 2,
        normal((3,)),
    ),
    Case(
        "lattice.projections.repair_order",
        lambda v: projections.repair_order(v, CLOSURE) ** 2,
        normal((3,)),
    ),
    Case(
        "detection.geometry.encodings.box_corners",
        encodings.box_corners,
        lambda rng: (boxes(rng),),
    ),
    Case(
        "detection.geometry.encodings.box3d_to_box4c",
        lambda b: encodings.box3d_to_box4c(b, jnp.asarray(PLANE)),
        lambda rng: (boxes(rng),),
    ),
    Case(
        "detection.geometry.encodings.encode_offsets",
        encodings.encode_offsets,
        lambda rng: (anchors(rng), anchors(rng)),
        (0, 1),
    ),
    Case(
        "detection.geometry.encodings.decode_offsets",
        encodings.decode_offsets,
        lambda rng: (anchors(rng), *f32(0.1 * rng.normal(size=(3, 6)))),
        (0, 1),
    ),
    Case(
        "detection.geometry.encodings.angle_vector",
        encodings.angle_vector,
        lambda rng: f32(rng.uniform(-3, 3, 4)),
    ),
    Case(
        "detection.geometry.overlaps.image_iou",
        overlaps.image_iou,
        lambda rng: (upright(rng, 4), upright(rng, 4)),
        (0, 1),
    ),
    Case(
        "detection.geometry.suppression.nms",
        lambda b, s: suppression.nms(
            b, s, jnp.ones(5, bool), iou_threshold=0.5, max_output=3, max_candidates=5
        ),
        lambda rng: (upright(rng, 5), *f32(rng.random(5))),
        (),
        INTEGERS,
    ),
    Case(
        "detection.network.crop.crop_and_resize",
        lambda f, b: crop.crop_and_resize(f, b, (2, 2)),
        lambda rng: f32(rng.normal(size=(6, 6, 2)), [[0.1, 0.1, 0.6, 0.7], [0.2, 0.3, 0.9, 0.8]]),
    ),
    Case("detection.learning.detection_loss.smooth_l1", detection_loss.smooth_l1, normal((6,))),
]


def _target_params() -> Any:
    return targets.init_targets(jax.random.key(0), TARGETS, 2)


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_jit_once_vmap_is_scan_and_slopes_are_finite(case: Case) -> None:
    check(case)
