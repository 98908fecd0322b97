"""Simulated frames as a KITTI folder, and the draws that make frame i the same in every run.

OUT/training/{image_2,velodyne,calib,label_2,planes}/000000.*
OUT/training/visibility/000000.csv        3D boxes of objects and look-alikes, what each sensor saw
OUT/ImageSets/{train,val,test}.txt
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
import numpy as np

from fusion.detection.kitti.calibration import Calibration
from fusion.detection.kitti.files import (
    Frame,
    write_calibration,
    write_image,
    write_labels,
    write_plane,
    write_points,
)
from fusion.detection.simulator.labels import Visibility, labels_of, visibility_of
from fusion.detection.simulator.layouts import Layout, compose, generated_layout
from fusion.detection.simulator.rendering import (
    Readings,
    SensorConfig,
    nominal_calibration,
    rays,
    render,
)
from fusion.detection.simulator.scene import Scene, SceneConfig, build_scene

VISIBILITY_COLUMNS = (
    "label", "kind", "points", "pixels", "share", "dark_paint", "low_contrast", "night",
    "x", "y", "z", "length", "width", "height", "rotation_y",
)  # fmt: skip
"""Columns of `visibility/*.csv`; boxes as in `label_2`, of look-alikes too."""
MAX_REPEATS = 20
"""Frames that may have the same layout: of a hundred with the same five cars, average precision
tells how well these five are found."""


@dataclasses.dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """One frame: scene and readings with numpy leaves, what is visible, night or day."""

    index: int
    scene: Scene
    readings: Readings
    seen: Visibility
    night: bool


def split_layouts(
    layouts: Sequence[Layout], counts: Sequence[int], seed: int
) -> list[list[Layout]]:
    """Share layouts out in proportion to `counts`, so that no two parts hold the same one.

    Raises:
        ValueError: fewer layouts than parts, or so few that more than `MAX_REPEATS` frames of a
            part would have the same one.
    """
    wanted = [i for i, n in enumerate(counts) if n]
    if len(layouts) < len(wanted):
        raise ValueError(
            f"{len(layouts)} layouts, expected at least {len(wanted)}: train, val and test must "
            "not share any"
        )
    order = np.random.default_rng([seed, 1]).permutation(len(layouts))
    spare = len(layouts) - len(wanted)
    total = sum(counts)
    parts: list[list[Layout]] = [[] for _ in counts]
    start = 0
    for done, i in enumerate(wanted):
        last = done == len(wanted) - 1
        size = 1 + (spare * counts[i]) // total
        stop = len(layouts) if last else start + size
        parts[i] = [layouts[k] for k in order[start:stop]]
        if counts[i] > MAX_REPEATS * len(parts[i]):
            raise ValueError(
                f"{len(layouts)} layouts for {total} frames: {counts[i]} frames of one list would "
                f"share {len(parts[i])}, expected at most {MAX_REPEATS} a layout; give a folder "
                "with more label files, fewer frames, or no layouts (a fitted model draws them)"
            )
        start = stop
    return parts


def draw_scene(
    config: SceneConfig, index: int, position: int, pool: Sequence[Layout], *, seed: int
) -> tuple[Scene, int]:
    """The scene of frame `index`, and how many objects and look-alikes it has.

    Args:
        config: scene options.
        index: of the frame, over all parts.
        position: of the frame in its part; layouts are taken in turn.
        pool: layouts of its part; empty: from the fitted model.
        seed: of the data set.
    """
    rng = np.random.default_rng([seed, 2, index])
    if pool:
        base, other = pool[position % len(pool)], pool[int(rng.integers(len(pool)))]
    else:
        base, other = generated_layout(rng), generated_layout(rng)
    layout = compose(
        rng,
        base,
        other,
        max_objects=config.max_objects,
        max_look_alikes=config.max_look_alikes,
    )
    return build_scene(config, layout, rng=rng), len(layout)


def simulate_frames(
    scene_config: SceneConfig,
    sensor_config: SensorConfig,
    frames: Sequence[tuple[int, int, Sequence[Layout]]],
    *,
    seed: int,
    chunk: int = 8,
    batch_size: int | None = None,
) -> Iterator[SimulatedFrame]:
    """Draw and render frames given as (index, position in its part, layouts of its part).

    A frame depends on seed and index alone, not on the chunks. `batch_size` is that of `render`.
    """
    beams = rays(sensor_config, nominal_calibration(sensor_config.scale))
    root = jax.random.key(seed)
    for start in range(0, len(frames), chunk):
        part = list(frames[start : start + chunk])
        padded = part + [part[-1]] * (chunk - len(part))  # one program for all chunks
        drawn = [draw_scene(scene_config, i, k, pool, seed=seed) for i, k, pool in padded]
        scenes = jax.tree.map(lambda *leaves: np.stack(leaves), *[scene for scene, _ in drawn])
        keys = jax.vmap(lambda i: jax.random.fold_in(root, i))(
            np.array([i for i, _, _ in padded], np.uint32)
        )
        read = jax.device_get(
            render(sensor_config, scenes, beams, keys=keys, batch_size=batch_size)
        )
        for n, (index, _, _) in enumerate(part):
            scene, n_things = drawn[n]
            readings = Readings(*(leaf[n] for leaf in read))
            seen = visibility_of(scene, readings, n_things)
            yield SimulatedFrame(index, scene, readings, seen, bool(scene.light[1] < 0.5))


def kitti_frame(frame: SimulatedFrame, calibration: Calibration) -> Frame:
    """The frame as it is read from KITTI's files: 8-bit image, points of the scan, labels."""
    readings = frame.readings
    image = np.round(255 * np.asarray(readings.image)).astype(np.uint8)
    points = np.asarray(readings.points)[np.asarray(readings.mask)].astype(np.float32)
    labels = labels_of(frame.scene, frame.seen, calibration, *image.shape[:2])
    plane = np.asarray(frame.scene.plane)
    return Frame(f"{frame.index:06d}", image, points, calibration, labels, plane)


