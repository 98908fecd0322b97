"""The driving data loader: both CSV layouts, missing cells, trips, splits, strict checks."""

from __future__ import annotations

import csv
import gzip
import io
from pathlib import Path

import numpy as np
import pytest

from fusion.data import driver as module
from fusion.data import load, validation_split
from fusion.data.driver import (
    DRIVER_CHANNELS,
    DRIVER_CLASSES,
    DRIVER_REPLACEMENTS,
    DRIVER_SOURCE_CHANNELS,
    DRIVER_TAGGED_CHANNELS,
    load_driver,
)
from fusion.data.fixed import fixed_sets, published_fixed

N_SECONDS = 12
TRIPS = [*DRIVER_CLASSES, *DRIVER_CLASSES, *DRIVER_CLASSES, "B", "D"]
SIGNALS = sorted({*DRIVER_CHANNELS, *DRIVER_TAGGED_CHANNELS, *DRIVER_SOURCE_CHANNELS})


def published_name(name: str) -> str:
    return "Engine_coolant_temperature" if name == "Transmission_oil_temperature" else name


@pytest.fixture(scope="module")
def table() -> tuple[list[str], list[list[str]]]:
    """The layout of the published CSV file, whose header repeats the coolant's name."""
    rng = np.random.default_rng(0)
    header = [*map(published_name, SIGNALS), "Time(s)", "Class", "PathOrder"]
    rows = []
    for driver in TRIPS:
        for second in range(1, N_SECONDS + 1):
            values = [f"{v:.2f}" for v in rng.normal(size=len(SIGNALS))]
            rows.append([*values, str(second), driver, "1"])
    assert header.count("Engine_coolant_temperature") == 2
    return header, rows


