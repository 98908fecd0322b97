"""UCI HAR: nine inertial channels, six activities, the published subject split.

Source: Anguita, Ghio, Oneto, Parra, Reyes-Ortiz (2013), A public domain dataset for human activity
recognition using smartphones, ESANN. UCI Machine Learning Repository, data set 240.
"""

from __future__ import annotations

import contextlib
import io
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fusion.data.dataset import Dataset, apply_scale, check_dataset, fit_scale
from fusion.data.locate import cache_dir, locate, missing_message

HAR_CHANNELS = tuple(
    f"{signal}_{axis}" for signal in ("body_acc", "body_gyro", "total_acc") for axis in "xyz"
)
HAR_CLASSES = (
    "WALKING",
    "WALKING_UPSTAIRS",
    "WALKING_DOWNSTAIRS",
    "SITTING",
    "STANDING",
    "LAYING",
)
N_TIME = 128
# Windows of each activity as published, in the order of HAR_CLASSES.
COUNTS: dict[str, tuple[int, ...]] = {
    "train": (1226, 1073, 986, 1286, 1374, 1407),
    "test": (496, 471, 420, 491, 532, 537),
}
URL = (
    "https://archive.ics.uci.edu/static/public/240/human+activity+recognition+using+smartphones.zip"
)
# SHA-256 of the publisher's archive, as several independent projects pin it.
SHA256 = "c00b803081a5c797cd5e4b83700a9810b38d53d9d84e01917e090e1fdbc81031"
ARCHIVE = "human+activity+recognition+using+smartphones.zip"
INNER_ARCHIVE = "UCI HAR Dataset.zip"
FOLDER = "UCI HAR Dataset"
HAR_FILES = ("uci_har_inertial.npz", FOLDER, INNER_ARCHIVE, ARCHIVE)

Raw = dict[str, np.ndarray]
Read = Callable[[str], bytes]
Counts = dict[str, tuple[int, ...]]


def _parse(name: str, data: bytes, columns: int, rows: int, dtype: type) -> np.ndarray:
    """A text table `[rows, columns]`; a wrong cell, line or line count is named."""
    try:
        table = np.loadtxt(io.BytesIO(data), dtype=np.float64, ndmin=2)
    except ValueError:
        table = np.empty((0, 0))
    if table.shape != (rows, columns) or not np.isfinite(table).all():
        _explain(name, data, columns, rows)
    return table.astype(dtype)


def _explain(name: str, data: bytes, columns: int, rows: int) -> None:
    """Raise the ValueError that names the first wrong line (the slow way, after a failure)."""
    lines = data.decode("utf-8", errors="replace").splitlines()
    for number, line in enumerate(lines, start=1):
        cells = line.split()
        if len(cells) != columns:
            raise ValueError(
                f"{name}, line {number}: {len(cells)} values, expected {columns} "
                "(a truncated or foreign file?)"
            )
        for cell in cells:
            try:
                finite = np.isfinite(float(cell))
            except ValueError:
                finite = False
            if not finite:
                raise ValueError(
                    f"{name}, line {number}: {cell[:20]!r} found, expected a finite number"
                )
    raise ValueError(
        f"{name}, line {len(lines)}: the file ends, expected {rows} lines "
        "(a truncated or foreign file?)"
    )


def _read_text(read: Read, where: Path, counts: Counts) -> Raw:
    """The official layout: one text file per channel and part, one window a line."""
    raw: Raw = {}
    for part in ("train", "test"):
        rows = sum(counts[part])
        signals = []
        for channel in HAR_CHANNELS:
            name = f"{part}/Inertial Signals/{channel}_{part}.txt"
            signals.append(_parse(f"{where}/{name}", read(name), N_TIME, rows, np.float32))
        raw[f"X_{part}"] = np.stack(signals, axis=1)
        for key in ("y", "subject"):
            name = f"{part}/{key}_{part}.txt"
            table = _parse(f"{where}/{name}", read(name), 1, rows, np.int64)
            raw[f"{key}_{part}"] = table[:, 0]
    return raw


def _read_folder(folder: Path, counts: Counts) -> Raw:
    def read(name: str) -> bytes:
        path = folder / name
        if not path.is_file():
            raise ValueError(f"{path}: no such file, expected the layout of {FOLDER!r} ({name})")
        return path.read_bytes()

    return _read_text(read, folder, counts)


def _read_zip(path: Path, counts: Counts) -> Raw:
    """The archive of the publisher: a zip of text files, today wrapped in a second zip."""
    try:
        with contextlib.ExitStack() as stack:
            archive = stack.enter_context(zipfile.ZipFile(path))
            inner = [n for n in archive.namelist() if n.endswith(INNER_ARCHIVE)]
            if inner:
                data = io.BytesIO(archive.read(inner[0]))
                archive = stack.enter_context(zipfile.ZipFile(data))
            return _read_archive(archive, path, counts)
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise ValueError(
            f"{path}: not a whole zip file ({error}); expected {INNER_ARCHIVE!r}: fetch it again"
        ) from error


