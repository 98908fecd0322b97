"""A data set from one's own arrays, checked piece by piece."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fusion._checks import check_count, check_number
from fusion.data.dataset import Dataset, apply_scale, check_dataset, draw_groups, fit_scale


def _windows(x: Any, channels: Sequence[str] | None) -> np.ndarray:
    try:
        array = np.asarray(x)
    except ValueError:
        array = np.empty((), object)
    if array.dtype.kind not in "fiu":
        raise ValueError(
            "x=sequences that make no array of numbers: expected windows of equal length "
            "[N, K, T]; cut them to one length, and convert readings to numbers"
        )
    if array.ndim == 2:
        raise ValueError(
            f"x.shape={array.shape}: expected [N, K, T]; write x[:, :, None] for single readings "
            "[N, K], x[None] for one window"
        )
    k = None if channels is None else len(channels)
    if array.ndim != 3 or 0 in array.shape or (k is not None and array.shape[1] != k):
        swapped = array.ndim == 3 and k is not None and array.shape[2] == k
        fix = "sensors come before samples: x.transpose(0, 2, 1)" if swapped else "check the axes"
        raise ValueError(
            f"x.shape={array.shape}: expected [N > 0, {k or 'K'} sensors, T > 0]; {fix}"
        )
    bad = np.argwhere(~np.isfinite(array))
    if bad.size:
        n, sensor, _ = bad[0]
        raise ValueError(
            f"x[{n}, {sensor}]=window with NaN or infinity: expected finite readings in training; "
            "leave the window out, or fill it"
        )
    return array


def _labels(y: Any, n: int, classes: Sequence[str] | None) -> tuple[np.ndarray, tuple[str, ...]]:
    array = np.asarray(y)
    if array.dtype.kind == "O" and all(isinstance(label, str) for label in array.flat):
        array = array.astype(str)  # as a table's column of names comes
    if array.shape != (n,):
        raise ValueError(f"y.shape={array.shape}: expected ({n},); give one label for each window")
    if array.dtype.kind in "US":
        names = tuple(sorted(set(array.tolist()))) if classes is None else tuple(classes)
        unknown = sorted(set(array.tolist()) - set(names))
        if unknown:
            raise ValueError(f"y={unknown[0]!r}: expected one of {list(names)}; name it in classes")
        return np.asarray([names.index(v) for v in array.tolist()], np.int32), names
    if array.dtype.kind not in "iu":
        raise TypeError(
            f"y.dtype={array.dtype}: expected class numbers or names; write y.astype(int) if they "
            "are whole"
        )
    present = set(array.tolist())
    count = max(present) + 1
    if min(present) < 0 or (classes is None and len(present) < count):
        raise ValueError(
            f"y=class numbers {sorted(present)[:8]}: expected 0, 1, 2 ... without gaps; write "
            "numpy.unique(y, return_inverse=True)[1], or give them as names"
        )
    names = tuple(map(str, range(count))) if classes is None else tuple(classes)
    return array.astype(np.int32), names


def from_arrays(
    x: Any,
    y: Any,
    *,
    groups: Any = None,
    channels: Sequence[str] | None = None,
    classes: Sequence[str] | None = None,
    test_fraction: float = 0.25,
    seed: int = 0,
    name: str = "own",
) -> Dataset:
    """A data set from windows and labels: split, scaled to [-1, 1], checked.

    Args:
        x: `[N, K, T]` windows of K sensors in their own units.
        y: `[N]` class numbers 0 .. C-1, or names.
        groups: `[N]` what must not be torn apart between training and test (a person, a trip);
            without it rows are drawn.
        channels: K names; `sensor_0` and so on when left out.
        classes: names of the labels, in the order of the numbers.
        test_fraction: share of the groups (or rows) that become test rows.
        seed: of the draw.
        name: of the set.

    Returns:
        The set; the scale is that of the training rows.

    Raises:
        TypeError: labels that are neither numbers of classes nor names.
        ValueError: anything that does not fit, with what to do.

    Example:
        >>> x, y = np.random.default_rng(0).normal(size=(40, 3, 8)), ["a", "b"] * 20
        >>> data = from_arrays(x, y, channels=("gyro", "accel", "sound"))
        >>> data.train_x.shape, data.classes
        ((30, 3, 8), ('a', 'b'))
    """
    check_number("test_fraction", test_fraction, 0.0, 1.0, above=True, below=True)
    check_count("seed", seed, 0)
    windows = _windows(x, channels)
    n, k, _ = windows.shape
    names = tuple(f"sensor_{i}" for i in range(k)) if channels is None else tuple(channels)
    labels, known = _labels(y, n, classes)
    if groups is None:
        order = np.random.default_rng(seed).permutation(n)
        held = np.zeros(n, bool)
        held[order[: max(1, round(test_fraction * n))]] = True
        group = np.zeros(n, np.int32)
    else:
        group = np.unique(np.asarray(groups), return_inverse=True)[1].astype(np.int32)
        if group.shape != (n,):
            raise ValueError(
                f"groups.shape={np.shape(groups)}: expected ({n},); give one for each window"
            )
        held = np.isin(group, draw_groups(group, labels, fraction=test_fraction, seed=seed))
    if held.all():
        raise ValueError(
            f"test_fraction={test_fraction}: expected some of {n} windows left for training; "
            "lower it, or give more windows"
        )
    scale = fit_scale(windows[~held], names)
    parts = {
        f"{part}_{field}": array[rows]
        for part, rows in (("train", ~held), ("test", held))
        for field, array in (("x", apply_scale(windows, scale)), ("y", labels), ("group", group))
    }
    return check_dataset(
        Dataset(
            name=name,
            channels=names,
            classes=known,
            split="random" if groups is None else "group",
            scale=scale,
            source="arrays",
            **parts,
        )
    )
