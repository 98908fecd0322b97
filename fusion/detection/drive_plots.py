"""A moving picture of a drive: what the sensors read, what is found, what the gate says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fusion.detection.geometry.bev import BevConfig
from fusion.detection.geometry.encodings import box_corners
from fusion.detection.plots import FOUND, TRUTH

_COLOURS = {"camera": "#0072b2", "lidar": "#d55e00"}


class Moment(NamedTuple):
    """One frame of a drive.

    Attributes:
        image: `[h, w, 3]` in [0, 1], as it was read.
        map: `[rows, columns]` density of the scan from above, as it was read.
        labels, found: `[n, 7]` boxes.
        weights, failed: `[2]` of (camera, lidar); NaN where nothing is told.
        severity: of the failure.
    """

    image: np.ndarray
    map: np.ndarray
    labels: np.ndarray
    found: np.ndarray
    weights: np.ndarray
    failed: np.ndarray
    severity: float


def _outlines(axes: Axes, boxes: np.ndarray, colour: str) -> list[Any]:
    if not len(boxes):
        return []
    corners = np.asarray(box_corners(jnp.asarray(boxes, jnp.float32)))
    ground = corners[:, [0, 1, 2, 3, 0]][..., [0, 2]]
    return [line for way in ground for line in axes.plot(*way.T, color=colour, lw=1.4)]


def plot_drive(moments: Sequence[Moment], area: BevConfig, failure: str) -> FuncAnimation:
    """Camera picture, road from above with labels and detections, weights and probabilities.

    Args:
        moments: frames in their order.
        area: of the maps.
        failure: its name, for the title.

    Returns:
        The animation, unsaved.

    Raises:
        ValueError: no frame.
    """
    if not moments:
        raise ValueError("moments=(): expected at least one frame")
    figure = Figure(figsize=(8.0, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplot_mosaic(
        [["image", "image"], ["map", "weights"], ["map", "failed"]], height_ratios=(1.4, 1, 1)
    )
    picture = panels["image"].imshow(moments[0].image, vmin=0, vmax=1)
    panels["image"].set_axis_off()
    extent = (*area.x_range, *area.z_range)
    scan = panels["map"].imshow(moments[0].map > 0, cmap="gray_r", extent=extent, vmin=0, vmax=1.6)
    panels["map"].set(xlabel="x [m]", ylabel="z [m]")
    cursors = []
    for name, title in (("weights", "fusion weight"), ("failed", "probability of failure")):
        axes = panels[name]
        for k, (sensor, colour) in enumerate(_COLOURS.items()):
            told = [getattr(moment, name)[k] for moment in moments]
            axes.plot(told, color=colour, label=sensor, lw=1.4)
        axes.plot([m.severity for m in moments], color="0.6", ls=":", label="severity")
        axes.set(ylim=(-0.03, 1.03), xlim=(0, max(1, len(moments) - 1)), ylabel=title)
        cursors.append(axes.axvline(0, color="0.3", lw=0.8))
    panels["weights"].legend(loc="upper left", fontsize=7, ncols=3)
    panels["failed"].set_xlabel("frame")
    drawn: list[Any] = []

    def turn(i: int) -> list[Any]:
        moment = moments[i]
        picture.set_data(moment.image)
        scan.set_data(moment.map > 0)
        while drawn:
            drawn.pop().remove()
        drawn.extend(_outlines(panels["map"], moment.labels, TRUTH))
        drawn.extend(_outlines(panels["map"], moment.found, FOUND))
        panels["map"].set(xlim=area.x_range, ylim=area.z_range)
        for cursor in cursors:
            cursor.set_xdata([i, i])
        figure.suptitle(f"{failure.replace('_', ' ')}, severity {moment.severity:.1f}", fontsize=10)
        return [picture, scan, *drawn, *cursors]

    return FuncAnimation(figure, turn, frames=len(moments), blit=False)
