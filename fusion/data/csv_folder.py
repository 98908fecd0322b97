"""One's own recordings from a folder of CSV files and a small schema.

A sensor may have several channels, which fail together, and a rate and length of its own:

    schema.json   {"sensors": {"imu": ["ax", "ay"], "heat": ["t"]}, "groups": "person",
                   "target": {"kind": "classes", "columns": ["activity"]}}
    rows.csv      id,activity,person      one line for each window
    imu.csv       id,ax,ay                samples of the windows, in the order of time
    heat.csv      id,t
"""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from fusion._checks import check_choice
from fusion.data.dataset import Scale, apply_scale, draw_groups, fit_scale

TargetKind = Literal["classes", "numbers", "labels"]
TEST_FRACTION = 0.25


@dataclasses.dataclass(frozen=True, eq=False)
class SensorRows:
    """Windows of sensors of different shapes.

    Attributes:
        readings: for each sensor `[N, channel, sample]` float32 in [-1, 1]; zeros where absent.
        available: `[N, sensor]`, False where a sensor sent nothing, or nothing of a channel.
        target: `[N]` class numbers, or `[N, column]` float32: numbers with mean 0 and standard
            deviation 1 over the training rows, or labels of 0 and 1.
        ids: `[N]` names of the rows.
    """

    readings: tuple[np.ndarray, ...]
    available: np.ndarray
    target: np.ndarray
    ids: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class SensorFolder:
    """Training and test rows of a folder.

    Attributes:
        sensors: their names; channels: the channels of each.
        kind: of the target; names: of its classes or columns.
        train, test: the rows.
        scales: training minimum and maximum of each sensor's channels.
        centre, spread: of the target's columns (`numbers`), else zeros and ones.
        class_weights: `[class]`, their mean over the training rows is 1; None without.
    """

    sensors: tuple[str, ...]
    channels: tuple[tuple[str, ...], ...]
    kind: TargetKind
    names: tuple[str, ...]
    train: SensorRows
    test: SensorRows
    scales: tuple[Scale, ...]
    centre: np.ndarray
    spread: np.ndarray
    class_weights: np.ndarray | None


def load_folder(path: str | Path, *, seed: int = 0, validation: bool = False) -> SensorFolder:
    r"""Read, check, split and scale a folder of CSV files.

    An empty cell is a lost sample: the last one before it in its window stands in (at the start the
    next one after it). A sensor without lines for a row, or with a channel that lost all samples of
    it, is absent there. Every sensor has the same number of samples in all rows.

    Args:
        path: folder with `schema.json`, `rows.csv` and one CSV file for each sensor.
        seed: of the draw of test rows, a quarter of the groups (or rows).
        validation: a quarter of the training rows takes the place of the test rows.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a schema or a cell that means nothing, with its place.
    """
    folder = Path(path)
    schema = _schema(folder / "schema.json")
    target = schema["target"]
    rows = _table(folder / "rows.csv", ("id", *target["columns"], *schema["groups"]))
    ids = [row["id"] for row in rows]
    if len(set(ids)) < len(ids) or not ids:
        raise ValueError(f"{folder / 'rows.csv'}: expected a different id in each row; number them")
    found = [
        _readings(folder / f"{sensor}.csv", channels, ids)
        for sensor, channels in schema["sensors"].items()
    ]
    raw, names = _target(folder / "rows.csv", rows, target)
    groups = None
    if schema["groups"]:
        (column,) = schema["groups"]
        groups = np.unique([row[column] for row in rows], return_inverse=True)[1]
    held = _draw(groups, raw, np.ones(len(ids), bool), seed)
    used = np.ones(len(ids), bool)
    if validation:
        used, held = ~held, _draw(groups, raw, ~held, seed + 1)
    return assemble(schema, names, np.asarray(ids), found, raw, used & ~held, held)


def read_windows(
    path: str | Path, sensors: Mapping[str, Sequence[str]]
) -> tuple[list[str], list[np.ndarray]]:
    """Windows of a folder in their own units, for a network that is there already.

    Args:
        path: folder with `rows.csv`, of which `id` is read, and one CSV file for each sensor.
        sensors: their names and channels, as in the schema of the network.

    Returns:
        Ids of the rows, and for each sensor `[row, channel, sample]`, NaN where it is absent.
    """
    folder = Path(path)
    ids = [row["id"] for row in _table(folder / "rows.csv", ("id",))]
    return ids, [_readings(folder / f"{name}.csv", c, ids) for name, c in sensors.items()]


