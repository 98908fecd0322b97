"""KITTI object files in their original layout: strict reading and writing.

    ROOT/training/{image_2,velodyne,calib,label_2,planes}/000000.*
    ROOT/testing/...            ROOT/ImageSets/{train,val,trainval,test}.txt

Nothing is guessed: a damaged file is an error that names file, line and expectation. No file is
fetched.

Source: Geiger, Lenz, Urtasun (2012), development kit of the KITTI object benchmark; plane files
and split lists: Chen et al. (2015) and Ku et al. (2018).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fusion.detection.calibration import Calibration, check_calibration
from fusion.detection.objects import DONT_CARE, KITTI_TYPES, NO_BOX3D, Objects, empty

__all__ = [
    "Frame",
    "frame_names",
    "read_calibration",
    "read_frame",
    "read_image",
    "read_labels",
    "read_plane",
    "read_points",
    "read_results",
    "read_split",
    "write_calibration",
    "write_labels",
    "write_plane",
    "write_points",
    "write_results",
]

_LABEL_FIELDS = 15
_TYPES = frozenset(KITTI_TYPES)
_CALIBRATION_KEYS = {
    "P0": (3, 4),
    "P1": (3, 4),
    "P2": (3, 4),
    "P3": (3, 4),
    "R0_rect": (3, 3),
    "Tr_velo_to_cam": (3, 4),
    "Tr_imu_to_velo": (3, 4),
}
# Image sizes of the benchmark lie between 1224x370 and 1242x376; resized copies are a common trap,
# because calibration and labels then no longer fit.
_IMAGE_HEIGHT, _IMAGE_WIDTH = (370, 376), (1224, 1242)


def _text(path: Path) -> list[str]:
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: expected a KITTI file of this frame")
    try:
        return path.read_text(encoding="ascii").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: byte {error.start} is not ASCII: not a KITTI text file"
        ) from None


def _number(token: str, path: Path, line: int, name: str) -> float:
    try:
        value = float(token)
    except ValueError:
        raise ValueError(f"{path}, line {line}: {name} is {token!r}, expected a number") from None
    if not np.isfinite(value):
        raise ValueError(f"{path}, line {line}: {name} is {token!r}, expected a finite number")
    return value


_FIELD_NAMES = (
    "truncated", "occluded", "alpha", "left", "top", "right", "bottom", "height", "width",
    "length", "x", "y", "z", "rotation_y", "score",
)  # fmt: skip


def _check_objects(types: list[str], table: np.ndarray, lines: list[int], path: Path) -> None:
    """Range checks of all lines at once; the first wrong line is named."""
    truncated, occluded = table[:, 0], table[:, 1]
    box, size, place = table[:, 3:7], table[:, 7:10], table[:, 10:13]
    cared = np.array([t != DONT_CARE for t in types])
    no_3d = (size == -1).all(1) & (place == NO_BOX3D).all(1)
    checks = (
        ((truncated != -1) & ((truncated < 0) | (truncated > 1)),
         "truncated is {0[0]:g}, expected 0 to 1, or -1"),
        (~np.isin(occluded, (-1, 0, 1, 2, 3)), "occluded is {0[1]:g}, expected -1, 0, 1, 2 or 3"),
        ((box[:, 2] < box[:, 0]) | (box[:, 3] < box[:, 1]),
         "box {0[3]:g} {0[4]:g} {0[5]:g} {0[6]:g}: expected left <= right and top <= bottom"),
        (cared & ~no_3d & (size <= 0).any(1),
         "height, width, length {0[7]:g} {0[8]:g} {0[9]:g}: expected all above 0 (or -1 -1 -1 "
         "with location -1000 -1000 -1000 where there is no 3D box)"),
    )  # fmt: skip
    for wrong, message in checks:
        if wrong.any():
            i = int(np.argmax(wrong))
            raise ValueError(f"{path}, line {lines[i]}: " + message.format(table[i]))


def _read_objects(path: str | Path, *, scores: bool) -> Objects:
    path = Path(path)
    n_fields = _LABEL_FIELDS + scores
    types: list[str] = []
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, line in enumerate(_text(path), start=1):
        tokens = line.split()
        if not tokens:
            continue
        if len(tokens) != n_fields:
            hint = ""
            if len(tokens) == _LABEL_FIELDS and scores:
                hint = " (a label file? results end with a score)"
            if len(tokens) == _LABEL_FIELDS + 1 and not scores:
                hint = " (a result file? labels have no score)"
            raise ValueError(
                f"{path}, line {number}: {len(tokens)} fields, expected {n_fields}{hint}"
            )
        if tokens[0] not in _TYPES:
            raise ValueError(
                f"{path}, line {number}: class {tokens[0]!r}, expected one of "
                f"{', '.join(KITTI_TYPES)}"
            )
        try:
            row = [float(token) for token in tokens[1:]]
        except ValueError:
            row = [np.nan]
        if not np.isfinite(row).all():
            pairs = zip(tokens[1:], _FIELD_NAMES, strict=False)
            row = [_number(token, path, number, name) for token, name in pairs]
        types.append(tokens[0])
        rows.append(row)
        lines.append(number)
    if not rows:
        return empty()
    table = np.array(rows)
    _check_objects(types, table, lines, path)
    return Objects(
        type=np.array(types, "<U14"),
        truncated=table[:, 0],
        occluded=table[:, 1].astype(np.int64),
        alpha=table[:, 2],
        bbox=table[:, 3:7],
        dimensions=table[:, 7:10],
        location=table[:, 10:13],
        rotation_y=table[:, 13],
        score=table[:, 14] if scores else np.full(len(rows), np.nan),
    )


def read_labels(path: str | Path) -> Objects:
    """Read a `label_2` file: 15 fields a line; an empty file is a frame without objects.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a line has another number of fields, an unknown class or a value out of range;
            the message names file and line.
    """
    return _read_objects(path, scores=False)


def read_results(path: str | Path) -> Objects:
    """Read a file of detections: the 15 label fields and a score. Raises like `read_labels`."""
    return _read_objects(path, scores=True)


def _write_objects(path: str | Path, objects: Objects, *, scores: bool) -> None:
    path = Path(path)
    numbers = [
        objects.truncated[:, None], objects.alpha[:, None], objects.bbox, objects.dimensions,
        objects.location, objects.rotation_y[:, None],
    ]  # fmt: skip
    if scores:
        numbers.append(objects.score[:, None])
    table = np.concatenate(numbers, axis=1)
    wrong = ~np.isfinite(table).all(axis=1)
    if wrong.any():
        raise ValueError(
            f"{path}: object {int(np.argmax(wrong))} holds NaN or inf, expected finite numbers"
            + (" (detections need a score)" if scores else "")
        )
    unknown = sorted(set(objects.type.tolist()) - _TYPES)
    if unknown:
        raise ValueError(f"{path}: class {unknown[0]!r}, expected one of {', '.join(KITTI_TYPES)}")
    out = []
    for kind, occluded, row in zip(objects.type, objects.occluded, table, strict=True):
        rest = " ".join(f"{v:.2f}" for v in row[1:13])
        out.append(f"{kind} {row[0]:.2f} {occluded:d} {rest}")
        if scores:
            out[-1] += f" {row[13]:.6f}"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in out), encoding="ascii")


def write_labels(path: str | Path, objects: Objects) -> None:
    """Write a `label_2` file: two decimals, as the benchmark has them.

    Raises:
        ValueError: a value is not finite or a class is not one of `KITTI_TYPES`.
    """
    _write_objects(path, objects, scores=False)


def write_results(path: str | Path, objects: Objects) -> None:
    """Write detections in the benchmark's result format (an empty file where there are none).

    Scores have six decimals, so that the order of detections survives. Raises like `write_labels`.
    """
    _write_objects(path, objects, scores=True)


def read_calibration(path: str | Path) -> Calibration:
    """Read a `calib` file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a matrix is missing, has another number of values, or cannot be a calibration.
    """
    path = Path(path)
    found: dict[str, np.ndarray] = {}
    for number, line in enumerate(_text(path), start=1):
        if not line.strip():
            continue
        key, colon, rest = line.partition(":")
        if not colon:
            raise ValueError(f"{path}, line {number}: expected 'NAME: values', got {line[:40]!r}")
        if key not in _CALIBRATION_KEYS:
            continue
        shape = _CALIBRATION_KEYS[key]
        values = [_number(token, path, number, key) for token in rest.split()]
        if len(values) != shape[0] * shape[1]:
            raise ValueError(
                f"{path}, line {number}: {key} has {len(values)} values, expected "
                f"{shape[0] * shape[1]}"
            )
        found[key] = np.array(values).reshape(shape)
    missing = [key for key in _CALIBRATION_KEYS if key not in found]
    if missing:
        raise ValueError(
            f"{path}: {', '.join(missing)} missing, expected {', '.join(_CALIBRATION_KEYS)} "
            "(a file of another KITTI benchmark?)"
        )
    calibration = Calibration(
        np.stack([found[f"P{i}"] for i in range(4)]),
        found["R0_rect"],
        found["Tr_velo_to_cam"],
        found["Tr_imu_to_velo"],
    )
    try:
        check_calibration(calibration)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return calibration


def write_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write a `calib` file with 13 digits, as the benchmark has them."""
    check_calibration(calibration)
    named = {f"P{i}": p for i, p in enumerate(calibration.projections)}
    named |= {
        "R0_rect": calibration.r0_rect,
        "Tr_velo_to_cam": calibration.velo_to_cam,
        "Tr_imu_to_velo": calibration.imu_to_velo,
    }
    lines = [f"{k}: " + " ".join(f"{v:.12e}" for v in m.ravel()) for k, m in named.items()]
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text("\n".join(lines) + "\n", encoding="ascii")