@pytest.fixture(autouse=True)
def small(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    table: tuple[list[str], list[list[str]]],
    request: pytest.FixtureRequest,
) -> None:
    if request.node.get_closest_marker("data"):
        return
    monkeypatch.setattr(module, "N_ROWS", len(table[1]))
    monkeypatch.setattr(module, "N_TRAIN", 300)
    monkeypatch.delenv("FUSION_DATA_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def write(path: Path, header: list[str], rows: list[list[str]]) -> Path:
    text = io.StringIO(newline="")
    csv.writer(text).writerows([header, *rows])
    path.parent.mkdir(parents=True, exist_ok=True)
    data = text.getvalue().encode()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


def edited(rows: list[list[str]], row: int, column: int, cell: str) -> list[list[str]]:
    rows = [list(r) for r in rows]
    rows[row][column] = cell
    return rows


def raw_column(table: tuple[list[str], list[list[str]]], name: str) -> np.ndarray:
    return np.array([float(r[SIGNALS.index(name)]) for r in table[1]])


def test_both_layouts_and_places(
    table: tuple[list[str], list[list[str]]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header, rows = table
    original = load_driver(write(tmp_path / "a" / module.DRIVER_FILES[2], header, rows).parent)
    # The compact copy tells the two temperatures apart and has columns of its own.
    named = [
        "Engine_coolant_temperature.1" if s == "Transmission_oil_temperature" else s
        for s in SIGNALS
    ]
    extra = [[*r, "0"] for r in rows]
    compact_header = [*named, "Time(s)", "Class", "PathOrder", "trip"]
    write(tmp_path / "b" / "driver" / "hcrl_kia_soul.csv.gz", compact_header, extra)
    monkeypatch.setenv("FUSION_DATA_DIR", str(tmp_path / "b"))
    compact = load("driver")
    for field in ("train_x", "train_y", "train_group", "test_x", "test_y", "test_group"):
        np.testing.assert_array_equal(getattr(compact, field), getattr(original, field))
    assert original.channels == DRIVER_CHANNELS and original.n_time == 1
    assert original.train_x.dtype == np.float32
    # Every channel is the column of its name: same order of values as in the file, trip by trip.
    both = np.concatenate([original.train_group, original.test_group])
    assert np.bincount(both).tolist() == [N_SECONDS] * len(TRIPS)
    for k, name in enumerate(DRIVER_CHANNELS):
        values = np.concatenate([original.train_x[:, k, 0], original.test_x[:, k, 0]])
        low, high = original.scale.low[k], original.scale.high[k]
        back = (values.astype(np.float64) + 1.0) / 2.0 * (high - low) + low
        expected = np.clip(raw_column(table, name), low, high)
        np.testing.assert_allclose(np.sort(back), np.sort(expected), atol=1e-5)


def test_random_split_has_the_right_sizes_and_follows_the_seed(
    table: tuple[list[str], list[list[str]]], tmp_path: Path
) -> None:
    path = write(tmp_path / "hcrl_kia_soul.csv", *table)
    a, b, c = (load_driver(path, seed=s) for s in (0, 0, 1))
    assert len(a.train_y) == 300 and len(a.test_y) == len(table[1]) - 300
    np.testing.assert_array_equal(a.train_x, b.train_x)
    assert not np.array_equal(a.train_group, c.train_group)
    part = validation_split(a, fraction=0.2)
    assert len(part.test_y) == 60 and len(part.train_y) == 240


def test_trip_split_shares_no_trip(
    table: tuple[list[str], list[list[str]]], tmp_path: Path
) -> None:
    data = load("driver", write(tmp_path / "hcrl_kia_soul.csv", *table), split="trip", seed=3)
    part = validation_split(data, seed=1)
    held = [set(data.test_group.tolist()), set(part.test_group.tolist())]
    left = set(part.train_group.tolist())
    assert len(held[0]) == len(held[1]) == 10
    assert not held[0] & held[1] and not left & (held[0] | held[1])
    for y in (data.train_y, data.test_y, part.train_y, part.test_y):
        assert np.unique(y).tolist() == list(range(10))
    with pytest.raises(ValueError, match="expected some of"):
        validation_split(data, groups=sorted(held[0]))
    named = validation_split(data, groups=sorted(left)[:3])
    assert sorted(set(named.test_group.tolist())) == sorted(left)[:3]


def test_single_holes_are_filled_within_the_trip(
    table: tuple[list[str], list[list[str]]], tmp_path: Path
) -> None:
    header, rows = table
    column = SIGNALS.index("Fuel_consumption")
    holes = edited(edited(rows, 2 * N_SECONDS, column, ""), 5, column, "")
    data = load_driver(write(tmp_path / "hcrl_kia_soul.csv", header, holes))
    filled = edited(
        edited(rows, 2 * N_SECONDS, column, rows[2 * N_SECONDS + 1][column]),
        5,
        column,
        rows[4][column],
    )
    expected = load_driver(write(tmp_path / "hcrl_kia_soul.csv", header, filled))
    np.testing.assert_array_equal(data.train_x, expected.train_x)
    np.testing.assert_array_equal(data.test_x, expected.test_x)


def test_rows_without_the_source_features_are_left_out(
    table: tuple[list[str], list[list[str]]], tmp_path: Path
) -> None:
    header, rows = table
    column = SIGNALS.index("Torque_converter_speed")
    for row in range(4 * N_SECONDS, 5 * N_SECONDS):
        rows = edited(rows, row, column, "")
    path = write(tmp_path / "hcrl_kia_soul.csv", header, rows)
    data = load_driver(path, features="source", split="trip")
    assert data.channels == DRIVER_SOURCE_CHANNELS
    groups = set(data.train_group.tolist()) | set(data.test_group.tolist())
    assert groups == set(range(len(TRIPS))) - {4}
    assert len(load_driver(path).train_y) == 300  # the 15 complete signals keep every row
    sets = fixed_sets(data)
    assert {n: len(names) for n, names in sets.items()} == {5: 10, 7: 8}
    assert published_fixed(data, 7).failing == published_fixed(load_driver(path), 7).failing


def test_fixed_sets_follow_the_replacements() -> None:
    assert len(set(DRIVER_CHANNELS)) == len(DRIVER_CHANNELS) == 15
    assert set(DRIVER_REPLACEMENTS) < set(DRIVER_SOURCE_CHANNELS)
    assert not set(DRIVER_REPLACEMENTS.values()) & set(DRIVER_SOURCE_CHANNELS)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda h, r: (h, r[:-3]), r"csv: 381 rows, expected 384"),
        (lambda h, r: (h, [*r[:9], r[9][:5], *r[10:]]), r"csv, line 11: 5 cells, expected"),
        (lambda h, r: (["x", *h[1:]], r), r"csv, line 1: columns \['Acc.*'\] are missing"),
        (lambda h, r: (h, edited(r, 6, 2, "12a")), r"csv, line 8: .* is '12a', expected a number"),
        (lambda h, r: (h, edited(r, 6, 2, "inf")), r"csv, line 8: .* is infinite"),
        (lambda h, r: (h, edited(r, 3, -2, "K")), r"csv, line 5: Class is 'K', expected A..J"),
        (lambda h, r: (h, edited(r, 30, -3, "")), r"Time\(s\) is empty in line 32"),
        (lambda h, r: (h, edited(r, 30, -2, "A")), r"trip from line 26 on has several drivers"),
        (lambda h, r: ([], []), r"csv, line 1: columns"),
    ],
)
def test_damaged_files_name_the_line(
    table: tuple[list[str], list[list[str]]], tmp_path: Path, change, expected: str
) -> None:
    path = write(tmp_path / "hcrl_kia_soul.csv", *change(*table))
    with pytest.raises(ValueError, match=expected):
        load_driver(path)