def _schema(path: Path) -> dict[str, Any]:
    text = _existing(path).read_text(encoding="utf-8")
    try:
        held = json.loads(text)
        sensors, target = dict(held.pop("sensors")), dict(held.pop("target"))
        groups = held.pop("groups", None)
        kind, columns = target["kind"], tuple(target["columns"])
        weights = target.get("class_weights")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f'{path}: expected {{"sensors": {{name: [channels]}}, "target": {{"kind": ..., '
            f'"columns": [...]}}, "groups": column}} ({error}); see docs/data.md'
        ) from None
    check_choice("target.kind", kind, get_args(TargetKind))
    unknown = [*held, *(set(target) - {"kind", "columns", "class_weights"})]
    if unknown:
        raise ValueError(f"{path}: {unknown} mean nothing; leave them out")
    if not sensors or not all(isinstance(c, list) and c for c in sensors.values()):
        raise ValueError(f"{path}: sensors={sensors}: expected a list of channels for each sensor")
    if not columns or (kind == "classes" and len(columns) > 1):
        raise ValueError(
            f"{path}: target.columns={list(columns)}: expected one column of classes, or some of "
            "numbers or labels"
        )
    if weights is not None and kind != "classes":
        raise ValueError(f"{path}: class_weights={weights}: expected them with classes only")
    target = {"kind": kind, "columns": columns, "class_weights": weights}
    return {"sensors": sensors, "target": target, "groups": () if groups is None else (groups,)}


def _existing(path: Path) -> Path:
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file; a folder of one's own needs it")
    return path


