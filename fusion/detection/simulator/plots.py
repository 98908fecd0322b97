"""Pictures of KITTI frames, simulated or real: the image with boxes, the scan from above."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from fusion.detection.kitti.calibration import lidar_to_camera
from fusion.detection.kitti.files import Frame
from fusion.detection.kitti.objects import DONT_CARE, Objects

COLOURS = {"Car": "#e69f00", "Van": "#56b4e9", "Truck": "#56b4e9"}
OTHER = "#cc79a7"
SIDE, AHEAD = 30.0, 70.0  # [m], of the bird's-eye view


def _ground_corners(objects: Objects) -> np.ndarray:
    """`[n, 4, 2]` x, z of the corners of the footprints [m], the two front ones first."""
    a = 0.5 * objects.dimensions[:, 2, None] * np.array([1, 1, -1, -1])
    c = 0.5 * objects.dimensions[:, 1, None] * np.array([1, -1, -1, 1])
    cos, sin = np.cos(objects.rotation_y)[:, None], np.sin(objects.rotation_y)[:, None]
    corners = np.stack([a * cos + c * sin, -a * sin + c * cos], axis=-1)
    return corners + objects.location[:, None, [0, 2]]


def _image(axes: Axes, frame: Frame) -> None:
    axes.imshow(frame.image, interpolation="nearest")
    axes.set_axis_off()
    axes.set_title(f"frame {frame.name}", fontsize=8, loc="left")
    if frame.labels is None:
        return
    for i in range(len(frame.labels)):
        kind = str(frame.labels.type[i])
        left, top, right, bottom = frame.labels.bbox[i]
        colour = COLOURS.get(kind, OTHER)
        axes.add_patch(
            Rectangle((left, top), right - left, bottom - top, fill=False, ec=colour, lw=0.9)
        )


def _ground(axes: Axes, frame: Frame) -> None:
    points = lidar_to_camera(frame.calibration, frame.points[:, :3])
    axes.scatter(
        points[:, 0], points[:, 2], s=0.15, c=-points[:, 1], cmap="viridis", vmin=-2, vmax=1
    )
    if frame.labels is not None:
        solid = frame.labels.type != DONT_CARE
        corners = _ground_corners(frame.labels)
        for i in np.flatnonzero(solid):
            colour = COLOURS.get(str(frame.labels.type[i]), OTHER)
            axes.add_patch(Polygon(corners[i], fill=False, ec=colour, lw=0.9))
            axes.plot(*corners[i, :2].T, color=colour, lw=2.0)  # the front
    axes.set(xlim=(-SIDE, SIDE), ylim=(0, AHEAD), aspect="equal")
    axes.tick_params(labelsize=6)


def plot_frames(frames: Sequence[Frame]) -> Figure:
    """Draw one row a frame: image with 2D boxes, lidar points and footprints from above.

    Cars are orange, vans and trucks blue, others pink; a thick edge is the front. Points are
    coloured by height.

    Raises:
        ValueError: no frame.
    """
    if not frames:
        raise ValueError("no frame to draw, expected at least one")
    figure = Figure(figsize=(10.0, 2.25 * len(frames)), layout="constrained")
    grid = figure.subplots(len(frames), 2, squeeze=False, width_ratios=[3.6, 1.0])
    for row, frame in zip(grid, frames, strict=True):
        _image(row[0], frame)
        _ground(row[1], frame)
        row[1].set_ylabel("z [m]", fontsize=7)
    grid[-1][1].set_xlabel("x [m]", fontsize=7)
    return figure
