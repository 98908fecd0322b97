"""HCRL driving data set: one KIA Soul, ten drivers, 44 trips, one row a second.

Source: Kwak, Woo, Kim (2016), Know your master: driver profiling-based anti-theft method, PST.
"""

from __future__ import annotations

import csv
import gzip
from collections.abc import Iterable
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from fusion._checks import check_choice
from fusion.data.dataset import Dataset, apply_scale, check_dataset, draw_groups, fit_scale
from fusion.data.locate import locate, missing_message

DriverFeatures = Literal["complete", "tagged", "source"]
DriverSplit = Literal["random", "trip"]

DRIVER_CLASSES = tuple("ABCDEFGHIJ")
DRIVER_FILES = (
    "hcrl_kia_soul.csv.gz",
    "hcrl_kia_soul.csv",
    "Driving Data(KIA SOUL)_(150728-160714)_(10 Drivers_A-J).csv",
)
N_ROWS = 94_380
N_TRIPS = 44
N_TRAIN = 75_501  # of the source's random split; 18,879 rows are left for the test
# The header of the published file repeats the coolant's name for the transmission oil temperature.
OIL = "Transmission_oil_temperature"
OIL_IN_FILE = "Engine_coolant_temperature.1"
# The 15 signals of Kwak et al. (2016), which the dissertation uses as well.
DRIVER_SOURCE_CHANNELS = (
    "Long_Term_Fuel_Trim_Bank1",
    "Intake_air_pressure",
    "Accelerator_Pedal_value",
    "Fuel_consumption",
    "Torque_of_friction",
    "Maximum_indicated_engine_torque",
    "Engine_torque",
    "Calculated_LOAD_value",
    "Activation_of_Air_compressor",
    "Engine_coolant_temperature",
    OIL,
    "Wheel_velocity_front_left-hand",
    "Wheel_velocity_front_right-hand",
    "Wheel_velocity_rear_left-hand",
    "Torque_converter_speed",
)
# Signal of the list that a third of the public rows lack -> signal that every row has. Chosen one
# by one in the order of the list: the largest rank correlation among the signals still free, over
# the 61,368 rows that have both; a signal without any of at least 0.3 comes last. A signal that
# changes in fewer than one in a hundred seconds of a trip names the trip, and stands in for none.
DRIVER_REPLACEMENTS = {
    "Maximum_indicated_engine_torque": "Engine_speed",
    "Calculated_LOAD_value": "Acceleration_speed_-_Longitudinal",
    "Activation_of_Air_compressor": "Steering_wheel_speed",
    "Wheel_velocity_front_left-hand": "Vehicle_speed",
    "Wheel_velocity_front_right-hand": "Current_Gear",
    "Wheel_velocity_rear_left-hand": "Throttle_position_signal",
    "Torque_converter_speed": "Indication_of_brake_switch_ON/OFF",
}
DRIVER_CHANNELS = tuple(DRIVER_REPLACEMENTS.get(c, c) for c in DRIVER_SOURCE_CHANNELS)
# The stand-ins without the rule on names of trips, as in earlier results.
DRIVER_TAGGED_CHANNELS = tuple(
    "Engine_soacking_time" if c == "Steering_wheel_speed" else c for c in DRIVER_CHANNELS
)
_NAMES = {
    "complete": DRIVER_CHANNELS,
    "tagged": DRIVER_TAGGED_CHANNELS,
    "source": DRIVER_SOURCE_CHANNELS,
}
_SIGNALS = {name for names in _NAMES.values() for name in names}


def _lines(path: Path) -> Iterable[list[str]]:
    opener = gzip.open if path.suffix == ".gz" else open
    with opener(path, "rt", encoding="utf-8", newline="") as file:
        yield from csv.reader(file)


def _header(path: Path, names: list[str]) -> list[str]:
    """Column names, with the second `Engine_coolant_temperature` named as what it is."""
    header: list[str] = []
    for name in (n.strip() for n in names):
        repeated = name == "Engine_coolant_temperature" and name in header
        header.append(OIL if repeated or name == OIL_IN_FILE else name)
    needed = {"Time(s)", "Class", *_SIGNALS}
    missing = sorted(needed - set(header))
    if missing:
        raise ValueError(f"{path}, line 1: columns {missing} are missing from the header")
    return header


def _read_csv(path: Path, n_rows: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Columns as float64 (empty cell = NaN) and the driver's index of each row."""
    rows: list[list[str]] = []
    try:
        lines = iter(_lines(path))
        header = _header(path, next(lines, []))
        for number, row in enumerate(lines, start=2):
            if len(row) != len(header):
                raise ValueError(
                    f"{path}, line {number}: {len(row)} cells, expected {len(header)} "
                    "(a truncated file?)"
                )
            rows.append(row)
    except (EOFError, OSError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path}, line {len(rows) + 2}: not a whole file ({error}); copy it again"
        ) from error
    if len(rows) != n_rows:
        raise ValueError(f"{path}: {len(rows)} rows, expected {n_rows} (a truncated file?)")
    cells = list(zip(*rows, strict=True))
    columns: dict[str, np.ndarray] = {}
    for name in {"Time(s)", *_SIGNALS}:
        column = cells[header.index(name)]
        try:
            values = np.array([cell or "nan" for cell in column], dtype=np.float64)
        except ValueError:
            number, cell = next((i, c) for i, c in enumerate(column, 2) if not _is_number(c))
            raise ValueError(
                f"{path}, line {number}: {name} is {cell!r}, expected a number"
            ) from None
        if np.isinf(values).any():
            number = int(np.flatnonzero(np.isinf(values))[0]) + 2
            raise ValueError(f"{path}, line {number}: {name} is infinite")
        columns[name] = values
    return columns, _labels(path, cells[header.index("Class")])