def read_points(path: str | Path, *, drop_invalid: bool = False) -> np.ndarray:
    """Read a `velodyne` file: `[N, 4]` float32 x, y, z [m] and reflectance.

    Args:
        path: the `.bin` file.
        drop_invalid: leave out points with NaN or inf instead of refusing the file; the caller
            can count them as the difference to the file's size / 16.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file has no point, ends within a point, or holds NaN.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: expected the lidar scan of this frame")
    data = path.read_bytes()
    if len(data) == 0 or len(data) % 16:
        raise ValueError(
            f"{path}: {len(data)} bytes, expected a positive multiple of 16 (four float32 a point)"
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)
    good = np.isfinite(points).all(axis=1)
    if not good.all():
        if not drop_invalid:
            raise ValueError(
                f"{path}: {int((~good).sum())} of {len(good)} points hold NaN or inf (first: point "
                f"{int(np.argmin(good))}); pass drop_invalid=True to leave them out"
            )
        points = points[good]
        if not len(points):
            raise ValueError(f"{path}: all {len(good)} points hold NaN or inf")
    return points.copy()


def write_points(path: str | Path, points: np.ndarray) -> None:
    """Write a `velodyne` file from `[N, 4]` points."""
    if points.ndim != 2 or points.shape[1] != 4 or not len(points):
        raise ValueError(f"points have shape {points.shape}, expected [N, 4] with N >= 1")
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_bytes(points.astype("<f4").tobytes())


def read_image(path: str | Path, *, any_size: bool = False) -> np.ndarray:
    """Read an `image_2` file: `[H, W, 3]` uint8 RGB.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no image, not 8-bit RGB, all of one colour, or (unless `any_size`)
            of a size that the benchmark does not have.
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
    if image.min() == image.max():
        raise ValueError(f"{path}: every pixel is {int(image.min())}: an empty image")
    return image


