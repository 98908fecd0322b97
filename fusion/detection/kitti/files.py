"""KITTI object files in their original layout: strict reading and writing.

    ROOT/training/{image_2,velodyne,calib,label_2,planes}/000000.*
    ROOT/testing/...            ROOT/ImageSets/{train,val,trainval,test}.txt

This file has frames and lists of frames; `label_files`, `geometry_files` and `sensor_files` have
the single files, and their functions can be imported from here. Nothing is guessed: a damaged file
is an error that names file, line and expectation. No file is fetched.

Source: Geiger, Lenz, Urtasun (2012), development kit of the KITTI object benchmark; plane files
and split lists: Chen et al. (2015) and Ku et al. (2018).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fusion.detection.kitti.calibration import Calibration
from fusion.detection.kitti.geometry_files import (
    read_calibration,
    read_plane,
    write_calibration,
    write_plane,
)
from fusion.detection.kitti.label_files import (
    read_labels,
    read_results,
    write_labels,
    write_results,
)
from fusion.detection.kitti.objects import Objects
from fusion.detection.kitti.sensor_files import read_image, read_points, write_image, write_points
from fusion.detection.kitti.text import read_lines

__all__ = [
    "Frame",
    "frame_names",
    "image_path",
    "read_calibration",
    "read_frame",
    "read_image",
    "read_labels",
    "read_plane",
    "read_points",
    "read_results",
    "read_split",
    "write_calibration",
    "write_image",
    "write_labels",
    "write_plane",
    "write_points",
    "write_results",
    "write_split",
]


_NAME = re.compile(r"\w[\w.-]*", re.ASCII)
_IMAGES = (".png", ".jpg", ".jpeg")


def read_split(path: str | Path) -> tuple[str, ...]:
    """Read an `ImageSets` list: frame names (six digits in the benchmark), each once.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a line is no file name, a name comes twice, or there is none.
    """
    path = Path(path)
    names: dict[str, int] = {}
    for number, line in enumerate(read_lines(path), start=1):
        name = line.strip()
        if not name:
            continue
        if not _NAME.fullmatch(name):
            raise ValueError(
                f"{path}, line {number}: {name!r}, expected a frame's name such as 000003: "
                "letters, digits, dots, - and _"
            )
        if name in names:
            raise ValueError(f"{path}, line {number}: {name} was already on line {names[name]}")
        names[name] = number
    if not names:
        raise ValueError(f"{path}: no frame listed")
    return tuple(names)


def write_split(path: str | Path, names: Sequence[str]) -> None:
    """Write an `ImageSets` list, one frame name a line."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text("".join(f"{name}\n" for name in names), encoding="ascii")


class Frame(NamedTuple):
    """One frame as it is on disk; `labels` and `plane` are None where there is no such file."""

    name: str
    image: np.ndarray
    points: np.ndarray
    calibration: Calibration
    labels: Objects | None
    plane: np.ndarray | None


def read_frame(
    root: str | Path,
    name: str,
    *,
    part: str = "training",
    any_size: bool = False,
    may_be_dead: bool = False,
) -> Frame:
    """Read all files of one frame below `ROOT/training` (or `ROOT/testing`).

    Args:
        root: the folder that holds `training` and `testing`.
        name: of its files, without suffix.
        part: `training` or `testing`.
        any_size: accept images of other sizes than the benchmark's.
        may_be_dead: accept what dead sensors read, for corrupted copies of frames: an image of one
            colour, a scan without points; points with NaN are left out.

    Returns:
        Frame: picture, points, calibration, labels and plane (the last two where there are any).

    Raises:
        FileNotFoundError: image, scan or calibration is missing, or labels of a training frame.
        ValueError: one of the files is damaged.
    """
    folder = Path(root) / part
    plane = folder / "planes" / f"{name}.txt"
    return Frame(
        name=name,
        image=read_image(
            image_path(folder / "image_2", name), any_size=any_size, may_be_dead=may_be_dead
        ),
        points=read_points(
            folder / "velodyne" / f"{name}.bin", drop_invalid=may_be_dead, may_be_dead=may_be_dead
        ),
        calibration=read_calibration(folder / "calib" / f"{name}.txt"),
        labels=read_labels(folder / "label_2" / f"{name}.txt") if part == "training" else None,
        plane=read_plane(plane) if plane.is_file() else None,
    )


def image_path(folder: Path, name: str) -> Path:
    """The image of a frame: `.png`, as in the benchmark, or else `.jpg` or `.jpeg`."""
    there = [path for suffix in _IMAGES if (path := folder / f"{name}{suffix}").is_file()]
    return there[0] if there else folder / f"{name}.png"


def frame_names(folder: str | Path, suffix: str = ".txt") -> tuple[str, ...]:
    """Names of the frames that have a file in `folder`, sorted; `.png` finds all images."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} does not exist: expected a folder of 000000{suffix} ...")
    suffixes = _IMAGES if suffix == ".png" else (suffix,)
    return tuple(
        sorted({p.stem for p in folder.iterdir() if p.suffix in suffixes and _NAME.match(p.stem)})
    )