def _is_number(cell: str) -> bool:
    try:
        float(cell or "nan")
    except ValueError:
        return False
    return True


def _labels(path: Path, column: Iterable[str]) -> np.ndarray:
    index = {name: i for i, name in enumerate(DRIVER_CLASSES)}
    labels = []
    for number, cell in enumerate(column, start=2):
        if cell not in index:
            raise ValueError(f"{path}, line {number}: Class is {cell!r}, expected A..J")
        labels.append(index[cell])
    return np.array(labels, dtype=np.int32)


def _trips(path: Path, time: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Trip of each row: `Time(s)` restarts at 1 in every trip."""
    if np.isnan(time).any():
        raise ValueError(f"{path}: Time(s) is empty in line {int(np.isnan(time).argmax()) + 2}")
    trip = np.cumsum(np.r_[0, np.diff(time) < 0]).astype(np.int32)
    for g in np.unique(trip):
        if np.unique(labels[trip == g]).size > 1:
            first = int((trip == g).argmax()) + 2
            raise ValueError(
                f"{path}: the trip from line {first} on has several drivers; expected the rows in "
                "the order of the published file"
            )
    return trip


# More holes than this in one trip mean that the signal was not recorded there.
MAX_FILL = 2


def _fill(values: np.ndarray, trip: np.ndarray) -> np.ndarray:
    """Replace up to two missing cells of a trip by the last value before (else after) the hole."""
    values = values.copy()
    missing = np.isnan(values)
    for g in np.unique(trip[missing]):
        holes = np.flatnonzero(missing & (trip == g))
        if holes.size > MAX_FILL:
            continue
        known = np.flatnonzero(~missing & (trip == g))
        for row in holes if known.size else ():
            values[row] = values[known[max(int(np.searchsorted(known, row)) - 1, 0)]]
    return values


def load_driver(
    data_dir: str | Path | None = None,
    *,
    split: str = "random",
    features: str = "complete",
    seed: int = 0,
) -> Dataset:
    """Load the driving data as rows of 15 scalars, scaled to [-1, 1] by training statistics.

    Reads the compact `hcrl_kia_soul.csv.gz` and the published CSV file, whatever its missing cells.

    Args:
        data_dir: folder or file to look at first; then `$FUSION_DATA_DIR` and the user cache.
        split: `random` draws 75,501 training and 18,879 test rows as the source does (neighbouring
            seconds land on both sides); `trip` holds out whole trips, one of each driver.
        features: `complete` = 15 signals that all 94,380 rows have (`DRIVER_CHANNELS`); `tagged` =
            the same with a stand-in that holds for whole trips and so names them; `source` =
            those of Kwak et al. (`DRIVER_SOURCE_CHANNELS`), on the rows that have all of them.
        seed: of the draw of rows or trips.

    Returns:
        Dataset with x `[N, 15, 1]`, ten classes, groups = trips in file order.

    Raises:
        FileNotFoundError: the set is nowhere; the message lists the ways to get it.
        ValueError: unknown split or features, a damaged file, or a trip split that would leave a
            driver without training rows.

    Deviation: the publisher's file could not be read for its checksum, so there is no download.
    """
    check_choice("split", split, get_args(DriverSplit))
    check_choice("features", features, get_args(DriverFeatures))
    path = locate("driver", DRIVER_FILES, data_dir)
    if path is None:
        remedy = (
            "no download: ask the publisher (Hacking and Countermeasure Research Lab, 'Driving "
            "Dataset') for the CSV file and put it into one of these folders"
        )
        raise FileNotFoundError(missing_message("driver", DRIVER_FILES, data_dir, remedy))
    return _to_dataset(
        *_read_csv(path, N_ROWS), path=path, split=split, features=features, seed=seed
    )


def _to_dataset(
    columns: dict[str, np.ndarray],
    labels: np.ndarray,
    *,
    path: Path,
    split: str,
    features: str,
    seed: int,
) -> Dataset:
    trip = _trips(path, columns["Time(s)"], labels)
    names = _NAMES[features]
    x = np.stack([_fill(columns[n], trip) for n in names], axis=1)[:, :, None]
    keep = np.isfinite(x).all(axis=(1, 2))
    if features != "source" and not keep.all():
        row, channel, _ = np.argwhere(np.isnan(x))[0]
        raise ValueError(f"{path}, line {row + 2}: {names[channel]} is empty for a whole trip")
    x, y, group = x[keep], labels[keep], trip[keep]
    if split == "random":
        order = np.random.default_rng(seed).permutation(len(y))
        train = np.zeros(len(y), bool)
        train[order[: len(y) * N_TRAIN // N_ROWS]] = True
    else:
        train = ~np.isin(group, draw_groups(group, y, fraction=0.2, seed=seed))
    scale = fit_scale(x[train], names)
    return check_dataset(
        Dataset(
            name="driver",
            train_x=apply_scale(x[train], scale),
            train_y=y[train],
            test_x=apply_scale(x[~train], scale),
            test_y=y[~train],
            train_group=group[train],
            test_group=group[~train],
            channels=names,
            classes=DRIVER_CLASSES,
            split=split,
            scale=scale,
            source=path.name,
        )
    )