def read_plane(path: str | Path) -> np.ndarray:
    """Read a `planes` file: `[4]` a, b, c, d with a x + b y + c z + d the height above ground [m].

    The normal is returned with length 1 and pointing up (b < 0; y points down).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not four numbers on the last line, or the plane is steeper than 45 degrees.
    """
    path = Path(path)
    lines = _text(path)
    numbered = [(i, t) for i, t in enumerate(lines, 1) if t.strip()]
    if not numbered:
        raise ValueError(f"{path}: empty file, expected a plane of four numbers on its last line")
    number, last = numbered[-1]
    values = [_number(token, path, number, "plane") for token in last.split()]
    if len(values) != 4:
        raise ValueError(f"{path}, line {number}: {len(values)} values, expected 4 (a, b, c, d)")
    plane = np.array(values)
    length = np.linalg.norm(plane[:3])
    if length < 1e-9 or abs(plane[1]) < 0.7 * length:
        raise ValueError(f"{path}, line {number}: plane {last.strip()} is no ground plane")
    return plane / length * (-1.0 if plane[1] > 0 else 1.0)


def write_plane(path: str | Path, plane: np.ndarray) -> None:
    """Write a `planes` file with the three header lines that readers of it skip."""
    numbers = " ".join(f"{v:.6e}" for v in plane)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(f"# Plane\nWIDTH 4\nHEIGHT 1\n{numbers}\n", encoding="ascii")


