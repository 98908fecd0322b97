"""The HAR loader: official text layout, compact copy, strict checks, search order, download."""

from __future__ import annotations

import hashlib
import http.server
import io
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fusion.data import har as module
from fusion.data import load, validation_split
from fusion.data.fixed import published_fixed
from fusion.data.har import HAR_CHANNELS, HAR_CLASSES, load_har

COUNTS = {"train": (3, 2, 2, 2, 2, 2), "test": (1, 1, 1, 1, 1, 2)}
SUBJECTS = {"train": (1, 3, 5, 6), "test": (2, 4)}


@pytest.fixture(scope="module")
def raw() -> dict[str, np.ndarray]:
    """A small set with every property of the published one but its size."""
    rng = np.random.default_rng(0)
    out = {}
    for part, counts in COUNTS.items():
        n = sum(counts)
        # Seven digits survive the text format and the float32 of the arrays.
        out[f"X_{part}"] = rng.normal(size=(n, 9, 128)).astype(np.float32)
        out[f"y_{part}"] = rng.permutation(np.repeat(np.arange(1, 7), counts)).astype(np.int8)
        out[f"subject_{part}"] = np.resize(SUBJECTS[part], n).astype(np.int8)
    return out


def texts(raw: dict[str, np.ndarray]) -> dict[str, str]:
    files = {}
    for part in COUNTS:
        for i, channel in enumerate(HAR_CHANNELS):
            lines = [" ".join(f"{v: .9e}" for v in row) for row in raw[f"X_{part}"][:, i]]
            name = f"{part}/Inertial Signals/{channel}_{part}.txt"
            files[name] = "".join(f"  {line}\n" for line in lines)
        for key in ("y", "subject"):
            files[f"{part}/{key}_{part}.txt"] = "".join(f"{v}\n" for v in raw[f"{key}_{part}"])
    return files


