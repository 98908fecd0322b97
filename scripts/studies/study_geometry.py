"""Do lidar, camera and labels fit together, on real and on simulated frames?

    python scripts/studies/study_geometry.py --real KITTI --simulated SIM

KITTI and SIM are folders in the layout of KITTI (SIM by `scripts/simulate_kitti.py`). Prints a
table and writes `results/study_kitti_geometry.json`: lidar points of labelled cars and their image
boxes, projected boxes against labelled ones, transforms there and back, fitted ground planes
against given ones. A second a frame of the benchmark's size.

A labelled car is a 3D box and an image box. With the right transforms

* the lidar points in the 3D box project into the image box, and the projected 3D box is the image
  box; this rests on the projection `P2`;
* the points on and above the road around a car are those on its surface: of the points in the box
  grown sideways nearly all lie in the box itself. This rests on the transform from the lidar, which
  the first two do not: turn the scan by a degree, and fewer do.

None of these is part of the benchmark; they are checks of the files and of their reader.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fusion.detection.geometry.encodings import box_corners
from fusion.detection.geometry.overlaps import image_iou
from fusion.detection.geometry.planes import fit_plane, height_above, plane_difference
from fusion.detection.kitti.calibration import (
    back_project,
    camera_to_lidar,
    in_image,
    lidar_to_camera,
    project,
)
from fusion.detection.kitti.files import Frame, frame_names, read_frame
from fusion.detection.kitti.objects import Objects, points_inside, select
from snn_fusion_failure.records.rows import record_table
from snn_fusion_failure.runs import print_result, progress, repository, run_command

MARGIN, CLEARANCE = 0.5, 0.3  # [m], around a car and above its bottom face
TITLE = "Lidar, camera and labels of KITTI frames (real) and of simulated ones"


@dataclasses.dataclass(frozen=True)
class Config:
    """Folders to check."""

    real: Path | None = None
    """KITTI folder; every labelled frame with an image is checked."""
    simulated: Path | None = None
    """Folder of simulated frames."""
    frames: int = 100
    """At most so many frames of each folder, the first ones."""
    any_size: bool = False
    """Accept images of other sizes than the benchmark's in `--real` as well."""
    results: Path = repository.RESULTS


class FrameAlignment(NamedTuple):
    """What one frame says; k labelled cars, of which m are not truncated.

    Attributes:
        in_box: `[k]` lidar points in the image and in the car's 3D box.
        in_both: `[k]` those of them that project into its image box.
        around: `[k]` points in the box grown by 0.5 m sideways, above its lowest 0.3 m.
        around_in: `[k]` those of them in the box itself.
        turned, turned_in: `[k]` the same for a scan turned by `turn` about the lidar's axis.
        overlap: `[m]` intersection over union of projected and labelled image box.
        lidar_error: largest distance of a point from itself after lidar, camera, lidar [m].
        image_error: the same after camera, image, camera [m].
        plane: (height [m], tilt [degree]) between the fitted ground plane and the given one; None
            without a given one.
        standing: `[k]` height of the cars' bottom centres above the fitted plane [m].
    """

    in_box: np.ndarray
    in_both: np.ndarray
    around: np.ndarray
    around_in: np.ndarray
    turned: np.ndarray
    turned_in: np.ndarray
    overlap: np.ndarray
    lidar_error: float
    image_error: float
    plane: tuple[float, float] | None
    standing: np.ndarray


def projected_boxes(frame: Frame, objects: Objects) -> Float[np.ndarray, "k 4"]:
    """Left, top, right, bottom [pixel] around the projected corners, cut at the image's border."""
    boxes = np.concatenate(
        [objects.location, objects.dimensions[:, [2, 1, 0]], objects.rotation_y[:, None]], axis=1
    )
    corners = np.asarray(box_corners(jnp.asarray(boxes, jnp.float32)), np.float64)
    pixels, _ = project(frame.calibration, corners.reshape(-1, 3))
    pixels = pixels.reshape(-1, 8, 2)
    height, width = frame.image.shape[:2]
    pixels = np.clip(pixels, 0.0, [width - 1.0, height - 1.0])
    return np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1)