def _read_archive(archive: zipfile.ZipFile, path: Path, counts: Counts) -> Raw:
    """The text files below whatever folder of the archive holds `train/` and `test/`."""
    suffix = "train/y_train.txt"
    roots = [n.removesuffix(suffix) for n in archive.namelist() if n.endswith("/" + suffix)]
    root = next((r for r in roots if not r.startswith("__MACOSX")), None)
    if root is None:
        raise ValueError(f"{path}: no {suffix} inside, expected the layout of {FOLDER!r}")

    def read(name: str) -> bytes:
        try:
            return archive.read(root + name)
        except KeyError as error:
            raise ValueError(f"{path}: no {root + name} inside") from error

    return _read_text(read, path, counts)


def _read_npz(path: Path) -> Raw:
    """The compact copy: the same arrays in one compressed numpy file."""
    keys = [f"{key}_{part}" for part in ("train", "test") for key in ("X", "y", "subject")]
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: not a whole npz file (no archive inside); copy it again")
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            missing = sorted(set(keys) - set(file.files))
            if missing:
                raise ValueError(f"{path}: arrays {missing} are missing, expected {keys}")
            if "channels" in file.files and tuple(file["channels"].tolist()) != HAR_CHANNELS:
                raise ValueError(
                    f"{path}: channels are {file['channels'].tolist()}, "
                    f"expected {list(HAR_CHANNELS)}"
                )
            return {key: file[key] for key in keys}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError) as error:
        raise ValueError(f"{path}: not a whole npz file ({error}); copy it again") from error


def _check(raw: Raw, path: Path, counts: Counts) -> Raw:
    """Shapes, label range, subjects and class counts against what is published."""
    for part in ("train", "test"):
        rows = sum(counts[part])
        x, y, subject = (raw[f"{key}_{part}"] for key in ("X", "y", "subject"))
        expected = (rows, len(HAR_CHANNELS), N_TIME)
        if x.shape != expected:
            raise ValueError(f"{path}: X_{part} has shape {x.shape}, expected {expected}")
        if not np.isfinite(x).all():
            row, channel, _ = np.argwhere(~np.isfinite(x))[0]
            raise ValueError(
                f"{path}: X_{part} row {row}, channel {HAR_CHANNELS[channel]} holds NaN or infinity"
            )
        for key, array, high in (("y", y, len(HAR_CLASSES)), ("subject", subject, 30)):
            if array.shape != (rows,):
                raise ValueError(
                    f"{path}: {key}_{part} has shape {array.shape}, expected ({rows},)"
                )
            wrong = np.flatnonzero((array < 1) | (array > high))
            if wrong.size:
                raise ValueError(
                    f"{path}: {key}_{part} line {wrong[0] + 1} is {array[wrong[0]]}, "
                    f"expected 1..{high}"
                )
        found = tuple(np.bincount(y - 1, minlength=len(HAR_CLASSES)).tolist())
        if found != counts[part]:
            raise ValueError(
                f"{path}: the {part} windows per activity are {found}, expected {counts[part]}"
            )
    shared = np.intersect1d(raw["subject_train"], raw["subject_test"])
    if shared.size:
        raise ValueError(f"{path}: subjects {shared.tolist()} are in training and test rows")
    return raw


def _fetch() -> Path:
    import pooch

    return Path(
        pooch.retrieve(
            URL,
            known_hash=f"sha256:{SHA256}",
            fname=ARCHIVE,
            path=cache_dir() / "har",
            progressbar=False,
        )
    )


def load_har(data_dir: str | Path | None = None, *, download: bool = False) -> Dataset:
    """Load the 7,352 training and 2,947 test windows, scaled to [-1, 1] by training statistics.

    Reads `uci_har_inertial.npz` (compact copy), the folder `UCI HAR Dataset` or the published zip.

    Args:
        data_dir: folder or file to look at first; then `$FUSION_DATA_DIR` and the user cache.
        download: fetch the publisher's archive (61 MB, SHA-256 checked) when it is nowhere.

    Returns:
        Dataset with x `[N, 9, 128]`, six classes, groups = subjects 1..30, split `subject`.

    Raises:
        FileNotFoundError: the set is nowhere; the message lists the ways to get it.
        ValueError: a damaged or foreign file; the message names file, line and expectation.
    """
    path = locate("har", HAR_FILES, data_dir)
    if path is None and download:
        path = _fetch()
    if path is None:
        remedy = f"--download, which fetches {URL} (61 MB, SHA-256 checked)"
        raise FileNotFoundError(missing_message("har", HAR_FILES, data_dir, remedy))
    if path.is_dir():
        raw = _read_folder(path, COUNTS)
    elif path.suffix == ".npz":
        raw = _read_npz(path)
    elif path.suffix == ".zip":
        raw = _read_zip(path, COUNTS)
    else:
        raise ValueError(f"{path}: expected one of {list(HAR_FILES)}")
    return _to_dataset(_check(raw, path, COUNTS), path.name)


def _to_dataset(raw: Raw, source: str) -> Dataset:
    scale = fit_scale(raw["X_train"], HAR_CHANNELS)
    return check_dataset(
        Dataset(
            name="har",
            train_x=apply_scale(raw["X_train"], scale),
            train_y=raw["y_train"].astype(np.int32) - 1,
            test_x=apply_scale(raw["X_test"], scale),
            test_y=raw["y_test"].astype(np.int32) - 1,
            train_group=raw["subject_train"].astype(np.int32),
            test_group=raw["subject_test"].astype(np.int32),
            channels=HAR_CHANNELS,
            classes=HAR_CLASSES,
            split="subject",
            scale=scale,
            source=source,
        )
    )
