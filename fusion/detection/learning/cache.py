"""Frames prepared once: examples of fixed size on disk, anchor sizes from the labels, counts.

A cache folder holds `000000.npz` for each frame (of the benchmark's testing part, whose names come
again, `testing/000000.npz`) and `cache.json` with preset, splits, anchor sizes and what was left
out.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from fusion.detection.config import TARGETS, DetectorConfig, Target
from fusion.detection.geometry.planes import PlaneConfig
from fusion.detection.kitti.files import frame_names, read_frame, read_split
from fusion.detection.learning.examples import MAX_REGIONS, Example, make_example
from fusion.detection.learning.label_sizes import anchor_sizes
from fusion.detection.presets import preset
from fusion.detection.sensors.beams import beams_of_scans, elevations_of

_SCANS = 10  # of which the beams are told
TESTING = "testing"
"""The split of all frames in `ROOT/testing`, which have no labels; not a list of `ImageSets`."""


def frame_part(split: str) -> str:
    """The folder below ROOT that a split's frames are in: `training` or `testing`."""
    return TESTING if split == TESTING else "training"


def _example_folder(folder: Path, part: str) -> Path:
    return folder / TESTING if part == TESTING else folder


@dataclasses.dataclass(frozen=True)
class Cache:
    """What `cache.json` says.

    Attributes:
        folder: where the examples are.
        root: folder of the frames it was made from.
        size: of the detector's preset; decides the sizes of all arrays.
        splits: split name -> frame names.
        sizes: anchor sizes [m], from the training labels.
        counts: frames fitted, skipped, missing; points and labels left out.
        target: class of the labels that the examples hold.
        beams: elevations of the lidar's beams [degree], see `DetectorConfig`.
    """

    folder: Path
    root: Path
    size: str
    splits: dict[str, tuple[str, ...]]
    sizes: tuple[tuple[float, float, float], ...]
    counts: dict[str, Any]
    target: Target = "Car"
    beams: tuple[float, ...] | None = None

    def config(self, model: str) -> DetectorConfig:
        """The detector of this size with this cache's class and anchor sizes."""
        base = preset(self.size, model).config
        anchors = dataclasses.replace(base.anchors, sizes=self.sizes)
        made = dataclasses.replace(base, target=self.target, anchors=anchors, beams=self.beams)
        # Few anchors overlap a small object by as much as one overlaps a car.
        limits = {"rpn_iou": (0.3, 0.45), "second_iou": (0.45, 0.55)}
        return made if self.target == "Car" else dataclasses.replace(made, **limits)  # type: ignore[arg-type]

    def read(self, split: str) -> list[Example]:
        """All examples of a split, in memory."""
        return [read_example(self.examples(split), name) for name in self.names(split)]

    def examples(self, split: str) -> Path:
        """Folder of a split's examples."""
        return _example_folder(self.folder, frame_part(split))

    def names(self, split: str) -> tuple[str, ...]:
        """Frames of a split.

        Raises:
            ValueError: it was not prepared.
        """
        if split not in self.splits:
            raise ValueError(
                f"{self.folder} has the splits {', '.join(self.splits)}, not {split!r}: run "
                f"`prepare --add --splits {split}`"
            )
        return self.splits[split]


def write_example(folder: Path, name: str, example: Example) -> None:
    """Write one example; a reader sees the whole file or none."""
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f".{name}.npz"
    with temporary.open("wb") as file:
        arrays: dict[str, Any] = {k: np.asarray(v) for k, v in example._asdict().items()}
        np.savez(file, **arrays)
    os.replace(temporary, folder / f"{name}.npz")


def read_example(folder: Path, name: str) -> Example:
    """Read one example. Raises FileNotFoundError when it was not prepared."""
    path = folder / f"{name}.npz"
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: run `prepare` first")
    with np.load(path) as held:
        # Caches until 0.2 ignore nothing.
        absent = {"ignored": np.zeros(len(held["truth"]), bool)}
        absent["regions"] = np.zeros((MAX_REGIONS, 4), np.float32)
        fields = (held[f] if f in held else absent[f] for f in Example._fields)
        return Example(*fields)