def _around(points: np.ndarray, cars: Objects, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points around each car, and those of them that are among the points inside its box."""
    near = points_inside(points, cars, margin=MARGIN, clearance=CLEARANCE)
    return near.sum(axis=0), (near & inside).sum(axis=0)


def align_frame(frame: Frame, *, turn: float = 1.0) -> FrameAlignment:
    """Check one labelled frame.

    Args:
        frame: with labels.
        turn: angle of the wrong scan [degree].

    Raises:
        ValueError: the frame has no labels, or no ground plane is found.
    """
    if frame.labels is None:
        raise ValueError(f"frame {frame.name} has no labels to compare with")
    has_box = (frame.labels.dimensions > 0).all(axis=1)
    cars = select(frame.labels, (frame.labels.type == "Car") & has_box)
    calibration = frame.calibration
    lidar = frame.points[:, :3].astype(np.float64)
    camera = lidar_to_camera(calibration, lidar)
    pixels, depth = project(calibration, camera)
    seen = in_image(pixels, depth, *frame.image.shape[:2])
    back = camera_to_lidar(calibration, camera)
    again = back_project(calibration, pixels[seen], depth[seen])

    inside = points_inside(camera[seen], cars)
    box = cars.bbox[None]
    at = pixels[seen][:, None]
    in_image_box = ((at >= box[..., :2]) & (at <= box[..., 2:])).all(axis=2)
    around, around_in = _around(camera[seen], cars, inside)
    angle = np.radians(turn)
    rotation = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]]
    )
    scan = lidar_to_camera(calibration, lidar[seen] @ rotation.T)
    turned, turned_in = _around(scan, cars, points_inside(scan, cars))
    whole = select(cars, cars.truncated == 0)
    plane = fit_plane(camera).plane
    return FrameAlignment(
        in_box=inside.sum(axis=0),
        in_both=(inside & in_image_box).sum(axis=0),
        around=around,
        around_in=around_in,
        turned=turned,
        turned_in=turned_in,
        overlap=image_iou(projected_boxes(frame, whole), whole.bbox),
        lidar_error=float(np.abs(back - lidar).max()),
        image_error=float(np.abs(again - camera[seen]).max()),
        plane=None if frame.plane is None else plane_difference(plane, frame.plane),
        standing=height_above(plane, cars.location),
    )


def measure(folder: Path, frames: int, any_size: bool) -> list[dict[str, Any]]:
    """Rows of one folder: name, unit, mean over what `n` counts."""
    names = frame_names(folder / "training" / "image_2", ".png")[:frames]
    found = []
    with progress() as bar:
        task = bar.add_task(folder.name, total=len(names), status="")
        for name in names:
            found.append(align_frame(read_frame(folder, name, any_size=any_size)))
            bar.update(task, advance=1, status=name)

    def pooled(field: str) -> Any:
        return np.concatenate([getattr(f, field) for f in found])

    planes = np.array([f.plane for f in found if f.plane is not None]).reshape(-1, 2)
    in_box, around, overlap = pooled("in_box"), pooled("around"), pooled("overlap")
    standing = np.abs(pooled("standing"))
    n_hit = int((in_box > 0).sum())
    rows: list[tuple[str, str, float, int]] = [
        ("frames", "", len(names), len(names)),
        ("labelled cars", "", len(in_box), len(names)),
    ]
    if n_hit:
        share = 100.0 * pooled("in_both").sum() / in_box.sum()
        held = 100.0 * pooled("around_in").sum() / max(around.sum(), 1)
        turned = 100.0 * pooled("turned_in").sum() / max(pooled("turned").sum(), 1)
        rows += [
            ("cars with a lidar point in their 3D box", "%", 100.0 * n_hit / len(in_box),
             len(in_box)),
            ("lidar points in a car's 3D box that project into its image box", "%", share, n_hit),
            ("lidar points within 0.5 m of a car's sides that are in its 3D box", "%", held,
             len(in_box)),
            ("the same with the scan turned by 1 degree", "%", turned, len(in_box)),
        ]  # fmt: skip
    if len(overlap):
        rows += [
            ("overlap of projected and labelled box, mean", "1", overlap.mean(), len(overlap)),
            ("overlap of projected and labelled box, least", "1", overlap.min(), len(overlap)),
        ]
    rows += [
        ("error after lidar, camera, lidar, largest", "m", max(f.lidar_error for f in found),
         len(found)),
        ("error after camera, image, camera, largest", "m", max(f.image_error for f in found),
         len(found)),
    ]  # fmt: skip
    if len(planes):
        for column, (kind, unit) in enumerate((("height", "m"), ("tilt", "degree"))):
            values = planes[:, column]
            rows += [
                (f"fitted against given plane, {kind}, mean", unit, values.mean(), len(values)),
                (f"fitted against given plane, {kind}, largest", unit, values.max(), len(values)),
            ]
    if len(standing):
        name = "height of a car's bottom above the fitted plane, mean size"
        rows.append((name, "m", standing.mean(), len(standing)))
    return [{"row": r, "unit": u, "mean": float(v), "n": n} for r, u, v, n in rows]


def main(config: Config) -> dict[str, Any]:
    """Check the folders, print the table, write the record."""
    from snn_fusion_failure.records import markdown

    rows: list[dict[str, Any]] = []
    for model, folder in (("real", config.real), ("simulated", config.simulated)):
        if folder is not None:
            for row in measure(folder, config.frames, config.any_size or model == "simulated"):
                rows.append({"model": model, "metric": "geometry"} | row)
    if not rows:
        raise ValueError("expected --real or --simulated, a folder of frames")
    table = "study_kitti_geometry"
    record_table(config.results / f"{table}.json", table, TITLE, rows, preset="all")
    print(markdown.measured(rows))
    fields = {row["model"]: int(row["mean"]) for row in rows if row["row"] == "frames"}
    print_result(**fields, rows=len(rows))
    return {"rows": rows}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