@pytest.fixture(scope="module")
def archive(raw: dict[str, np.ndarray]) -> bytes:
    """The publisher's zip: the text files in a zip in a zip."""
    inner, outer = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED) as file:
        for name, text in texts(raw).items():
            file.writestr(f"UCI HAR Dataset/{name}", text)
            file.writestr(f"__MACOSX/UCI HAR Dataset/{name}", "junk")
    with zipfile.ZipFile(outer, "w") as file:
        file.writestr("UCI HAR Dataset.names", "about")
        file.writestr("UCI HAR Dataset.zip", inner.getvalue())
    return outer.getvalue()


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """Published counts of the small set, and no data anywhere but in the test's own folder."""
    if request.node.get_closest_marker("data"):
        return
    monkeypatch.setattr(module, "COUNTS", COUNTS)
    monkeypatch.delenv("FUSION_DATA_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def write_folder(root: Path, raw: dict[str, np.ndarray]) -> Path:
    folder = root / "UCI HAR Dataset"
    for name, text in texts(raw).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def write_npz(root: Path, raw: dict[str, np.ndarray], **changes: np.ndarray) -> Path:
    root.mkdir(parents=True, exist_ok=True)
    path = root / "uci_har_inertial.npz"
    np.savez(path, **{**raw, "channels": np.array(HAR_CHANNELS), **changes})
    return path


def test_all_layouts_give_the_same_set(
    raw: dict[str, np.ndarray], archive: bytes, tmp_path: Path
) -> None:
    npz = load_har(write_npz(tmp_path / "npz" / "har", raw).parents[1])
    folder = load_har(write_folder(tmp_path / "text", raw).parent)
    zipped = tmp_path / "UCI HAR Dataset.zip"
    zipped.write_bytes(archive)
    for other in (folder, load_har(zipped), load_har(tmp_path), load_har(folder_of(tmp_path))):
        for field in ("train_x", "train_y", "train_group", "test_x", "test_y", "test_group"):
            np.testing.assert_array_equal(getattr(other, field), getattr(npz, field))
    assert npz.channels == HAR_CHANNELS and npz.classes == HAR_CLASSES
    assert npz.train_x.dtype == npz.test_x.dtype == np.float32
    assert npz.source == "uci_har_inertial.npz" and folder.source == "UCI HAR Dataset"
    np.testing.assert_array_equal(npz.train_y, raw["y_train"] - 1)


def folder_of(root: Path) -> Path:
    return root / "text" / "UCI HAR Dataset"


def test_scaling_uses_training_rows_only(raw: dict[str, np.ndarray], tmp_path: Path) -> None:
    wide = raw["X_test"].copy()
    wide[0, 3, 7] = 1e3
    data = load_har(write_npz(tmp_path, raw, X_test=wide))
    np.testing.assert_allclose(data.train_x.min(axis=(0, 2)), -1.0)
    np.testing.assert_allclose(data.train_x.max(axis=(0, 2)), 1.0)
    assert data.test_x[0, 3, 7] == 1.0
    low, high = data.scale.low[:, None], data.scale.high[:, None]
    back = (data.train_x.astype(np.float64) + 1.0) / 2.0 * (high - low) + low
    np.testing.assert_allclose(back, raw["X_train"], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "damage", "expected"),
    [
        (
            "train/y_train.txt",
            lambda t: t[: len(t) // 2],
            r"y_train\.txt, line 7: .*expected 13 lines",
        ),
        (
            "test/Inertial Signals/body_gyro_y_test.txt",
            lambda t: t[:-30],
            r"body_gyro_y_test\.txt, line 7: 12\d values, expected 128",
        ),
        (
            "train/Inertial Signals/total_acc_x_train.txt",
            lambda t: t.replace("e", "x", 1),
            r"total_acc_x_train\.txt, line 1: .*expected a finite number",
        ),
        (
            "train/Inertial Signals/total_acc_z_train.txt",
            lambda t: t.splitlines()[0] + "\n" + "nan " * 128 + "\n" + t.split("\n", 2)[2],
            r"total_acc_z_train\.txt, line 2: 'nan' found, expected a finite number",
        ),
        (
            "train/subject_train.txt",
            lambda t: "31" + t[1:],
            r"subject_train line 1 is 31, expected 1..30",
        ),
        ("test/y_test.txt", lambda t: t + "1\n", r"y_test\.txt, line 8"),
    ],
)
def test_damaged_text_names_file_line_and_expectation(
    raw: dict[str, np.ndarray], tmp_path: Path, name: str, damage, expected: str
) -> None:
    folder = write_folder(tmp_path, raw)
    (folder / name).write_text(damage((folder / name).read_text()))
    with pytest.raises(ValueError, match=expected):
        load_har(folder)


def test_missing_text_file_is_named(raw: dict[str, np.ndarray], tmp_path: Path) -> None:
    folder = write_folder(tmp_path, raw)
    (folder / "test/Inertial Signals/body_acc_z_test.txt").unlink()
    with pytest.raises(ValueError, match=r"body_acc_z_test\.txt: no such file"):
        load_har(tmp_path)


def changed(array: np.ndarray, index, value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("key", "change", "expected"),
    [
        ("X_train", lambda a: a[:-1], r"X_train has shape \(12, 9, 128\), expected \(13, 9, 128\)"),
        ("X_test", lambda a: a.transpose(0, 2, 1), r"X_test has shape"),
        ("X_test", lambda a: changed(a, (4, 2, 9), np.nan), r"X_test row 4, channel body_acc_z"),
        ("y_train", lambda a: changed(a, 3, 7), r"y_train line 4 is 7, expected 1..6"),
        ("y_test", lambda a: changed(a, slice(None), 1), r"test windows per activity are \(7, 0"),
        ("subject_test", lambda a: changed(a, 0, 5), r"subjects \[5\] are in training and test"),
        ("channels", lambda a: a[::-1], r"channels are \['total_acc_z'"),
        (
            "X_train",
            lambda a: changed(a, (slice(None), 1), 0.5),
            r"'body_acc_y' is constant \(0.5\)",
        ),
    ],
)
def test_wrong_arrays_are_refused(
    raw: dict[str, np.ndarray], tmp_path: Path, key: str, change, expected: str
) -> None:
    arrays = {**raw, "channels": np.array(HAR_CHANNELS)}
    path = write_npz(tmp_path, raw, **{key: change(arrays[key])})
    with pytest.raises(ValueError, match=expected):
        load_har(path)


def test_truncated_archives_are_refused(
    raw: dict[str, np.ndarray], archive: bytes, tmp_path: Path
) -> None:
    npz = write_npz(tmp_path, raw)
    npz.write_bytes(npz.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"uci_har_inertial\.npz: not a whole npz file"):
        load_har(npz)
    damaged = bytearray(write_npz(tmp_path, raw).read_bytes())
    damaged[3000:3004] = b"\x00\x01\x02\x03"
    npz.write_bytes(bytes(damaged))
    with pytest.raises(ValueError, match=r"uci_har_inertial\.npz: not a whole npz file"):
        load_har(npz)
    np.savez(npz, X_train=raw["X_train"])
    with pytest.raises(ValueError, match=r"arrays .*'y_train'.* are missing"):
        load_har(npz)
    zipped = tmp_path / "UCI HAR Dataset.zip"
    zipped.write_bytes(archive[:-200])
    with pytest.raises(ValueError, match=r"Dataset\.zip: not a whole zip file"):
        load_har(zipped)
    with zipfile.ZipFile(zipped, "w") as file:
        file.writestr("other/readme.txt", "")
    with pytest.raises(ValueError, match=r"no train/y_train\.txt inside"):
        load_har(zipped)


def test_search_order(
    raw: dict[str, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """--data-dir before the environment before the cache; each is told apart by one value."""
    places = {"given": tmp_path / "a", "environment": tmp_path / "b"}
    places["cache"] = tmp_path / "cache" / "snn-fusion-failure"
    for i, folder in enumerate(places.values()):
        write_npz(folder / "har", raw, X_train=changed(raw["X_train"], (0, 0, 0), 10.0 + i))
    monkeypatch.setenv("FUSION_DATA_DIR", str(places["environment"]))
    assert load("har", places["given"]).scale.high[0] == 10.0
    assert load("har").scale.high[0] == 11.0
    monkeypatch.delenv("FUSION_DATA_DIR")
    assert load("har").scale.high[0] == 12.0
    (tmp_path / "empty").mkdir()
    assert load("har", tmp_path / "empty").scale.high[0] == 12.0


def test_nothing_found_lists_the_ways(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as error:
        load("har", tmp_path)
    for way in ("--data-dir", "$FUSION_DATA_DIR", "cache", "--download", "--dataset simulated"):
        assert way in str(error.value)
    with pytest.raises(ValueError, match="nowhere' does not exist"):
        load("har", tmp_path / "nowhere")


@pytest.fixture
def server(archive: bytes) -> Iterator[str]:
    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", str(len(archive)))
            self.end_headers()
            self.wfile.write(archive)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as httpd:
        threading.Thread(target=httpd.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{httpd.server_address[1]}/har.zip"
        httpd.shutdown()


def test_download_is_checked_and_kept(
    archive: bytes, server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "URL", server)
    with pytest.raises(ValueError, match=r"(?i)hash"):
        load("har", download=True)
    with pytest.raises(FileNotFoundError):
        load("har")  # a file that failed its check is not kept
    monkeypatch.setattr(module, "SHA256", hashlib.sha256(archive).hexdigest())
    fetched = load("har", download=True)
    assert fetched.train_x.shape == (13, 9, 128)
    monkeypatch.setattr(module, "URL", "http://127.0.0.1:9/gone")
    np.testing.assert_array_equal(load("har").train_x, fetched.train_x)


@pytest.mark.parametrize(
    ("name", "split", "expected"),
    [
        (
            "hra",
            None,
            r"name='hra': expected one of 'har'.*did you mean 'har'",
        ),
        ("har", "random", r"split='random': expected one of 'subject'"),
    ],
)
def test_unknown_names_list_the_known_ones(name: str, split: str | None, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        load(name, split=split)


@pytest.mark.data
def test_real_set(data_dir: Path) -> None:
    data = load("har", data_dir)
    assert data.train_x.shape == (7352, 9, 128) and data.test_x.shape == (2947, 9, 128)
    assert np.unique(data.train_group).size == 21 and np.unique(data.test_group).size == 9
    part = validation_split(data)
    assert np.unique(part.test_group).size == 4 and np.unique(part.train_group).size == 17
    assert not set(part.test_group.tolist()) & set(part.train_group.tolist())
    assert len(part.train_y) + len(part.test_y) == 7352
    assert (np.bincount(part.test_y) > 0).all()
    # Gravity: total minus body acceleration is smooth and about 1 g in the mean.
    low, high = data.scale.low[:, None], data.scale.high[:, None]
    x = (data.train_x.astype(np.float64) + 1.0) / 2.0 * (high - low) + low
    gravity = np.linalg.norm((x[:, 6:] - x[:, :3]).mean(axis=2), axis=1)
    np.testing.assert_allclose(gravity, 1.0, atol=0.15)
    assert published_fixed(data, 6).failing == (0, 3, 6)
    assert published_fixed(data, 5).failing == (0, 2, 3, 6)
