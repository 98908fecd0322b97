"""A simulated scene as arrays of fixed size: bodies of convex parts, paint, ground, light.

Everything that stands on the ground is a body of up to two parts, each a frustum (a box whose top
face may be smaller than its bottom face): a car is a lower body and a cabin, a tree is a trunk and
a crown. Bodies turn about the camera's y axis, like the boxes of the labels, and fill the box of
their label up to its faces.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from fusion.detection.geometry.overlaps import rotated_intersection
from fusion.detection.geometry.planes import plane_y
from fusion.detection.simulator.layouts import Layout

KINDS = (
    "Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc",
    "bush", "container", "building", "tree", "pole", "nothing",
)  # fmt: skip
LABELLED = KINDS[:8]
_INDEX = {name: i for i, name in enumerate(KINDS)}

# Parts as shares of the box: bottom and top [height]; x from, to at the bottom and at the top
# [length, front is +0.5]; half width at the bottom and at the top [width].
_NONE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_BOX = (0.0, 1.0, -0.5, 0.5, -0.5, 0.5, 0.5, 0.5)
_PARTS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "Car": (
        (0.12, 0.60, -0.5, 0.5, -0.485, 0.47, 0.5, 0.485),
        (0.60, 1.0, -0.44, 0.24, -0.34, 0.08, 0.46, 0.38),
    ),
    "Van": (
        (0.10, 0.55, -0.5, 0.5, -0.5, 0.48, 0.5, 0.5),
        (0.55, 1.0, -0.5, 0.40, -0.48, 0.27, 0.5, 0.44),
    ),
    "Truck": (
        (0.12, 1.0, -0.5, 0.27, -0.5, 0.27, 0.5, 0.5),
        (0.10, 0.78, 0.30, 0.5, 0.30, 0.47, 0.48, 0.46),
    ),
    "Pedestrian": (
        (0.0, 0.84, -0.35, 0.35, -0.5, 0.5, 0.38, 0.5),
        (0.86, 1.0, -0.16, 0.16, -0.14, 0.14, 0.18, 0.16),
    ),
    "Person_sitting": (
        (0.0, 0.45, -0.5, 0.5, -0.5, 0.5, 0.5, 0.5),
        (0.45, 1.0, -0.5, 0.0, -0.4, -0.1, 0.4, 0.2),
    ),
    "Cyclist": (
        (0.0, 0.55, -0.5, 0.5, -0.42, 0.40, 0.10, 0.30),
        (0.50, 1.0, -0.18, 0.16, -0.08, 0.12, 0.5, 0.22),
    ),
    "Tram": ((0.08, 1.0, -0.5, 0.5, -0.49, 0.49, 0.5, 0.48), _NONE),
    "Misc": ((0.15, 1.0, -0.5, 0.5, -0.48, 0.48, 0.5, 0.5), _NONE),
    "building": (_BOX, _NONE),
    "tree": (
        (0.0, 0.40, -0.08, 0.08, -0.06, 0.06, 0.08, 0.06),
        (0.35, 1.0, -0.5, 0.5, -0.28, 0.28, 0.5, 0.28),
    ),
    "pole": (_BOX, _NONE),
    "nothing": (_NONE, _NONE),
}
# Red, green, blue of car paint and how often it comes (white, silver, grey, black, blue, red, ...).
_PAINT = np.array(
    [[0.88, 0.88, 0.86], [0.66, 0.67, 0.69], [0.42, 0.43, 0.45], [0.10, 0.10, 0.11],
     [0.16, 0.24, 0.50], [0.60, 0.10, 0.10], [0.75, 0.72, 0.62]]
)  # fmt: skip
_PAINT_SHARE = np.array([0.20, 0.22, 0.18, 0.18, 0.11, 0.08, 0.03])
_ASPHALT = np.array([0.36, 0.36, 0.37])


@dataclasses.dataclass(frozen=True)
class SceneConfig:
    """How many things a scene holds and what each sensor cannot see.

    Attributes:
        max_objects: labelled objects; the nearest are kept.
        max_look_alikes: bushes and containers in the shape of a car: only colour tells.
        max_structures: buildings, trees and poles.
        dark_paint: share of vehicles whose paint hardly reflects the lidar's light: beyond some
            25 m only the camera sees them.
        low_contrast: share of vehicles in the colour of the road: hardly seen by the camera.
        night: share of frames with next to no light for the camera.
    """

    max_objects: int = 22
    max_look_alikes: int = 6
    max_structures: int = 14
    dark_paint: float = 0.2
    low_contrast: float = 0.15
    night: float = 0.15

    def __post_init__(self) -> None:
        """Check counts and shares."""
        if self.max_objects < 1 or self.max_look_alikes < 0 or self.max_structures < 0:
            raise ValueError(
                f"max_objects={self.max_objects}, max_look_alikes={self.max_look_alikes}, "
                f"max_structures={self.max_structures}: expected at least 1, 0 and 0"
            )
        for name in ("dark_paint", "low_contrast", "night"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected a share in [0, 1]")

    @property
    def n_slots(self) -> int:
        """K, the bodies that a scene has room for."""
        return self.max_objects + self.max_look_alikes + self.max_structures


class Scene(NamedTuple):
    """One scene in the camera frame; float32 leaves, K slots (unused ones are `nothing`).

    Attributes:
        place: `[K, 3]` middle of the bottom face [m]; turn: `[K, 2]` cosine and sine of rotation_y;
        size: `[K, 3]` height, width, length [m]; parts: `[K, 2, 8]` frustums [m]; kind: `[K]`
        index in `KINDS`; paint: `[K, 3]` colour; reflectivity: `[K]` for the lidar's light;
        low_contrast: `[K]` 1 where the body has the colour of the road; plane: `[4]` ground;
        road: `[2]` middle and half width of the road [m]; ground_paint: `[2, 3]` road, verge;
        sky: `[3]`; sun: `[3]` direction to the sun; light: `[2]` ambient share, exposure.
    """

    place: np.ndarray
    turn: np.ndarray
    size: np.ndarray
    parts: np.ndarray
    kind: np.ndarray
    paint: np.ndarray
    reflectivity: np.ndarray
    low_contrast: np.ndarray
    plane: np.ndarray
    road: np.ndarray
    ground_paint: np.ndarray
    sky: np.ndarray
    sun: np.ndarray
    light: np.ndarray


def _structures(rng: np.random.Generator, layout: Layout, n: int) -> list[tuple]:
    """Buildings, trees and poles left and right of everything else, or where there is room."""
    taken = layout.footprints()
    rows: list[tuple] = []
    edge = {s: 9.0 + rng.gamma(2.0, 2.5) for s in (-1.0, 1.0)}
    along = {s: rng.uniform(2.0, 12.0) for s in (-1.0, 1.0)}
    for _ in range(n):
        s = float(rng.choice([-1.0, 1.0]))
        kind = str(rng.choice(["building", "tree", "pole"], p=[0.45, 0.40, 0.15]))
        if kind == "building":
            size = np.array([rng.uniform(4, 12), rng.uniform(6, 12), rng.uniform(8, 22)])
            x, z = s * (edge[s] + 0.5 * size[1]), along[s] + 0.5 * size[2]
            along[s] += size[2] + rng.uniform(0.5, 9.0)
        else:
            tall = rng.uniform(3.5, 9.0)
            wide = rng.uniform(0.35, 0.6) * tall if kind == "tree" else 0.25
            size = np.array([tall, wide, wide])
            x, z = s * (edge[s] - rng.uniform(0.5, 3.0)), rng.uniform(8.0, 60.0)
        box = np.array([x, z, size[2], size[1], 0.5 * np.pi])
        if len(taken) and (rotated_intersection(box, taken) > 0).any():
            continue
        taken = np.concatenate([taken, box[None]])
        if kind == "building":
            paint = rng.uniform([0.55, 0.45, 0.38], [0.85, 0.78, 0.70])
        elif kind == "tree":
            paint = rng.uniform([0.12, 0.25, 0.08], [0.25, 0.42, 0.16])
        else:
            paint = np.full(3, rng.uniform(0.3, 0.6))
        rows.append((kind, size, np.array([x, z]), 0.5 * np.pi, paint, rng.uniform(0.3, 0.6), 0.0))
    return rows


def _things(rng: np.random.Generator, layout: Layout, config: SceneConfig) -> list[tuple]:
    rows = []
    vehicles = ("Car", "Van", "Truck", "Misc")
    for i in range(len(layout)):
        kind = str(layout.type[i])
        paint = _PAINT[rng.choice(len(_PAINT), p=_PAINT_SHARE)] + rng.normal(0, 0.03, 3)
        reflectivity, hidden = rng.uniform(0.15, 0.9), 0.0
        dark, same = rng.uniform() < config.dark_paint, rng.uniform() < config.low_contrast
        if layout.look_alike[i]:
            kind = str(rng.choice(["bush", "container"]))
            green, rust = np.array([0.17, 0.36, 0.11]), np.array([0.72, 0.36, 0.10])
            paint = (green if kind == "bush" else rust) * rng.uniform(0.8, 1.2, 3)
        elif kind in ("Pedestrian", "Person_sitting", "Cyclist"):
            paint = rng.uniform(0.1, 0.85, 3)
        # A look-alike reflects like a car, so that no intensity gives it away.
        if dark and (kind in vehicles or layout.look_alike[i]):
            reflectivity = rng.uniform(0.02, 0.04)
        if same and kind in vehicles:
            hidden = 1.0
        rows.append(
            (kind, layout.size[i], layout.ground[i], layout.rotation_y[i], paint, reflectivity,
             hidden)
        )  # fmt: skip
    return rows


def _frustums(kind: str, size: np.ndarray) -> np.ndarray:
    h, w, length = size
    shape = "Car" if kind in ("bush", "container") else kind
    return np.array(_PARTS[shape]) * np.array(
        [h, h, length, length, length, length, w, w]
    )  # fmt: skip


def build_scene(config: SceneConfig, layout: Layout, *, rng: np.random.Generator) -> Scene:
    """Give a layout a ground, bodies, paint, surroundings and light.

    The objects of the layout take the first slots, in order.

    Raises:
        ValueError: the layout has more things than `config` has room for.
    """
    room = config.max_objects + config.max_look_alikes
    if len(layout) > room:
        raise ValueError(f"{len(layout)} things in the layout, expected at most {room}")
    tilt = rng.normal(0.0, [0.008, 0.008])
    normal = np.array([tilt[0], -1.0, tilt[1]])
    plane = np.append(normal, 1.65 + rng.normal(0.0, 0.03)) / np.linalg.norm(normal)
    rows = _things(rng, layout, config) + _structures(rng, layout, config.max_structures)
    spare = config.n_slots - len(rows)
    far = (np.array([0.0, 1e4]), 0.0, np.zeros(3), 0.0, 0.0)
    rows += [("nothing", np.ones(3), *far)] * spare
    kinds, sizes, places, yaws, paints, reflectivities, hidden = zip(*rows, strict=True)
    ground, yaw, size = np.array(places), np.array(yaws), np.array(sizes)
    y = plane_y(plane, ground[:, 0], ground[:, 1])
    night = rng.uniform() < config.night
    grass = rng.uniform([0.22, 0.32, 0.12], [0.36, 0.44, 0.20])
    pavement = np.full(3, rng.uniform(0.45, 0.6))
    bearing, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 1.2)
    sun = [np.cos(bearing) * np.cos(height), -np.sin(height), np.sin(bearing) * np.cos(height)]
    scene = Scene(
        place=np.column_stack([ground[:, 0], y, ground[:, 1]]),
        turn=np.column_stack([np.cos(yaw), np.sin(yaw)]),
        size=size,
        parts=np.stack([_frustums(k, s) for k, s in zip(kinds, size, strict=True)]),
        kind=np.array([_INDEX[k] for k in kinds], np.int32),
        paint=np.clip(np.array(paints), 0.02, 0.95),
        reflectivity=np.array(reflectivities),
        low_contrast=np.array(hidden),
        plane=plane,
        road=np.array([rng.normal(-1.5, 1.0), rng.uniform(4.5, 8.0)]),
        ground_paint=np.stack([
            _ASPHALT * rng.uniform(0.8, 1.2), grass if rng.uniform() < 0.6 else pavement
        ]),
        sky=rng.uniform([0.55, 0.68, 0.85], [0.85, 0.88, 0.95]),
        sun=np.array(sun),
        light=np.array([
            rng.uniform(0.45, 0.7), rng.uniform(0.03, 0.08) if night else rng.uniform(0.8, 1.1)
        ]),
    )  # fmt: skip
    return Scene(*(a if a.dtype == np.int32 else a.astype(np.float32) for a in scene))
