"""Checks of lidar, camera and labels: a made car, and what a wrong calibration does to them."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.detection.kitti.calibration import Calibration
from fusion.detection.kitti.files import Frame
from fusion.detection.kitti.objects import Objects, points_inside
from tests._scripts import load_script

study = load_script("studies/study_geometry")
align_frame, projected_boxes = study.align_frame, study.projected_boxes

P2 = np.array([[700.0, 0, 620, 40], [0, 700.0, 187, 0], [0, 0, 1, 0]])
VELO = np.array([[0.0, -1, 0, 0.02], [0, 0, -1, -0.06], [1, 0, 0, -0.3]])
HEIGHT, WIDTH, LENGTH, YAW = 1.5, 1.7, 4.2, 0.4
PLACE = np.array([2.0, 1.65, 18.0])


def car(bbox: np.ndarray) -> Objects:
    one = np.zeros(1)
    return Objects(
        np.array(["Car"]), one, np.zeros(1, np.int64), one, bbox[None],
        np.array([[HEIGHT, WIDTH, LENGTH]]), PLACE[None], np.array([YAW]), np.full(1, np.nan),
    )  # fmt: skip


def corner_box(p2: np.ndarray = P2) -> np.ndarray:
    """The image box by the definition of the label file, written out with a loop."""
    pixels = []
    for along in (-LENGTH / 2, LENGTH / 2):
        for across in (-WIDTH / 2, WIDTH / 2):
            for up in (0.0, HEIGHT):
                x = PLACE[0] + along * np.cos(YAW) + across * np.sin(YAW)
                z = PLACE[2] - along * np.sin(YAW) + across * np.cos(YAW)
                u, v, w = p2 @ [x, PLACE[1] - up, z, 1.0]
                pixels.append([u / w, v / w])
    return np.concatenate([np.min(pixels, 0), np.max(pixels, 0)])


def frame(calibration: Calibration, labels: Objects | None, plane: bool = True) -> Frame:
    """Points on the sides of the car and on the road, seen by a lidar with the true VELO."""
    rng = np.random.default_rng(0)
    n = 400
    side = rng.choice([-0.499, 0.499], n)
    free = rng.uniform(-0.499, 0.499, n)
    swap = rng.random(n) < 0.5
    along, across = np.where(swap, side, free) * LENGTH, np.where(swap, free, side) * WIDTH
    up = rng.uniform(0.01, HEIGHT - 0.01, n)
    x = PLACE[0] + along * np.cos(YAW) + across * np.sin(YAW)
    z = PLACE[2] - along * np.sin(YAW) + across * np.cos(YAW)
    body = np.stack([x, PLACE[1] - up, z], 1)
    road = np.stack([rng.uniform(-9, 9, 900), np.full(900, 1.65), rng.uniform(4, 29, 900)], 1)
    camera = np.concatenate([body, road])
    lidar = (camera - VELO[:, 3]) @ VELO[:, :3]
    points = np.concatenate([lidar, np.zeros((len(lidar), 1))], 1).astype(np.float32)
    image = np.zeros((375, 1242, 3), np.uint8)
    given = np.array([0.0, -1, 0, 1.65]) if plane else None
    return Frame("000000", image, points, calibration, labels, given)


def calibration(p2: np.ndarray = P2, velo: np.ndarray = VELO) -> Calibration:
    return Calibration(np.stack([p2] * 4), np.eye(3), velo, np.eye(3, 4))


def test_a_consistent_frame_agrees_and_a_turned_scan_does_not() -> None:
    found = align_frame(frame(calibration(), car(corner_box())), turn=3.0)
    assert found.in_box.tolist() == found.in_both.tolist() == [400]
    assert found.around.tolist() == found.around_in.tolist() and found.around[0] > 250
    assert found.turned_in[0] < 0.75 * found.turned[0]
    np.testing.assert_allclose(found.overlap, 1.0, atol=1e-4)
    assert found.lidar_error < 1e-9 and found.image_error < 1e-9
    assert found.plane is not None and max(found.plane) < 0.01
    np.testing.assert_allclose(found.standing, 0.0, atol=1e-3)


def test_a_wrong_projection_is_seen() -> None:
    wrong = P2.copy()
    wrong[0, 2] += 40.0  # a resized or cropped picture
    found = align_frame(frame(calibration(p2=wrong), car(corner_box()), plane=False))
    assert found.in_box.tolist() == [400] and found.in_both[0] < 350
    assert found.overlap[0] < 0.75 and found.plane is None
    np.testing.assert_allclose(
        projected_boxes(frame(calibration(), None), car(corner_box()))[0], corner_box(), atol=0.01
    )


def test_margin_and_clearance() -> None:
    box = car(corner_box())
    ahead = np.array([np.cos(YAW), 0.0, -np.sin(YAW)])
    points = PLACE + np.stack(
        [[0, -0.1, 0], [0, 0.1, 0], [0, -1.6, 0], 2.3 * ahead - [0, 1, 0], 2.0 * ahead - [0, 1, 0]]
    )
    assert points_inside(points, box)[:, 0].tolist() == [True, False, False, False, True]
    grown = points_inside(points, box, margin=0.5, clearance=0.3)[:, 0]
    assert grown.tolist() == [False, False, False, True, True]
    with pytest.raises(ValueError, match="frame 000000 has no labels"):
        align_frame(frame(calibration(), None))
