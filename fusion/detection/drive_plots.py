"""Pictures of a drive: what the sensors read, what is found, what the gate says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
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


def _curves(
    panels: Mapping[str, Axes], moments: Sequence[Moment], threshold: np.ndarray | None
) -> None:
    """Weights and told probabilities of all frames, and above what a sensor is called failed."""
    for name, title in (("weights", "fusion weight"), ("failed", "probability of failure")):
        axes = panels[name]
        for k, (sensor, colour) in enumerate(_COLOURS.items()):
            told = [getattr(moment, name)[k] for moment in moments]
            axes.plot(told, color=colour, label=sensor, lw=1.4)
            if name == "failed" and threshold is not None:
                axes.axhline(threshold[k], color=colour, ls="--", lw=0.8)
        axes.plot([m.severity for m in moments], color="0.6", ls=":", label="severity")
        axes.set(ylim=(-0.03, 1.03), xlim=(0, max(1, len(moments) - 1)), ylabel=title)
    panels["weights"].legend(loc="upper left", fontsize=7, ncols=3)
    panels["failed"].set_xlabel("frame")


def _check(moments: Sequence[Moment]) -> None:
    if not moments:
        raise ValueError("moments=(): expected at least one frame; give those of a drive")


def _name(moment: Moment, failure: str) -> str:
    return f"{failure.replace('_', ' ')}, severity {moment.severity:.1f}"


def plot_drive(
    moments: Sequence[Moment],
    area: BevConfig,
    failure: str,
    threshold: Float[np.ndarray, "2"] | None = None,
) -> FuncAnimation:
    """Camera picture, road from above with labels and detections, weights and probabilities.

    Args:
        moments: frames in their order.
        area: of the maps.
        failure: its name, for the title.
        threshold: probabilities above which (camera, lidar) is called failed, drawn dashed.

    Returns:
        The animation, unsaved.

    Raises:
        ValueError: no frame.
    """
    _check(moments)
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
    _curves(panels, moments, threshold)
    cursors = [panels[name].axvline(0, color="0.3", lw=0.8) for name in ("weights", "failed")]
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
        figure.suptitle(_name(moment, failure), fontsize=10)
        return [picture, scan, *drawn, *cursors]

    return FuncAnimation(figure, turn, frames=len(moments), blit=False)


def plot_moments(
    moments: Sequence[Moment],
    area: BevConfig,
    failure: str,
    threshold: Float[np.ndarray, "2"] | None = None,
    n_shown: int = 4,
) -> Figure:
    """A drive on paper: some of its frames side by side, weights and probabilities of all below.

    Arguments are those of `plot_drive`; `n_shown` frames at even distances, the first and the last
    among them. Raises like it.
    """
    _check(moments)
    chosen = np.unique(np.linspace(0, len(moments) - 1, n_shown).round().astype(int)).tolist()
    figure = Figure(figsize=(10.0, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    parts: Any = figure.subfigures(2, 1, height_ratios=(1.45, 1.0))
    upper, lower = parts
    grid = upper.subplots(2, len(chosen), height_ratios=(1, 2.6), squeeze=False)
    extent = (*area.x_range, *area.z_range)
    for (top, below), i in zip(grid.T, chosen, strict=True):
        moment = moments[i]
        top.imshow(moment.image, vmin=0, vmax=1)
        top.set_axis_off()
        top.set_title(f"frame {i}: {_name(moment, failure)}", fontsize=7)
        below.imshow(moment.map > 0, cmap="gray_r", extent=extent, vmin=0, vmax=1.6)
        _outlines(below, moment.labels, TRUTH)
        _outlines(below, moment.found, FOUND)
        below.set(xlim=area.x_range, ylim=area.z_range)
        below.tick_params(labelsize=6)
    grid[1, 0].set_ylabel("z [m]", fontsize=7)
    left, right = lower.subplots(1, 2)
    _curves({"weights": left, "failed": right}, moments, threshold)
    for axes in (left, right):
        axes.set_xlabel("frame")
        for i in chosen:
            axes.axvline(i, color="0.8", lw=0.8, zorder=0)
    return figure
