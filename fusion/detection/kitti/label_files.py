"""KITTI's label and result files: one object a line, strictly read.

Source: Geiger, Lenz, Urtasun (2012), development kit of the KITTI object benchmark.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fusion.detection.kitti.objects import DONT_CARE, KITTI_TYPES, NO_BOX3D, Objects, empty
from fusion.detection.kitti.text import parse_number, read_lines

_LABEL_FIELDS = 15
_TYPES = frozenset(KITTI_TYPES)
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
    for number, line in enumerate(read_lines(path), start=1):
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
            row = [parse_number(token, path, number, name) for token, name in pairs]
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