def test_truncated_gzip_is_refused(
    table: tuple[list[str], list[list[str]]], tmp_path: Path
) -> None:
    path = write(tmp_path / "hcrl_kia_soul.csv.gz", *table)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(ValueError, match=r"csv\.gz, line \d+: not a whole file"):
        load_driver(path)


def test_a_signal_missing_for_a_trip_is_refused(
    table: tuple[list[str], list[list[str]]], tmp_path: Path
) -> None:
    header, rows = table
    for row in range(N_SECONDS):
        rows = edited(rows, row, SIGNALS.index("Engine_speed"), "")
    path = write(tmp_path / "hcrl_kia_soul.csv", header, rows)
    with pytest.raises(ValueError, match=r"line 2: Engine_speed is empty"):
        load_driver(path)


def test_bad_options(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"split='rows': expected one of 'random', 'trip'"):
        load_driver(tmp_path, split="rows")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"expected one of 'complete', 'tagged', 'source'"):
        load_driver(tmp_path, features="all")  # type: ignore[arg-type]
    with pytest.raises(FileNotFoundError, match=r"no download: ask the publisher"):
        load_driver(tmp_path)


@pytest.mark.data
def test_real_set(data_dir: Path) -> None:
    data = load("driver", data_dir)
    assert data.train_x.shape == (75_501, 15, 1) and data.test_x.shape == (18_879, 15, 1)
    drivers = np.bincount(np.concatenate([data.train_y, data.test_y]))
    assert drivers.tolist() == [7240, 12864, 7500, 13244, 8436, 11012, 7492, 9880, 7808, 8904]
    assert np.unique(data.train_group).size == module.N_TRIPS
    fails = {n: published_fixed(data, n).failing for n in (5, 7)}
    assert len(fails[5]) == 10 and len(fails[7]) == 8 and set(fails[7]) < set(fails[5])


def test_no_stand_in_of_the_default_set_holds_for_whole_trips() -> None:
    """The earlier set has one, which is the only difference between them."""
    assert "Engine_soacking_time" not in DRIVER_CHANNELS
    differ = {
        pair
        for pair in zip(DRIVER_CHANNELS, DRIVER_TAGGED_CHANNELS, strict=True)
        if len(set(pair)) > 1
    }
    assert differ == {("Steering_wheel_speed", "Engine_soacking_time")}
    with pytest.raises(ValueError, match="features='complete'"):
        load("har", features="complete")
