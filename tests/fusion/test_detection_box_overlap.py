"""The one-stage detector's overlap loss against the evaluator's overlap."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.detection.config import DenseConfig
from fusion.detection.geometry.overlaps import box3d_iou
from fusion.detection.learning.box_overlap import _most_near, box_overlaps, overlap_loss
from fusion.detection.learning.dense_targets import decode_cells, grid_targets
from fusion.detection.network.dense import N_OUTPUTS
from fusion.detection.presets import preset
from tests.fusion.test_detection_dense import PLANE, _inputs

TINY = preset("tiny", "dense").config
TARGETS = jax.jit(partial(grid_targets, TINY))(
    _inputs(jnp.array([[-2.4, 1.5, 9.4, 4.2, 1.7, 1.5, 0.3]]), jnp.ones(1, bool))
)


def _told(error: jax.Array) -> jax.Array:
    return TARGETS.boxes + jnp.broadcast_to(error, TARGETS.boxes.shape)


def test_overlaps_are_those_of_the_evaluator() -> None:
    error = 0.2 * jax.random.normal(jax.random.key(0), TARGETS.boxes.shape)
    got = jax.jit(partial(box_overlaps, TINY))(TARGETS.boxes + error, TARGETS, PLANE)
    near = np.asarray(TARGETS.near)
    told, truth = (
        np.asarray(decode_cells(TINY, x, PLANE), np.float64).reshape(32, 32, 7)[near]
        for x in (TARGETS.boxes + error, TARGETS.boxes)
    )
    wanted = box3d_iou(told, truth)
    assert 0.2 < wanted.mean() < 0.9
    np.testing.assert_allclose(np.asarray(got)[near], wanted, atol=1e-4)
    np.testing.assert_allclose(np.asarray(got)[~near], 1.0, atol=1e-4)


@pytest.mark.parametrize(("cell", "radius"), [(0.5, 0.9), (0.5, 0.6), (1.0, 0.4), (0.5, 2.3)])
def test_all_cells_near_a_car_are_among_those_gathered(cell: float, radius: float) -> None:
    dense = dataclasses.replace(TINY.dense, cell=cell, radius=radius)
    config = dataclasses.replace(TINY, max_objects=1, dense=dense)
    places = np.random.RandomState(0).uniform([-6.0, 6.0], [6.0, 18.0], (200, 2))
    targets = jax.jit(partial(grid_targets, config))
    most = 0
    for x, z in places:
        frame = _inputs(jnp.array([[x, 1.5, z, 4.2, 1.7, 1.5, 0.3]]), jnp.ones(1, bool))
        near = targets(frame).near
        most = max(most, int(near.sum()))
    assert 1 <= most <= _most_near(config) < near.size


def test_the_loss_falls_with_the_overlap_and_pulls_the_box() -> None:
    loss = jax.jit(jax.value_and_grad(partial(overlap_loss, TINY)))
    shift = jnp.zeros(N_OUTPUTS - 1).at[0].set(0.4)
    values = []
    for scale in (0.0, 0.5, 1.0):
        value, slopes = loss(_told(scale * shift), TARGETS, PLANE)
        values.append(float(value))
        assert np.isfinite(slopes).all()
        assert not np.asarray(slopes)[~np.asarray(TARGETS.near)].any()
    assert values[0] < 1e-3 < values[1] < values[2]
    assert (np.asarray(slopes)[..., 0][np.asarray(TARGETS.near)] > 0).all()


def test_boxes_without_overlap_or_axis_have_a_finite_gradient() -> None:
    told = jnp.zeros((32, 32, N_OUTPUTS - 1)).at[..., :2].set(50.0)
    slopes = jax.jit(jax.grad(partial(overlap_loss, TINY)))(told, TARGETS, PLANE)
    assert np.isfinite(slopes).all()


def test_a_negative_weight_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"overlap_weight=-1\.0: expected a number >= 0"):
        DenseConfig(overlap_weight=-1.0)
