"""Own arrays as a data set: what fits is split and scaled, what does not is named."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fusion.data import from_arrays
from fusion.data.dataset import check_dataset

RNG = np.random.default_rng(0)
X = RNG.normal(size=(40, 3, 8)) * np.array([1.0, 1e3, 1e-3])[None, :, None]
Y = np.arange(40) % 2
NAMES = ("gyro", "accel", "sound")


def test_names_numbers_and_groups() -> None:
    data = from_arrays(X, ["walk", "rest"] * 20, channels=NAMES)
    column = np.array(["walk", "rest"] * 20, object)  # as a table's column comes
    assert (from_arrays(X, column).train_y == data.train_y).all()
    assert data.classes == ("rest", "walk") and data.train_y[:1].dtype == np.int32
    assert data.train_x.shape == (30, 3, 8) and np.abs(data.train_x).max() == 1.0
    grouped = from_arrays(X, Y, groups=[f"person {i // 5}" for i in range(40)])
    assert not set(grouped.train_group) & set(grouped.test_group)
    assert grouped.channels == ("sensor_0", "sensor_1", "sensor_2") and grouped.split == "group"


@pytest.mark.parametrize(
    ("x", "y", "options", "message"),
    [
        (X, Y + 0.5, {}, r"y.dtype=float64: expected class numbers or names"),
        (X, Y[:-1], {}, r"y.shape=\(39,\): expected \(40,\)"),
        (X, [[0]] * 40, {}, r"y.shape=\(40, 1\): expected \(40,\)"),
        ([[[1.0, 2.0]], [[1.0]]], [0, 1], {}, r"windows of equal length"),
        (X.astype(str), Y, {}, r"convert readings to numbers"),
        (X.transpose(0, 2, 1), Y, {"channels": NAMES}, r"x.transpose\(0, 2, 1\)"),
        (X[:, :, 0], Y, {}, r"x\[:, :, None\] for single readings"),
        (X, np.zeros(40, int), {}, r"expected at least two"),
        (X, Y, {"channels": ("a", "b", "a")}, r"channels=.*rename \['a'\]"),
        (X, ["a", "b"] * 20, {"classes": ("a", "c")}, r"y='b': expected one of \['a', 'c'\]"),
        (X, Y, {"groups": [0]}, r"groups.shape=\(1,\): expected \(40,\)"),
        (X, Y, {"test_fraction": 1.0}, r"test_fraction=1.0: expected a number in \(0, 1\)"),
        (np.where(X > 2, np.nan, X), Y, {}, r"window with NaN or infinity"),
        (X, Y + 1, {}, r"y=class numbers \[1, 2\]: .*return_inverse"),
        (X, 2 * Y - 1, {}, r"y=class numbers \[-1, 1\]: .*return_inverse"),
        (X, 2 * Y, {}, r"y=class numbers \[0, 2\]: .*without gaps"),
        (X, Y, {"seed": -1}, r"seed=-1: expected a whole number of at least 0"),
        (X[:1], Y[:1], {"classes": ("a", "b")}, r"some of 1 windows left for training"),
    ],
)
def test_what_does_not_fit_is_named(x, y, options: dict, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        from_arrays(x, y, **options)


def test_sets_made_by_hand_are_checked_for_kinds() -> None:
    data = from_arrays(X, Y)
    with pytest.raises(TypeError, match="test_y=float64: expected a numpy array"):
        check_dataset(dataclasses.replace(data, test_y=data.test_y.astype(float)))