def _table(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    with _existing(path).open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        missing = [c for c in columns if c not in (rows.fieldnames or ())]
        if missing:
            raise ValueError(f"{path}, line 1: columns {missing} are missing from the header")
        held = list(rows)
    for number, row in enumerate(held, start=2):
        if any(row[c] is None for c in columns):
            raise ValueError(f"{path}, line {number}: fewer cells than the header; complete it")
    return held


def _number(path: Path, line: int, column: str, cell: str) -> float:
    try:
        value = float(cell or "nan")
    except ValueError:
        value = float("inf")
    if np.isinf(value):
        raise ValueError(f"{path}, line {line}: {column} is {cell!r}, expected a number or nothing")
    return value


def _readings(path: Path, channels: Sequence[str], ids: Sequence[str]) -> np.ndarray:
    """Samples `[N, channel, sample]` of one sensor; NaN where it is absent, holes filled."""
    windows: dict[str, list[list[float]]] = {name: [] for name in ids}
    for line, row in enumerate(_table(path, ("id", *channels)), start=2):
        if row["id"] not in windows:
            raise ValueError(f"{path}, line {line}: id {row['id']!r} is not in rows.csv; add it")
        windows[row["id"]].append([_number(path, line, c, row[c]) for c in channels])
    lengths = {len(samples) for samples in windows.values()} - {0}
    if len(lengths) != 1:
        raise ValueError(
            f"{path}: windows of {sorted(lengths)} samples: expected one length; cut them to it"
        )
    (length,) = lengths
    empty = np.full((length, len(channels)), np.nan)
    x = np.stack([np.asarray(windows[n]) if windows[n] else empty for n in ids])
    return _filled(x.transpose(0, 2, 1))


def _filled(x: np.ndarray) -> np.ndarray:
    """Last sample before each hole, next one after it at the start of a window."""
    for _ in range(2):
        last = np.maximum.accumulate(np.where(np.isnan(x), 0, np.arange(x.shape[2])), axis=2)
        x = np.take_along_axis(x, last, axis=2)[:, :, ::-1]
    return x


def _target(
    path: Path, rows: list[dict[str, str]], target: dict[str, Any]
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Class numbers with the names of the classes, or numbers with the names of the columns."""
    columns = target["columns"]
    if target["kind"] == "classes":
        names, numbers = np.unique([row[columns[0]] for row in rows], return_inverse=True)
        if "" in names or len(names) < 2:
            raise ValueError(f"{path}: {columns[0]} has classes {list(names)}: expected two named")
        return numbers.astype(np.int32), tuple(map(str, names))
    cells = [[_number(path, n, c, row[c]) for c in columns] for n, row in enumerate(rows, start=2)]
    values = np.asarray(cells, np.float32)
    good = np.isfinite(values) if target["kind"] == "numbers" else np.isin(values, (0.0, 1.0))
    if not good.all():
        row, column = np.argwhere(~good)[0]
        wanted = "a number" if target["kind"] == "numbers" else "0 or 1"
        raise ValueError(
            f"{path}, line {row + 2}: {columns[column]}: expected {wanted}; fill it in"
        )
    return values, columns


def _draw(groups: np.ndarray | None, y: np.ndarray, among: np.ndarray, seed: int) -> np.ndarray:
    """Test rows: a quarter of the groups, or of the rows, among the given ones."""
    held, chosen = np.zeros(len(y), bool), np.flatnonzero(among)
    if groups is None:
        order = np.random.default_rng(seed).permutation(chosen)
        held[order[: max(1, round(TEST_FRACTION * len(chosen)))]] = True
        return held
    classes = y if y.ndim == 1 else np.zeros(len(y), int)
    ids = draw_groups(groups[among], classes[among], fraction=TEST_FRACTION, seed=seed)
    return among & np.isin(groups, ids)


def assemble(
    schema: dict[str, Any],
    names: tuple[str, ...],
    ids: np.ndarray,
    found: list[np.ndarray],
    raw: np.ndarray,
    train: np.ndarray,
    test: np.ndarray,
) -> SensorFolder:
    """Scale by the training rows, weigh the classes, part the rows.

    Args:
        schema: `sensors` (names to channels) and `target` (`kind`, `class_weights`).
        names: of the classes or columns; ids: of the rows.
        found: windows of each sensor `[row, channel, sample]`, NaN where it is absent.
        raw: targets of the rows.
        train, test: which rows are which.

    Raises:
        ValueError: a sensor, a class or a spread of numbers that the training rows lack.
    """
    kind, channels = schema["target"]["kind"], tuple(map(tuple, schema["sensors"].values()))
    there = np.stack([~np.isnan(x).any(axis=(1, 2)) for x in found], axis=1)
    scales, scaled = [], []
    for s, x in enumerate(found):
        if not there[train, s].any():
            raise ValueError(f"sensor {list(schema['sensors'])[s]!r}: absent in all training rows")
        scales.append(fit_scale(x[train & there[:, s]], channels[s]))
        known = np.where(there[:, s, None, None], x, scales[-1].low[None, :, None])
        scaled.append(np.where(there[:, s, None, None], apply_scale(known, scales[-1]), 0.0))
    centre, spread = np.zeros(raw.shape[1:]), np.ones(raw.shape[1:])
    target, weights = raw, None
    if kind == "numbers":
        centre, spread = raw[train].mean(axis=0), raw[train].std(axis=0)
        if not (spread > 0).all():
            raise ValueError(f"target {names}: one value in all training rows; leave it out")
        target = ((raw - centre) / spread).astype(np.float32)
    elif kind == "classes":
        weights = _class_weights(schema["target"]["class_weights"], names, raw[train])
    parts = [
        SensorRows(
            tuple(x[rows].astype(np.float32) for x in scaled), there[rows], target[rows], ids[rows]
        )
        for rows in (train, test)
    ]
    sensors = tuple(schema["sensors"])
    return SensorFolder(
        sensors, channels, kind, names, parts[0], parts[1], tuple(scales), centre, spread, weights
    )


def _class_weights(given: Any, names: tuple[str, ...], y: np.ndarray) -> np.ndarray | None:
    counts = np.bincount(y, minlength=len(names))
    if (counts == 0).any():
        absent = [n for n, c in zip(names, counts, strict=True) if not c]
        raise ValueError(f"classes {absent}: no training rows; give more, or change the seed")
    if given is None:
        return None
    if given == "balanced":
        weights = 1.0 / counts
    elif isinstance(given, dict) and set(given) == set(names):
        weights = np.asarray([float(given[name]) for name in names])
    else:
        raise ValueError(
            f"class_weights={given!r}: expected 'balanced' or a number for each of {list(names)}"
        )
    if not (weights > 0).all():
        raise ValueError(f"class_weights={given!r}: expected numbers above 0")
    scaled: np.ndarray = (weights / (weights * counts).sum() * counts.sum()).astype(np.float32)
    return scaled
