"""KITTI's lidar scans and camera images, strictly read.

Source: Geiger, Lenz, Urtasun (2012), development kit of the KITTI object benchmark.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

_FARTHEST = 500.0  # [m]; lidars reach 300
_BRIGHTEST = 255.0  # reflectance; 1 in the benchmark
# Image sizes of the benchmark lie between 1224x370 and 1242x376; resized copies are a common trap,
# because calibration and labels then no longer fit.
_IMAGE_HEIGHT, _IMAGE_WIDTH = (370, 376), (1224, 1242)


def _implausible(points: np.ndarray) -> str:
    """Why `[n, >= 4]` numbers are no scan in metres with a reflectance; empty where they can be."""
    if not len(points):
        return ""
    farthest = np.abs(points[:, :3]).max()
    if farthest > _FARTHEST:
        near = float(np.median(np.linalg.norm(points[:, :3].astype(np.float64), axis=1)))
        millimetres = " (in millimetres?)" if 1e3 < near < 2e5 and farthest < 1e6 else ""
        return (
            f"the farthest coordinate is {farthest:.3g}, the median distance {near:.3g}"
            f"{millimetres}, expected metres, below {_FARTHEST:g}"
        )
    light = points[:, 3]
    if light.min() < 0 or light.max() > _BRIGHTEST:
        return (
            f"reflectances from {light.min():.3g} to {light.max():.3g}, expected 0 to 1 (or to "
            f"{_BRIGHTEST:g}) in the fourth column"
        )
    return ""


def _other_layout(data: bytes) -> str:
    """What the bytes can be instead of four float32 a point."""
    for kind, name in (("<f4", "float32"), ("<f8", "float64")):
        for columns in (4, 5, 3):
            size = columns * np.dtype(kind).itemsize
            if (kind, columns) == ("<f4", 4) or not data or len(data) % size:
                continue
            table = np.frombuffer(data, kind).reshape(-1, columns)
            if not np.isfinite(table).all() or np.abs(table[:, :3]).max() < 1e-3:
                continue
            if columns == 3 and 2 * table[:, 2].std() > table[:, :2].std(axis=0).max():
                continue  # heights differ less than places; numbers out of step are all alike
            whole = table if columns > 3 else np.pad(table, ((0, 0), (0, 1)))
            if not _implausible(whole):
                return (
                    f"; it reads as {len(table)} points of {columns} columns in {name}: write x, "
                    "y, z, reflectance as float32"
                )
    return ""


def read_points(
    path: str | Path, *, drop_invalid: bool = False, may_be_dead: bool = False
) -> np.ndarray:
    """Read a `velodyne` file: `[N, 4]` float32 x, y, z [m] and reflectance.

    Args:
        path: the `.bin` file.
        drop_invalid: leave out points with NaN or inf instead of refusing the file; the caller
            can count them as the difference to the file's size / 16.
        may_be_dead: accept a file without a point, as of a dead lidar.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: (unless `may_be_dead`) the file has no point; it ends within a point, or holds
            NaN; or its numbers cannot be metres and reflectances in float32, with what they may be
            instead.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: expected the lidar scan of this frame")
    data = path.read_bytes()
    if may_be_dead and not data:
        return np.zeros((0, 4), np.float32)
    if len(data) == 0 or len(data) % 16:
        raise ValueError(
            f"{path}: {len(data)} bytes, expected a positive multiple of 16 (four float32 a point)"
            + _other_layout(data)
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)
    good = np.isfinite(points).all(axis=1)
    wrong = _implausible(points[good])
    if wrong:
        raise ValueError(f"{path}: {wrong}{_other_layout(data)}")
    if not good.all():
        if not drop_invalid:
            raise ValueError(
                f"{path}: {int((~good).sum())} of {len(good)} points hold NaN or inf (first: point "
                f"{int(np.argmin(good))}); pass drop_invalid=True to leave them out"
            )
        points = points[good]
        if not len(points) and not may_be_dead:
            raise ValueError(f"{path}: all {len(good)} points hold NaN or inf")
    return points.copy()


def write_points(path: str | Path, points: np.ndarray) -> None:
    """Write a `velodyne` file from `[N, 4]` points."""
    if points.ndim != 2 or points.shape[1] != 4 or not len(points):
        raise ValueError(f"points have shape {points.shape}, expected [N, 4] with N >= 1")
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_bytes(points.astype("<f4").tobytes())


def read_image(
    path: str | Path, *, any_size: bool = False, may_be_dead: bool = False
) -> np.ndarray:
    """Read an `image_2` file: `[H, W, 3]` uint8 RGB.

    Args:
        path: of the file.
        any_size: accept other sizes than the benchmark's.
        may_be_dead: accept an image of one colour, as of a dead camera.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no image, not 8-bit RGB, (unless `may_be_dead`) all of one colour,
            or (unless `any_size`) of a size that the benchmark does not have.
    """
    from PIL import Image, UnidentifiedImageError

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: expected the image of this frame")
    try:
        with Image.open(path) as file:
            mode = file.mode
            image = np.asarray(file)
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise ValueError(f"{path}: not a readable image ({error})") from None
    if mode != "RGB":
        raise ValueError(f"{path}: image mode {mode}, expected 8-bit RGB")
    height, width = image.shape[:2]
    right_size = (
        _IMAGE_HEIGHT[0] <= height <= _IMAGE_HEIGHT[1]
        and _IMAGE_WIDTH[0] <= width <= _IMAGE_WIDTH[1]
    )
    if not (any_size or right_size):
        raise ValueError(
            f"{path}: {width}x{height} pixels, expected {_IMAGE_WIDTH[0]}x{_IMAGE_HEIGHT[0]} to "
            f"{_IMAGE_WIDTH[1]}x{_IMAGE_HEIGHT[1]} (a resized copy no longer fits its calibration; "
            "pass any_size=True for another camera)"
        )
    if not may_be_dead and image.min() == image.max():
        raise ValueError(f"{path}: every pixel is {int(image.min())}: an empty image")
    return image


def write_image(path: str | Path, image: np.ndarray) -> None:
    """Write `[H, W, 3]` uint8 RGB as an `image_2` file.

    Raises:
        ValueError: another shape or type.
    """
    from PIL import Image

    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"image is {image.dtype} {image.shape}, expected uint8 [H, W, 3]")
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)
