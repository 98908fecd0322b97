"""The container of a multi-sensor classification set, its scaling and its validation split."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from fusion._checks import check_number


@dataclasses.dataclass(frozen=True, eq=False)
class Scale:
    """Minimum and maximum of every channel over the training rows, `[K]` float64 each."""

    low: np.ndarray
    high: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Dataset:
    """Windows of K sensor channels with labels, split into training and test rows.

    Attributes:
        name: `har`, `driver` or `simulated`.
        train_x, test_x: `[N, K, T]` float32 in [-1, 1]; axis 1 is the channel that a branch reads.
        train_y, test_y: `[N]` int32 labels `0 .. n_classes - 1`.
        train_group, test_group: `[N]` int32 subject or trip of each row.
        channels: K names; classes: names of the labels.
        split: how test rows were taken: `subject`, `trip` or `random`.
        scale: training minimum and maximum of each channel, in the units of the file.
        source: name of the file or folder that was read.

    Example:
        >>> from fusion.data import load
        >>> data = load("simulated")
        >>> data.n_channels, data.train_x.shape[1:] == (data.n_channels, data.n_time)
        (6, True)
    """

    name: str
    train_x: np.ndarray
    train_y: np.ndarray
    test_x: np.ndarray
    test_y: np.ndarray
    train_group: np.ndarray
    test_group: np.ndarray
    channels: tuple[str, ...]
    classes: tuple[str, ...]
    split: str
    scale: Scale
    source: str = ""

    @property
    def n_channels(self) -> int:
        """K, the number of sensor channels."""
        return len(self.channels)

    @property
    def n_classes(self) -> int:
        """The number of labels."""
        return len(self.classes)

    @property
    def n_time(self) -> int:
        """T, samples in a window (1 for rows without a time axis)."""
        return int(self.train_x.shape[2])

    def __repr__(self) -> str:
        """Sizes, not arrays."""
        return (
            f"Dataset({self.name!r}, train={self.train_x.shape}, test={self.test_x.shape}, "
            f"classes={self.n_classes}, split={self.split!r})"
        )


def fit_scale(x: np.ndarray, channels: Sequence[str]) -> Scale:
    """Minimum and maximum of every channel of the training windows `[N, K, T]`.

    Raises:
        ValueError: a channel holds NaN or infinity, or has one value only.
    """
    low = x.min(axis=(0, 2)).astype(np.float64)
    high = x.max(axis=(0, 2)).astype(np.float64)
    for name, a, b in zip(channels, low, high, strict=True):
        if not np.isfinite(a + b):
            raise ValueError(
                f"channel {name!r} of the training rows holds NaN or infinite values: "
                "remove or fill these rows before scaling"
            )
        if a == b:
            raise ValueError(
                f"channel {name!r} is constant ({a:g}) over the training rows and cannot be "
                "scaled to [-1, 1]: leave the channel out"
            )
    return Scale(low, high)


def apply_scale(x: np.ndarray, scale: Scale) -> np.ndarray:
    r"""Scale windows to [-1, 1] and clip what lies outside the training range.

    .. math:: x' = \mathrm{clip}\left(2\,\frac{x - l_k}{h_k - l_k} - 1,\; -1,\; 1\right)

    Symbols: :math:`l_k, h_k` are `scale.low` and `scale.high` of channel k; x is `[N, K, T]`.
    Clipping touches test rows only (no training value lies outside) and keeps every clean input in
    [-1, 1], so that no range check can tell a clean channel from a failed one.

    Returns:
        `[N, K, T]` float32.

    Example:
        >>> scale = Scale(np.array([0.0]), np.array([10.0]))
        >>> apply_scale(np.array([[[0.0, 5.0, 12.0]]]), scale).tolist()
        [[[-1.0, 0.0, 1.0]]]
    """
    low = scale.low[None, :, None]
    width = (scale.high - scale.low)[None, :, None]
    scaled = (x.astype(np.float64) - low) * (2.0 / width) - 1.0
    return np.clip(scaled, -1.0, 1.0).astype(np.float32)


def check_dataset(dataset: Dataset) -> Dataset:
    """Return the set unchanged when its arrays agree with each other, or say what is wrong.

    Raises:
        ValueError: shapes, lengths, label range, an empty class, NaN, or values outside [-1, 1].
    """
    k = dataset.n_channels
    for field in ("channels", "classes"):
        names = getattr(dataset, field)
        if len(set(names)) != len(names):
            twice = sorted({name for name in names if names.count(name) > 1})
            raise ValueError(f"{field}={names}: expected different names; rename {twice}")
    if dataset.n_classes < 2:
        raise ValueError(
            f"classes={dataset.classes}: expected at least two; name what is to be told apart"
        )
    for part in ("train", "test"):
        x: np.ndarray = getattr(dataset, f"{part}_x")
        y: np.ndarray = getattr(dataset, f"{part}_y")
        group: np.ndarray = getattr(dataset, f"{part}_group")
        where = f"{dataset.name} {part} rows"
        for field, array, kinds, wanted in (
            ("x", x, "f", "floating point numbers"),
            ("y", y, "iu", "class numbers"),
        ):
            dtype = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
            if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
                raise TypeError(
                    f"{part}_{field}={dtype}: expected a numpy array of {wanted}; from_arrays "
                    "makes a set from lists and names"
                )
        if x.ndim != 3 or x.shape[1] != k or x.shape[0] == 0:
            raise ValueError(f"{where}: x has shape {x.shape}, expected [N > 0, {k} channels, T]")
        if y.shape != (x.shape[0],) or group.shape != (x.shape[0],):
            raise ValueError(
                f"{where}: y has shape {y.shape} and group {group.shape}, expected ({x.shape[0]},)"
            )
        if y.min() < 0 or y.max() >= dataset.n_classes:
            raise ValueError(
                f"{where}: labels span {y.min()}..{y.max()}, expected 0..{dataset.n_classes - 1}"
            )
        counts = np.bincount(y, minlength=dataset.n_classes)
        if part == "train" and (counts == 0).any():
            missing = [dataset.classes[i] for i in np.flatnonzero(counts == 0)]
            raise ValueError(
                f"{where}: no example of {missing}: a class cannot be learned from none"
            )
        if not np.isfinite(x).all():
            raise ValueError(f"{where}: NaN or infinite values")
        if np.abs(x).max() > 1.0:
            raise ValueError(
                f"{where}: values reach {np.abs(x).max():g}, expected [-1, 1]: use apply_scale"
            )
    return dataset


def draw_groups(
    groups: np.ndarray, labels: np.ndarray, *, fraction: float, seed: int
) -> np.ndarray:
    """Choose whole groups (subjects, trips) to hold out.

    Where every group holds one class only (a trip has one driver), the draw is made class by class
    and leaves at least one group of each class behind; otherwise groups are drawn at large.

    Args:
        groups: `[N]` group of each row.
        labels: `[N]` class of each row.
        fraction: share of the groups to hold out, in (0, 1); at least one group is taken.
        seed: of the draw.

    Returns:
        The chosen group ids, sorted.

    Raises:
        ValueError: fraction outside (0, 1), or too few groups to hold one out.

    Example:
        >>> draw_groups(np.arange(10), np.zeros(10, int), fraction=0.2, seed=0).size
        2
    """
    check_number("fraction", fraction, 0.0, 1.0, above=True, below=True, fix="0.2 is usual")
    rng = np.random.default_rng(seed)
    ids = np.unique(groups)
    classes_of = {int(g): np.unique(labels[groups == g]) for g in ids}
    if all(c.size == 1 for c in classes_of.values()) and np.unique(labels).size > 1:
        pools = [
            np.array([g for g in classes_of if classes_of[g][0] == c]) for c in np.unique(labels)
        ]
    else:
        pools = [ids]
    chosen: list[int] = []
    for pool in pools:
        if pool.size < 2:
            raise ValueError(
                f"group {pool[0]} alone holds class {labels[groups == pool[0]][0]}: it cannot be "
                "in both parts; split by rows instead"
            )
        count = min(max(1, round(fraction * pool.size)), pool.size - 1)
        chosen.extend(rng.choice(pool, size=count, replace=False).tolist())
    return np.sort(np.array(chosen))


def validation_split(
    dataset: Dataset,
    *,
    fraction: float = 0.2,
    groups: Sequence[int] | None = None,
    seed: int = 0,
) -> Dataset:
    """Split the training rows again, for choices that must not see the test rows.

    The way follows the set: whole subjects (HAR: 4 of 21) or whole trips are held out, and rows are
    drawn only where the test split itself draws rows. The scale stays that of all training rows.

    Args:
        dataset: any set.
        fraction: share of groups (or rows) held out.
        groups: hold out exactly these group ids instead of drawing them.
        seed: of the draw.

    Returns:
        A set whose test part is the validation part; the real test rows are not in it.

    Raises:
        ValueError: fraction outside (0, 1); unknown group ids; a class without training rows left.
    """
    if groups is None:
        check_number("fraction", fraction, 0.0, 1.0, above=True, below=True, fix="0.2 is usual")
    known = np.unique(dataset.train_group)
    if groups is not None:
        unknown = sorted(set(map(int, groups)) - set(known.tolist()))
        if unknown or len(groups) == 0:
            raise ValueError(
                f"groups={list(groups)}: expected some of {known.tolist()}; leave the others out"
            )
        held = np.isin(dataset.train_group, np.asarray(groups))
    elif dataset.split == "random":
        n = dataset.train_y.size
        held = np.zeros(n, bool)
        held[np.random.default_rng(seed).permutation(n)[: round(fraction * n)]] = True
    else:
        ids = draw_groups(dataset.train_group, dataset.train_y, fraction=fraction, seed=seed)
        held = np.isin(dataset.train_group, ids)
    if held.all() or not held.any():
        raise ValueError(
            f"{int(held.sum())} of {held.size} rows held out: both parts need rows, "
            "change fraction or groups"
        )
    parts: dict[str, Any] = {}
    for field in ("x", "y", "group"):
        array = getattr(dataset, f"train_{field}")
        parts[f"train_{field}"] = array[~held]
        parts[f"test_{field}"] = array[held]
    return check_dataset(dataclasses.replace(dataset, **parts))