def write_frame(folder: Path, frame: SimulatedFrame, calibration: Calibration) -> dict[str, int]:
    """Write the files of one frame below `folder` (`OUT/training`), the labels last.

    Returns:
        Counts of points, labelled objects, cars and look-alikes.
    """
    seen, scene = frame.seen, frame.scene
    name, image, points, _, labels, plane = kitti_frame(frame, calibration)
    assert labels is not None and plane is not None  # a simulated frame has both
    write_image(folder / "image_2" / f"{name}.png", image)
    write_points(folder / "velodyne" / f"{name}.bin", points)
    write_calibration(folder / "calib" / f"{name}.txt", calibration)
    write_plane(folder / "planes" / f"{name}.txt", plane)
    table = folder / "visibility" / f"{name}.csv"
    table.parent.mkdir(parents=True, exist_ok=True)
    with table.open("w", encoding="ascii", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(VISIBILITY_COLUMNS)
        for i, slot in enumerate(seen.slot):
            height, width, length = scene.size[slot]
            yaw = np.arctan2(scene.turn[slot, 1], scene.turn[slot, 0])
            box = (*scene.place[slot], length, width, height, yaw)
            rows.writerow(
                [int(seen.label[i]), seen.kind[i], int(seen.points[i]), f"{seen.pixels[i]:.2f}",
                 f"{seen.share[i]:.3f}", int(seen.dark_paint[i]), int(seen.low_contrast[i]),
                 int(frame.night), *(f"{value:.4f}" for value in box)]
            )  # fmt: skip
    write_labels(folder / "label_2" / f"{name}.txt", labels)
    return {
        "points": len(points),
        "objects": len(labels),
        "cars": int((labels.type == "Car").sum()),
        "look_alikes": int(np.isin(seen.kind, ("bush", "container")).sum()),
    }
