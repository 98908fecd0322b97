"""Cars of another frame: where they have room they come with points, pixels and label."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fusion.detection.geometry.inside import points_in_boxes
from fusion.detection.learning.examples import Example, make_example
from fusion.detection.learning.pasting import paste_objects
from fusion.detection.learning.training import DetectorTrainConfig
from fusion.detection.presets import preset
from tests.fusion.test_detection_network import a_frame

TINY = preset("tiny", "dense").config
PASTE = jax.jit(partial(paste_objects, key=jax.random.key(0)))
OTHER, _ = make_example(TINY, a_frame())
CAR = OTHER.truth[1:2]  # the far one


def _camera(example: Example) -> np.ndarray:
    matrix = np.asarray(example.to_camera)
    return np.asarray(example.points)[:, :3] @ matrix[:, :3].T + matrix[:, 3]


def _in_box(example: Example, boxes: np.ndarray, margin: float = 0.2) -> np.ndarray:
    inside = points_in_boxes(jnp.asarray(_camera(example)), jnp.asarray(boxes), margin=margin)
    return np.asarray(inside).any(axis=1) & np.asarray(example.point_mask)


def _host(seed: int = 1) -> Example:
    """Another frame of the near car alone, in a darker picture."""
    made, _ = make_example(TINY, a_frame(seed))
    truth = made.truth.copy()
    truth[1] = 0.0
    mask = np.asarray(made.point_mask) & ~_in_box(made, CAR)
    return made._replace(
        truth=truth, truth_mask=truth[:, 3] > 0, point_mask=mask, image=made.image // 2,
        points=np.where(mask[:, None], made.points, 0.0),
    )  # fmt: skip


def test_a_car_with_room_comes_with_points_pixels_and_label() -> None:
    host = _host()
    got = PASTE(host, OTHER, 1.0)
    np.testing.assert_allclose(got.truth[:2], np.stack([host.truth[0], CAR[0]]), atol=1e-5)
    assert got.truth_mask.tolist() == [True, True, False, False] and not got.ignored.any()
    theirs = _camera(OTHER)[_in_box(OTHER, CAR)]
    assert len(theirs) > 100 and _in_box(host, CAR).sum() == 0
    mine = _camera(got)[_in_box(got, CAR)]
    np.testing.assert_allclose(np.sort(mine, axis=0), np.sort(theirs, axis=0), atol=1e-4)
    # The near car and its points are what they were.
    near = [_camera(e)[_in_box(e, host.truth[:1])] for e in (host, got)]
    np.testing.assert_allclose(*near, atol=1e-4)
    # The car stands from x = 62 to 72 and y = 16.5 to 25 of 96 x 32 pixels.
    pixels = np.asarray(got.image)
    np.testing.assert_array_equal(pixels[9:12, 32:35], OTHER.image[9:12, 32:35])
    np.testing.assert_array_equal(pixels[:, :28], host.image[:, :28])
    np.testing.assert_array_equal(pixels[:6], host.image[:6])
    assert not np.asarray(got.points)[~np.asarray(got.point_mask)].any()


def test_what_the_car_covers_goes() -> None:
    host = _host()
    got = PASTE(host, OTHER, 1.0)
    camera = _camera(got)[np.asarray(got.point_mask)]
    u, v = 70 * camera[:, 0] / camera[:, 2] + 48, 70 * camera[:, 1] / camera[:, 2] + 16
    shadow = (u > 63) & (u < 71) & (v > 17) & (v < 25) & (camera[:, 2] > 17)
    assert shadow.sum() == 0
    before = _camera(host)[np.asarray(host.point_mask)]
    u, v = 70 * before[:, 0] / before[:, 2] + 48, 70 * before[:, 1] / before[:, 2] + 16
    assert ((u > 63) & (u < 71) & (v > 17) & (v < 25) & (before[:, 2] > 17)).sum() > 0


def test_it_stands_on_the_ground_of_the_frame() -> None:
    host = _host()._replace(plane=np.array([0.0, -1.0, 0.0, 1.8], np.float32))
    got = PASTE(host, OTHER, 1.0)
    np.testing.assert_allclose(got.truth[1], CAR[0] + np.array([0, 0.2, 0, 0, 0, 0, 0]), atol=1e-5)
    raised = np.asarray(got.truth[1:2])
    theirs = _camera(OTHER)[_in_box(OTHER, CAR)]
    mine = _camera(got)[_in_box(got, raised)]
    np.testing.assert_allclose(mine.mean(0) - theirs.mean(0), [0, 0.2, 0], atol=1e-3)


def test_nothing_comes_where_there_is_no_room_or_share() -> None:
    host = _host()
    full = make_example(TINY, a_frame(1))[0]
    many = np.repeat(host.truth[:1], 4, axis=0)
    taken = host._replace(truth=many, truth_mask=np.ones(4, bool))
    # The same places are taken; all rows are taken; no car is drawn.
    for frame, share in ((full, 1.0), (taken, 1.0), (host, 0.0)):
        got = PASTE(frame, OTHER, share)
        np.testing.assert_array_equal(got.truth, frame.truth)
        np.testing.assert_array_equal(got.image, frame.image)
        np.testing.assert_array_equal(got.point_mask, np.sort(frame.point_mask)[::-1])
        assert np.asarray(got.points).sum() == pytest.approx(frame.points.sum(), rel=1e-5)


def test_a_share_without_other_frames_is_refused() -> None:
    with pytest.raises(ValueError, match=r"pasting=0\.5, batch_size=1: expected at least 2"):
        DetectorTrainConfig(pasting=0.5)
    with pytest.raises(ValueError, match=r"pasting=1\.5: expected a share"):
        dataclasses.replace(DetectorTrainConfig(batch_size=2), pasting=1.5)