def split_frames(root: Path, splits: Sequence[str]) -> tuple[dict[str, tuple[str, ...]], int]:
    """Frames of each split that are on disk, and how many listed ones are not.

    Args:
        root: KITTI folder.
        splits: lists of `ImageSets`, or `testing` for all frames of `ROOT/testing`.

    Raises:
        FileNotFoundError: a list or the image folder is missing.
        ValueError: none of a list's frames is there, or the list of test frames has training ones.
    """
    found: dict[str, tuple[str, ...]] = {}
    missing = 0
    for split in splits:
        folder = root / frame_part(split) / "image_2"
        images = frame_names(folder, ".png")
        # All of `testing` there is; a list of it would only repeat the folder.
        listed = images if split == TESTING else read_split(root / "ImageSets" / f"{split}.txt")
        present = set(images)
        found[split] = tuple(name for name in listed if name in present)
        missing += len(listed) - len(found[split])
        if not found[split]:
            where = folder.relative_to(root)
            if split == TESTING:
                raise ValueError(f"{root}: no image in {where}")
            raise ValueError(
                f"{root}: none of the {len(listed)} frames of ImageSets/{split}.txt has an image "
                f"in {where}"
            )
    train = root / "ImageSets" / "train.txt"
    if "test" in found and train.is_file():
        shared = set(found["test"]) & set(read_split(train))
        if shared:
            raise ValueError(
                f"{root}: {len(shared)} frames of ImageSets/test.txt are in train.txt too, such as "
                f"{min(shared)}: the benchmark's test list names frames of the folder `testing`, "
                "whose split is called `testing`"
            )
    return found, missing


def _read_frames(
    folder: Path,
    frames: Sequence[tuple[str, str]],
    make: Callable[[str, str], tuple[Example, dict[str, int | bool]]],
    *,
    skip_bad: bool,
    on_frame: Callable[[int, int, str], None] | None,
) -> dict[str, Any]:
    """Write what is made of (part, name); returns counts of what was left out."""
    counts: dict[str, Any] = {
        "skipped": {}, "plane_fitted": 0, "points_dropped": 0, "labels_dropped": 0,
    }  # fmt: skip
    for done, (part, name) in enumerate(frames):
        try:
            example, left_out = make(part, name)
        except (ValueError, FileNotFoundError) as error:
            if not skip_bad:
                raise
            counts["skipped"][_skip_key(part, name)] = str(error)
            continue
        for key, value in left_out.items():
            counts[key] += int(value)
        write_example(_example_folder(folder, part), name, example)
        if on_frame is not None:
            on_frame(done + 1, len(frames), name)
    return counts


def _skip_key(part: str, name: str) -> str:
    return f"{part}/{name}" if part == TESTING else name