def read_split(path: str | Path) -> tuple[str, ...]:
    """Read an `ImageSets` list: six-digit frame names, each once.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a line is no frame name, a name comes twice, or there is none.
    """
    path = Path(path)
    names: dict[str, int] = {}
    for number, line in enumerate(_text(path), start=1):
        name = line.strip()
        if not name:
            continue
        if len(name) != 6 or not name.isdigit():
            raise ValueError(f"{path}, line {number}: {name!r}, expected six digits")
        if name in names:
            raise ValueError(f"{path}, line {number}: {name} was already on line {names[name]}")
        names[name] = number
    if not names:
        raise ValueError(f"{path}: no frame listed")
    return tuple(names)


class Frame(NamedTuple):
    """One frame as it is on disk; `labels` and `plane` are None where there is no such file."""

    name: str
    image: np.ndarray
    points: np.ndarray
    calibration: Calibration
    labels: Objects | None
    plane: np.ndarray | None


def read_frame(
    root: str | Path, name: str, *, part: str = "training", any_size: bool = False
) -> Frame:
    """Read all files of one frame below `ROOT/training` (or `ROOT/testing`).

    Args:
        root: the folder that holds `training` and `testing`.
        name: six digits.
        part: `training` or `testing`.
        any_size: accept images of other sizes than the benchmark's.

    Raises:
        FileNotFoundError: image, scan or calibration is missing, or labels of a training frame.
        ValueError: one of the files is damaged.
    """
    folder = Path(root) / part
    plane = folder / "planes" / f"{name}.txt"
    return Frame(
        name=name,
        image=read_image(folder / "image_2" / f"{name}.png", any_size=any_size),
        points=read_points(folder / "velodyne" / f"{name}.bin"),
        calibration=read_calibration(folder / "calib" / f"{name}.txt"),
        labels=read_labels(folder / "label_2" / f"{name}.txt") if part == "training" else None,
        plane=read_plane(plane) if plane.is_file() else None,
    )


def frame_names(folder: str | Path, suffix: str = ".txt") -> tuple[str, ...]:
    """Names of the frames that have a file in `folder`, sorted."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} does not exist: expected a folder of 000000{suffix} ...")
    files: Iterable[Path] = folder.glob(f"*{suffix}")
    return tuple(sorted(p.stem for p in files if len(p.stem) == 6 and p.stem.isdigit()))
