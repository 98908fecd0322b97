r"""Where things stand in a simulated scene: drawn from label files, or from a fitted model of them.

The model, for use without label files: the number of vehicles is negative binomial, depth z is a
gamma variable, the lateral place x one of five normal lanes (parked left, oncoming, ahead, parked
right, elsewhere), headings lie along the road (sd 0.06) but for one in four, and sizes are normal.

.. math:: n \sim NB(\mu = 4.4, \sigma^2 = 12.6), \qquad z \sim \Gamma(k = 2.95, \theta = 9.5 m)

Source: moments of the 7,481 published training labels of Geiger et al. (2012), counted by us.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fusion.detection.geometry.overlaps import rotated_intersection
from fusion.detection.kitti.files import frame_names, read_labels
from fusion.detection.kitti.objects import DONT_CARE, KITTI_TYPES, NO_BOX3D

MAX_DEPTH = 75.0  # [m], a little over the area that detectors look at
MAX_SIDE = 40.0  # [m]

# Mean and sd of height, width, length [m], and the share among vehicles or among the others.
_SIZES = {
    "Car": ((1.53, 1.63, 3.88), (0.14, 0.10, 0.43), 0.88),
    "Van": ((2.21, 1.90, 5.08), (0.32, 0.17, 0.83), 0.09),
    "Truck": ((3.25, 2.59, 10.11), (0.45, 0.22, 2.86), 0.03),
    "Pedestrian": ((1.76, 0.66, 0.84), (0.11, 0.14, 0.23), 0.74),
    "Cyclist": ((1.74, 0.60, 1.76), (0.09, 0.12, 0.18), 0.26),
}
_VEHICLES, _OTHERS = ("Car", "Van", "Truck"), ("Pedestrian", "Cyclist")
# Mean x, sd of x [m], share, and how many of them face away from the camera.
_LANES = (
    (-8.5, 2.5, 0.28, 0.35),
    (-4.2, 1.2, 0.24, 0.30),
    (0.2, 1.0, 0.13, 0.90),
    (4.2, 1.5, 0.21, 0.90),
    (0.0, 16.0, 0.14, 0.50),
)


@dataclasses.dataclass(frozen=True, eq=False)
class Layout:
    """Things on the ground, before anything is rendered.

    Attributes:
        type: `[n]` KITTI classes; what a look-alike looks like to the lidar.
        size: `[n, 3]` height, width, length [m].
        ground: `[n, 2]` x, z of the middle in the camera frame [m].
        rotation_y: `[n]` heading [rad].
        look_alike: `[n]` whether it only has the shape of its class, and gets no label.
    """

    type: np.ndarray
    size: np.ndarray
    ground: np.ndarray
    rotation_y: np.ndarray
    look_alike: np.ndarray

    def __len__(self) -> int:
        """Number of things."""
        return int(self.rotation_y.shape[0])

    def footprints(self) -> np.ndarray:
        """`[n, 5]` x, z, length, width, rotation on the ground."""
        return np.column_stack([self.ground, self.size[:, [2, 1]], self.rotation_y])


def _take(layout: Layout, index: np.ndarray) -> Layout:
    return Layout(*(getattr(layout, f.name)[index] for f in dataclasses.fields(Layout)))


def _join(parts: Sequence[Layout]) -> Layout:
    names = [f.name for f in dataclasses.fields(Layout)]
    return Layout(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def _clear_of_camera(layout: Layout) -> Layout:
    """Without what contains the camera, stands behind it or lies outside the scene."""
    x, z = layout.ground.T
    reach = 0.5 * np.hypot(layout.size[:, 1], layout.size[:, 2])
    keep = (np.hypot(x, z) > reach + 0.5) & (z > 0.0) & (z < MAX_DEPTH) & (np.abs(x) < MAX_SIDE)
    return _take(layout, np.flatnonzero(keep))


def read_layouts(folder: str | Path) -> list[Layout]:
    """The layouts of all label files in `folder` that have an object with a 3D box.

    Raises:
        FileNotFoundError: there is no such folder.
        ValueError: a label file is damaged, or there is no object at all.
    """
    layouts = []
    for name in frame_names(folder):
        labels = read_labels(Path(folder) / f"{name}.txt")
        solid = (labels.type != DONT_CARE) & (labels.location[:, 2] != NO_BOX3D)
        layout = _clear_of_camera(
            Layout(
                labels.type[solid],
                labels.dimensions[solid],
                labels.location[solid][:, [0, 2]],
                labels.rotation_y[solid],
                np.zeros(int(solid.sum()), bool),
            )
        )
        if len(layout):
            layouts.append(layout)
    if not layouts:
        raise ValueError(f"{folder} holds no object with a 3D box, expected KITTI label files")
    return layouts


def keep_apart(layout: Layout) -> Layout:
    """Without the things whose footprints run into one that comes earlier."""
    boxes = layout.footprints()
    shared = rotated_intersection(boxes[:, None], boxes[None]) > 0.0
    kept: list[int] = []
    for i in range(len(layout)):
        if not shared[i, kept].any():
            kept.append(i)
    return _take(layout, np.array(kept, np.int64))


def _thing(
    rng: np.random.Generator, names: tuple[str, ...]
) -> tuple[str, np.ndarray, np.ndarray, float]:
    """Class, size, place and heading of one thing of the fitted model."""
    shares = np.array([_SIZES[name][2] for name in names])
    name = str(rng.choice(names, p=shares / shares.sum()))
    mean, sd, _ = _SIZES[name]
    size = np.asarray(mean) + np.asarray(sd) * np.clip(rng.normal(size=3), -2.5, 2.5)
    lane = _LANES[rng.choice(len(_LANES), p=[lane[2] for lane in _LANES])]
    z = rng.gamma(2.95, 9.5)
    x = rng.normal(lane[0], lane[1])
    away = rng.uniform() < lane[3]
    yaw = (-0.5 if away else 0.5) * np.pi + rng.normal(0.0, 0.06)
    if rng.uniform() < 0.25 or name in _OTHERS:
        yaw = rng.uniform(-np.pi, np.pi)
    return name, size, np.array([x, z]), yaw


def generated_layout(rng: np.random.Generator) -> Layout:
    """A street drawn from the fitted model; nothing in it overlaps."""
    rows: list[tuple[str, np.ndarray, np.ndarray, float]] = []
    # Negative binomial with mean m and variance v: p = m / v, n = m p / (1 - p). Some 12 % are
    # left out below as they would overlap, so more are asked for.
    while not rows:
        counts = (rng.negative_binomial(2.3, 0.31), rng.negative_binomial(0.22, 0.21))
        for names, count in zip((_VEHICLES, _OTHERS), counts, strict=True):
            rows += [_thing(rng, names) for _ in range(count)]
    names_, sizes, places, yaws = zip(*rows, strict=True)
    layout = Layout(
        np.array(names_, "<U14"), np.array(sizes), np.array(places), np.array(yaws),
        np.zeros(len(rows), bool),
    )  # fmt: skip
    return keep_apart(_clear_of_camera(layout))


def _wrap(angle: np.ndarray) -> np.ndarray:
    return np.mod(angle + np.pi, 2 * np.pi) - np.pi


def compose(
    rng: np.random.Generator,
    base: Layout,
    other: Layout,
    *,
    max_objects: int,
    max_look_alikes: int,
) -> Layout:
    """A scene of `base`, with the cars of `other` as look-alikes where there is room.

    Look-alikes stand where cars stand and have their sizes and headings, so that no place and no
    shape tells them apart. The whole scene is shifted by up to 1 m sideways and 2 m in depth, and
    mirrored every second time.

    Raises:
        ValueError: a class that is not one of KITTI's.
    """
    unknown = sorted(set(base.type.tolist()) - set(KITTI_TYPES))
    if unknown:
        raise ValueError(f"class {unknown[0]!r}, expected one of {', '.join(KITTI_TYPES)}")
    order = np.argsort(base.ground[:, 1])[:max_objects]
    cars = _take(other, np.flatnonzero(other.type == "Car"))
    cars = dataclasses.replace(cars, look_alike=np.ones(len(cars), bool))
    both = keep_apart(_join([_take(base, order), cars]))
    # Objects of the labels may touch each other: only look-alikes have to keep apart.
    alike = _take(both, np.flatnonzero(both.look_alike))
    alike = _take(alike, rng.permutation(len(alike))[:max_look_alikes])
    scene = _join([_take(base, order), alike])
    side = -1.0 if rng.uniform() < 0.5 else 1.0
    shift = rng.uniform([-1.0, -2.0], [1.0, 2.0])
    rotation = scene.rotation_y if side > 0 else np.pi - scene.rotation_y
    moved = dataclasses.replace(
        scene,
        ground=scene.ground * np.array([side, 1.0]) + shift,
        rotation_y=_wrap(rotation),
    )
    return _clear_of_camera(moved)