def prepare_cache(
    root: Path,
    folder: Path,
    size: str,
    *,
    splits: Sequence[str] = ("train", "val"),
    add: bool = False,
    like: Cache | None = None,
    copies: bool = False,
    any_size: bool = False,
    skip_bad: bool = False,
    ground: PlaneConfig | None = None,
    target: str = "Car",
    beams: int | Sequence[float] | None = None,
    on_frame: Callable[[int, int, str], None] | None = None,
) -> Cache:
    """Read every frame of the split lists, check it, and write its example.

    Args:
        root: KITTI folder (`training`, `ImageSets`; `testing` for the split of that name).
        folder: of the cache.
        size: of the detector's preset.
        splits: lists to read; the first one gives the anchor sizes.
        add: add the lists to the cache that is there, whose lists and anchor sizes stay.
        like: take the anchor sizes of this cache, so that its detectors can be evaluated on these
            frames, such as a corrupted copy of its validation list.
        copies: the frames are corrupted copies of those of `like`, under the same names: their
            ground planes are taken from there, and a sensor may be dead.
        any_size: accept images of other sizes than the benchmark's.
        skip_bad: leave out frames that cannot be used, and count them, instead of stopping.
        ground: where ground planes are looked for; the benchmark's car when left out.
        target: class of the labels; that of the cache to add to, or to be like, counts first.
        beams: number of the lidar's beams, or their elevations [degree]; from the scans when left
            out. Those of the other cache count first, too.
        on_frame: called with (done, all, name).

    Raises:
        FileNotFoundError: a folder, list or (unless `skip_bad`) a file of a frame is missing; or
            there is no cache to add to.
        ValueError: (unless `skip_bad`) a frame is damaged; nothing is left of a split; the cache to
            add to has another size or one of the lists; `copies` without `like`; or `testing`,
            which has no labels, would have to give the anchor sizes.
    """
    if target not in TARGETS:
        raise ValueError(f"target={target!r}: expected one of {', '.join(TARGETS)}")
    held = open_cache(folder) if add else None
    other = held or like
    wanted = cast(Target, target) if other is None else other.target
    config = dataclasses.replace(preset(size).config, target=wanted)
    if held is not None and (held.size != size or set(splits) & set(held.splits)):
        raise ValueError(
            f"{folder} has size {held.size!r} and the splits {', '.join(held.splits)}: cannot "
            f"add {', '.join(splits)} of size {size!r}; prepare all in another cache folder"
        )
    if like is not None and (like.size != size or held is not None):
        raise ValueError(
            f"{folder}: the cache to be like has size {like.size!r}, not {size!r}"
            if held is None
            else f"{folder}: add to a cache, or make one like another, not both"
        )
    if copies and like is None:
        raise ValueError("copies=True: expected the cache of the frames themselves; give `like`")
    if held is None and like is None and splits[0] == TESTING:
        raise ValueError(
            f"{folder}: testing frames have no labels to take anchor sizes from: prepare the "
            "training list first"
        )
    found, missing = split_frames(root, splits)
    everything = sorted({(frame_part(split), name) for split in found for name in found[split]})

    scans: list[np.ndarray] = []

    def make(part: str, name: str) -> tuple[Example, dict[str, int | bool]]:
        frame = read_frame(root, name, part=part, any_size=any_size, may_be_dead=copies)
        if len(scans) < _SCANS:
            scans.append(elevations_of(frame.points))
        plane = None
        if like is not None and copies:
            plane = np.asarray(read_example(_example_folder(like.folder, part), name).plane)
        return make_example(config, frame, ground, plane=plane)

    counts = {"missing": missing} | _read_frames(
        folder, everything, make, skip_bad=skip_bad, on_frame=on_frame
    )
    kept = {
        split: tuple(n for n in names if _skip_key(frame_part(split), n) not in counts["skipped"])
        for split, names in found.items()
    }
    for split, names in kept.items():
        if not names:
            first = next(iter(counts["skipped"].values()))
            raise ValueError(f"every frame of the split {split} was skipped; the first: {first}")
    if like is not None:
        sizes = like.sizes
    elif held is None:
        sizes = anchor_sizes(root, kept[splits[0]], len(config.anchors.sizes), wanted)
    else:
        sizes, kept = held.sizes, held.splits | kept
        skipped = held.counts["skipped"] | counts.pop("skipped")
        counts = {k: n + held.counts[k] for k, n in counts.items()} | {"skipped": skipped}
    told = other.beams if other is not None else beams_of_scans(scans, beams)
    cache = Cache(folder, root, size, kept, sizes, counts, wanted, told)
    record = dataclasses.asdict(cache) | {"folder": str(folder), "root": str(root)}
    temporary = folder / ".cache.json"
    temporary.write_text(json.dumps(record, indent=1), encoding="utf-8")
    os.replace(temporary, folder / "cache.json")
    return cache


def open_cache(folder: Path) -> Cache:
    """Read `cache.json`. Raises FileNotFoundError when there is none."""
    path = folder / "cache.json"
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist: run `prepare` first")
    held = json.loads(path.read_text(encoding="utf-8"))
    return Cache(
        folder=folder,
        root=Path(held["root"]),
        size=held.get("size") or held["preset"],  # its name until 0.2
        splits={split: tuple(names) for split, names in held["splits"].items()},
        sizes=tuple((a, b, c) for a, b, c in held["sizes"]),
        counts=held["counts"],
        target=held.get("target", "Car"),
        beams=None if held.get("beams") is None else tuple(held["beams"]),
    )
