"""KITTI's calibration and ground plane files, strictly read.

Source: Geiger, Lenz, Urtasun (2012), development kit of the KITTI object benchmark; plane files:
Chen et al. (2015).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fusion.detection.kitti.calibration import Calibration, check_calibration
from fusion.detection.kitti.text import parse_number, read_lines

_CALIBRATION_KEYS = {
    "P0": (3, 4),
    "P1": (3, 4),
    "P2": (3, 4),
    "P3": (3, 4),
    "R0_rect": (3, 3),
    "Tr_velo_to_cam": (3, 4),
    "Tr_imu_to_velo": (3, 4),
}
_NEEDED = ("P2", "R0_rect", "Tr_velo_to_cam")


def read_calibration(path: str | Path) -> Calibration:
    """Read a `calib` file; P2, R0_rect and Tr_velo_to_cam are needed, the others may be missing.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a needed matrix is missing, one comes twice, has another number of values, or
            cannot be a calibration.
    """
    path = Path(path)
    found: dict[str, np.ndarray] = {}
    for number, line in enumerate(read_lines(path), start=1):
        if not line.strip():
            continue
        key, colon, rest = line.partition(":")
        key = key.strip()
        if not colon:
            raise ValueError(f"{path}, line {number}: expected 'NAME: values', got {line[:40]!r}")
        if key not in _CALIBRATION_KEYS:
            continue
        if key in found:
            raise ValueError(f"{path}, line {number}: a second {key}: expected each matrix once")
        shape = _CALIBRATION_KEYS[key]
        values = [parse_number(token, path, number, key) for token in rest.split()]
        if len(values) != shape[0] * shape[1]:
            raise ValueError(
                f"{path}, line {number}: {key} has {len(values)} values, expected "
                f"{shape[0] * shape[1]}"
            )
        found[key] = np.array(values).reshape(shape)
    missing = [key for key in _NEEDED if key not in found]
    if missing:
        raise ValueError(
            f"{path}: {', '.join(missing)} missing, expected {', '.join(_NEEDED)} "
            "(a file of another KITTI benchmark?)"
        )
    none = np.full((3, 4), np.nan)
    calibration = Calibration(
        np.stack([found.get(f"P{i}", none) for i in range(4)]),
        found["R0_rect"],
        found["Tr_velo_to_cam"],
        found.get("Tr_imu_to_velo", none),
    )
    try:
        check_calibration(calibration)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return calibration


def write_calibration(path: str | Path, calibration: Calibration) -> None:
    """Write a `calib` file with 13 digits, as the benchmark has them; without missing matrices."""
    check_calibration(calibration)
    named = {f"P{i}": p for i, p in enumerate(calibration.projections)}
    named |= {
        "R0_rect": calibration.r0_rect,
        "Tr_velo_to_cam": calibration.velo_to_cam,
        "Tr_imu_to_velo": calibration.imu_to_velo,
    }
    lines = [
        f"{k}: " + " ".join(f"{v:.12e}" for v in m.ravel())
        for k, m in named.items()
        if not np.isnan(m).all()
    ]
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text("\n".join(lines) + "\n", encoding="ascii")


def read_plane(path: str | Path) -> np.ndarray:
    """Read a `planes` file: `[4]` a, b, c, d with a x + b y + c z + d the height above ground [m].

    The normal is returned with length 1 and pointing up (b < 0; y points down).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not four numbers on the last line, or the plane is steeper than 45 degrees.
    """
    path = Path(path)
    lines = read_lines(path)
    numbered = [(i, t) for i, t in enumerate(lines, 1) if t.strip()]
    if not numbered:
        raise ValueError(f"{path}: empty file, expected a plane of four numbers on its last line")
    number, last = numbered[-1]
    values = [parse_number(token, path, number, "plane") for token in last.split()]
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
