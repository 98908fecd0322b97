"""Windows of one's own from a file: what fits is read, what does not is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusion.data.own_file import load_file


def save(path: Path, **arrays: object) -> Path:
    np.savez(path, **arrays)  # type: ignore[arg-type]
    return path


def windows() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {"x": rng.normal(size=(40, 3, 8)), "y": np.array(["walk", "sit"] * 20)}


def test_a_file_becomes_a_data_set_with_its_names_and_groups(tmp_path: Path) -> None:
    groups = np.repeat(np.arange(10), 4)
    channels = np.array(["a", "b", "c"])
    data = load_file(save(tmp_path / "my.npz", **windows(), groups=groups, channels=channels))
    assert data.channels == ("a", "b", "c") and data.classes == ("sit", "walk")
    assert not set(data.train_group) & set(data.test_group)
    assert len(data.train_y) + len(data.test_y) == 40 and data.n_time == 8


def test_single_readings_need_no_axis_of_samples(tmp_path: Path) -> None:
    held = windows()
    data = load_file(save(tmp_path / "my.npz", x=held["x"][:, :, 0], y=held["y"]))
    assert data.train_x.shape[1:] == (3, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"y": None}, "add y"),
        ({"labels": np.zeros(40)}, "rename labels"),
        ({"y": np.array([{}] * 40, object)}, "plain arrays"),
        ({"y": np.zeros(39, int)}, r"y.shape=\(39,\)"),
    ],
)
def test_what_does_not_fit_is_named(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    arrays = {n: a for n, a in {**windows(), **change}.items() if a is not None}
    with pytest.raises(ValueError, match=message):
        load_file(save(tmp_path / "my.npz", **arrays))


def test_no_file_and_no_npz_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such file"):
        load_file(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("1,2,3")
    with pytest.raises(ValueError, match=r"expected an .npz file"):
        load_file(tmp_path / "text.npz")
