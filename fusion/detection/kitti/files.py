"""KITTI object files in their original layout: strict reading and writing.

    ROOT/training/{image_2,velodyne,calib,label_2,planes}/000000.*
    ROOT/testing/...            ROOT/ImageSets/{train,val,trainval,test}.txt

This file has frames and lists of frames; `io_labels`, `io_geometry` and `io_sensors` have the
single files, and their functions can be imported from here. Nothing is guessed: a damaged file is
an error that names file, line and expectation. No file is fetched.

Source: Geiger, Lenz, Urtasun (2012), development kit of the KITTI object benchmark; plane files
and split lists: Chen et al. (2015) and Ku et al. (2018).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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


def read_split(path: str | Path) -> tuple[str, ...]:
    """Read an `ImageSets` list: six-digit frame names, each once.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a line is no frame name, a name comes twice, or there is none.
    """
    path = Path(path)
    names: dict[str, int] = {}
    for number, line in enumerate(read_lines(path), start=1):
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
