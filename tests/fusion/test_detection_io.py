"""KITTI files: round trips, strict parsing with file and line, geometry on real frames."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from fusion.detection.kitti.calibration import (
    Calibration,
    back_project,
    camera_to_lidar,
    check_calibration,
    in_image,
    lidar_to_camera,
    project,
)
from fusion.detection.kitti.files import (
    frame_names,
    read_calibration,
    read_frame,
    read_image,
    read_labels,
    read_plane,
    read_points,
    read_results,
    read_split,
    write_calibration,
    write_image,
    write_labels,
    write_plane,
    write_points,
    write_results,
    write_split,
)
from fusion.detection.kitti.objects import Objects, concatenate, empty, select

CAR = "Car 0.00 1 1.80 316.11 191.89 461.97 282.37 1.37 1.64 4.40 -4.07 1.78 13.88 1.52"
CARE = "DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10"


def rotation(axis: int, angle: float) -> np.ndarray:
    r = np.eye(3)
    i, j = [(1, 2), (0, 2), (0, 1)][axis]
    r[[i, j, i, j], [i, j, j, i]] = np.cos(angle), np.cos(angle), -np.sin(angle), np.sin(angle)
    return r


@pytest.fixture
def calibration() -> Calibration:
    p = np.array([[707.05, 0, 604.08, 45.76], [0, 707.05, 180.51, -0.345], [0, 0, 1, 0.005]])
    axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    velo = np.concatenate([axes @ rotation(1, 0.01), [[-0.02], [-0.06], [-0.33]]], axis=1)
    return Calibration(np.stack([p] * 4), rotation(0, 0.02), velo, np.eye(3, 4))


def assert_same(a: Objects, b: Objects) -> None:
    for field in dataclasses.fields(Objects):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


def test_labels_and_results_come_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "label_2" / "000000.txt"
    path.parent.mkdir()
    path.write_text(f"{CAR}\n\n{CARE}\n")
    labels = read_labels(path)
    assert labels.type.tolist() == ["Car", "DontCare"]
    assert labels.occluded.tolist() == [1, -1]
    np.testing.assert_array_equal(labels.bbox[0], [316.11, 191.89, 461.97, 282.37])
    np.testing.assert_array_equal(labels.dimensions[0], [1.37, 1.64, 4.40])
    np.testing.assert_array_equal(labels.location[0], [-4.07, 1.78, 13.88])
    assert (labels.alpha[0], labels.rotation_y[0]) == (1.80, 1.52)
    assert np.isnan(labels.score).all()
    write_labels(tmp_path / "again.txt", labels)
    assert_same(read_labels(tmp_path / "again.txt"), labels)

    found = dataclasses.replace(select(labels, np.array([0, 0])), score=np.array([0.125, -3.5]))
    write_results(tmp_path / "found.txt", found)
    assert_same(read_results(tmp_path / "found.txt"), found)
    write_results(tmp_path / "none.txt", empty())
    assert len(read_results(tmp_path / "none.txt")) == 0
    assert_same(concatenate([found, empty(), labels]), concatenate([found, labels]))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (CAR.replace("Car", "Bus"), "class 'Bus', expected one of Car, Van"),
        (CAR.replace("13.88", "13,88"), "z is '13,88', expected a number"),
        (CAR.replace("13.88", "nan"), "z is 'nan', expected a finite number"),
        (CAR.replace(" 13.88", ""), "14 fields, expected 15"),
        (CAR + " 0.9", "16 fields, expected 15 .a result file"),
        (CAR.replace("0.00", "1.20"), "truncated is 1.2, expected 0 to 1"),
        (CAR.replace(" 1 ", " 7 "), "occluded is 7, expected -1, 0, 1, 2 or 3"),
        (CAR.replace("461.97", "300"), "left <= right"),
        (CAR.replace("1.64", "0"), "height, width, length 1.37 0 4.4: expected all above 0"),
    ],
)
def test_a_wrong_label_names_file_and_line(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "000007.txt"
    path.write_text(f"{CAR}\n{line}\n")
    with pytest.raises(ValueError, match=rf"000007\.txt, line 2: .*{message}"):
        read_labels(path)


def test_results_need_scores(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(CAR + "\n")
    with pytest.raises(ValueError, match=r"line 1: 15 fields, expected 16 .a label file"):
        read_results(tmp_path / "a.txt")
    with pytest.raises(ValueError, match=r"object 0 holds NaN or inf.*need a score"):
        write_results(tmp_path / "b.txt", read_labels(tmp_path / "a.txt"))
    with pytest.raises(FileNotFoundError, match=r"c\.txt does not exist"):
        read_results(tmp_path / "c.txt")


def test_calibration_round_trip_and_errors(tmp_path: Path, calibration: Calibration) -> None:
    path = tmp_path / "000001.txt"
    write_calibration(path, calibration)
    again = read_calibration(path)
    for a, b in zip(again, calibration, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-15)
    text = path.read_text()
    for old, new, message in (
        ("R0_rect:", "R_rect:", "R0_rect missing, expected P2, R0_rect"),
        ("R0_rect: ", "R0_rect: 1.0 ", r"line 5: R0_rect has 10 values, expected 9"),
        ("Tr_velo_to_cam: ", "Tr_velo_to_cam: x", r"line 6: Tr_velo_to_cam is 'x.*a number"),
        ("P3:", "P3", r"line 4: expected 'NAME: values'"),
        ("P3:", "P2:", "line 4: a second P2: expected each matrix once"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(ValueError, match=message):
            read_calibration(path)
    # Own sensors: three matrices, spaces before the colon, a byte-order mark.
    needed = [line for line in text.splitlines() if line.startswith(("P2", "R0", "Tr_velo"))]
    path.write_text("\ufeff" + "\n".join(needed).replace("P2:", "P2 :"), encoding="utf-8")
    own = read_calibration(path)
    np.testing.assert_allclose(own.p2, calibration.p2, rtol=1e-12)
    assert np.isnan(own.projections[0]).all() and np.isnan(own.imu_to_velo).all()
    write_calibration(path, own)
    assert len(path.read_text().splitlines()) == 3
    np.testing.assert_array_equal(read_calibration(path).velo_to_cam, own.velo_to_cam)
    mirrored = calibration._replace(r0_rect=np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(ValueError, match="R0_rect is not a rotation"):
        check_calibration(mirrored)


def test_transforms_invert_each_other(calibration: Calibration) -> None:
    rng = np.random.default_rng(0)
    lidar = rng.uniform([2, -20, -2], [70, 20, 2], (50, 3))
    camera = lidar_to_camera(calibration, lidar)
    # Lidar x is forward, y left, z up; camera z is forward, x right, y down.
    np.testing.assert_allclose(camera, lidar[:, [1, 2, 0]] * [-1, -1, 1], atol=3.0)
    np.testing.assert_allclose(camera_to_lidar(calibration, camera), lidar, atol=1e-10)
    pixels, depth = project(calibration, camera)
    np.testing.assert_allclose(back_project(calibration, pixels, depth), camera, atol=1e-10)
    # The pinhole formula, written out.
    x, y, z = camera[0]
    w = z + 0.005
    expected = [(707.05 * x + 604.08 * z + 45.76) / w, (707.05 * y + 180.51 * z - 0.345) / w]
    np.testing.assert_allclose(pixels[0], expected)


def test_in_image_needs_depth_and_bounds() -> None:
    pixels = np.array([[0.0, 0.0], [9.9, 4.9], [10.0, 2.0], [5.0, -0.1], [5.0, 2.0], [np.nan, 1.0]])
    depth = np.array([1.0, 1.0, 1.0, 1.0, -1.0, 0.0])
    assert in_image(pixels, depth, 5, 10).tolist() == [True, True, False, False, False, False]


def test_points(tmp_path: Path) -> None:
    path = tmp_path / "000000.bin"
    points = np.arange(12, dtype=np.float32).reshape(3, 4)
    write_points(path, points)
    np.testing.assert_array_equal(read_points(path), points)
    points[1, 2] = np.nan
    write_points(path, points)
    with pytest.raises(ValueError, match=r"000000\.bin: 1 of 3 points hold NaN.*first: point 1"):
        read_points(path)
    np.testing.assert_array_equal(read_points(path, drop_invalid=True), points[[0, 2]])
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="0 bytes, expected a positive multiple of 16"):
        read_points(path)
    path.write_bytes(b"123")
    with pytest.raises(ValueError, match="3 bytes"):
        read_points(path)
    rng = np.random.default_rng(0)
    good = rng.uniform([2, -30, -2, 0], [70, 30, 2, 1], (120, 4))
    scan = good.astype("<f4")
    for data, message in (
        (good.astype("<f8"), r"reads as 120 points of 4 columns in float64: write x, y, z, refl"),
        (scan[:, :3], r"reflectances from -.* reads as 120 points of 3 columns in float32"),
        (np.c_[scan, np.arange(120, dtype="<f4") % 64], r"reads as 120 points of 5 columns in fl"),
        (scan * np.array([1e3, 1e3, 1e3, 1], "<f4"), r"\(in millimetres\?\), expected metres"),
        (scan - np.array([0, 0, 0, 0.5], "<f4"), r"reflectances from -0.* expected 0 to 1"),
    ):
        path.write_bytes(np.ascontiguousarray(data).tobytes())
        with pytest.raises(ValueError, match=message):
            read_points(path)
    path.write_bytes((scan * np.array([1, 1, 1, 255], "<f4")).astype("<f4").tobytes())
    assert len(read_points(path)) == 120
    with pytest.raises(FileNotFoundError, match="lidar scan"):
        read_points(tmp_path / "none.bin")


def test_images(tmp_path: Path) -> None:
    from PIL import Image

    path = tmp_path / "000000.png"
    picture = np.random.default_rng(0).integers(0, 255, (370, 1224, 3)).astype(np.uint8)
    write_image(path, picture)
    np.testing.assert_array_equal(read_image(path), picture)
    with pytest.raises(ValueError, match=r"image is float64 \(370, 1224, 3\), expected uint8"):
        write_image(path, picture / 255.0)
    Image.fromarray(picture[:100]).save(path)
    with pytest.raises(ValueError, match="1224x100 pixels, expected 1224x370 to 1242x376"):
        read_image(path)
    assert read_image(path, any_size=True).shape == (100, 1224, 3)
    Image.fromarray(np.zeros_like(picture)).save(path)
    with pytest.raises(ValueError, match="every pixel is 0: an empty image"):
        read_image(path)
    Image.fromarray(picture[:, :, 0]).save(path)
    with pytest.raises(ValueError, match="image mode L, expected 8-bit RGB"):
        read_image(path)
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(ValueError, match="not a readable image"):
        read_image(path)


def test_planes_and_splits(tmp_path: Path) -> None:
    path = tmp_path / "000000.txt"
    plane = np.array([-0.01, -1.0, 0.02, 1.65])
    plane /= np.linalg.norm(plane[:3])
    write_plane(path, -2 * plane)
    np.testing.assert_allclose(read_plane(path), plane, atol=1e-6)
    path.write_text("# Plane\nWIDTH 4\nHEIGHT 1\n1 0 0 2\n")
    with pytest.raises(ValueError, match=r"line 4: plane 1 0 0 2 is no ground plane"):
        read_plane(path)
    path.write_text("# Plane\n1 2 3\n")
    with pytest.raises(ValueError, match="line 2: 3 values, expected 4"):
        read_plane(path)

    write_split(path, ("000003", "000001"))
    assert read_split(path) == ("000003", "000001")
    for text, message in (
        ("000003\n../3\n", "line 2: '../3', expected a frame's name"),
        ("a b\n", "line 1: 'a b', expected a frame's name"),
        ("000003\n000003\n", "line 2: 000003 was already on line 1"),
        ("\n", "no frame listed"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_split(path)


def test_frame_needs_its_files(tmp_path: Path, calibration: Calibration) -> None:
    from PIL import Image

    folder = tmp_path / "training"
    (folder / "image_2").mkdir(parents=True)
    picture = np.random.default_rng(0).integers(0, 255, (375, 1242, 3)).astype(np.uint8)
    Image.fromarray(picture).save(folder / "image_2" / "000004.png")
    write_points(folder / "velodyne" / "000004.bin", np.ones((2, 4)))
    with pytest.raises(FileNotFoundError, match=r"calib.000004\.txt does not exist"):
        read_frame(tmp_path, "000004")
    write_calibration(folder / "calib" / "000004.txt", calibration)
    with pytest.raises(FileNotFoundError, match=r"label_2.000004\.txt does not exist"):
        read_frame(tmp_path, "000004")
    write_labels(folder / "label_2" / "000004.txt", empty())
    frame = read_frame(tmp_path, "000004")
    assert frame.labels is not None and len(frame.labels) == 0 and frame.plane is None
    assert frame_names(folder / "calib") == ("000004",)
    # Own frames: any name, and pictures as a camera writes them.
    for kind, suffix in (("velodyne", ".bin"), ("calib", ".txt"), ("label_2", ".txt")):
        (folder / kind / f"000004{suffix}").rename(folder / kind / f"drive_7.a-1{suffix}")
    Image.fromarray(picture).save(folder / "image_2" / "drive_7.a-1.jpg", quality=95)
    write_split(tmp_path / "own.txt", ("drive_7.a-1",))
    assert read_split(tmp_path / "own.txt") == ("drive_7.a-1",)
    assert frame_names(folder / "image_2", ".png") == ("000004", "drive_7.a-1")
    assert read_frame(tmp_path, "drive_7.a-1").image.shape == (375, 1242, 3)


@pytest.mark.data
def test_real_frames_fit_together(data_dir: Path, tmp_path: Path) -> None:
    root = data_dir / "kitti"
    names = frame_names(root / "training" / "calib")
    assert len(names) == 23
    for name in names[::4]:
        frame = read_frame(root, name)
        calibration = frame.calibration
        height, width = frame.image.shape[:2]
        write_calibration(tmp_path / "c.txt", calibration)
        again = read_calibration(tmp_path / "c.txt")
        for a, b in zip(again, calibration, strict=True):
            np.testing.assert_array_equal(a, b)
        camera = lidar_to_camera(calibration, frame.points[:, :3])
        np.testing.assert_allclose(
            camera_to_lidar(calibration, camera), frame.points[:, :3], atol=1e-9
        )
        pixels, depth = project(calibration, camera)
        seen = in_image(pixels, depth, height, width)
        assert 0.1 < seen.mean() < 0.3  # 81 of 360 degrees
        np.testing.assert_allclose(
            back_project(calibration, pixels[seen], depth[seen]), camera[seen], atol=1e-9
        )
        labels = frame.labels
        assert labels is not None
        write_labels(tmp_path / "l.txt", labels)
        assert_same(read_labels(tmp_path / "l.txt"), labels)
        # Lidar points lie inside the near, visible 3D boxes.
        for i in np.flatnonzero((labels.occluded == 0) & (labels.location[:, 2] < 40)):
            h, w, length = labels.dimensions[i]
            away = camera - labels.location[i]
            c, s = np.cos(labels.rotation_y[i]), np.sin(labels.rotation_y[i])
            along, across = away[:, 0] * c - away[:, 2] * s, away[:, 0] * s + away[:, 2] * c
            inside = (abs(along) < length / 2) & (abs(across) < w / 2) & (away[:, 1] < 0)
            assert (inside & (away[:, 1] > -h)).sum() > 5


@pytest.mark.data
def test_split_lists(data_dir: Path) -> None:
    sets = {
        part: read_split(data_dir / "kitti" / "ImageSets" / f"{part}.txt")
        for part in ("train", "val", "trainval", "test")
    }
    assert [len(s) for s in sets.values()] == [3712, 3769, 7481, 7518]
    assert set(sets["train"]).isdisjoint(sets["val"])
    assert set(sets["trainval"]) == {*sets["train"], *sets["val"]}
