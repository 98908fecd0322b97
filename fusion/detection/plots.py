"""Pictures of detections: precision curves, the road from above, the camera image with boxes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fusion.detection.geometry.encodings import box_corners
from fusion.detection.kitti.average_precision import DIFFICULTIES, METRICS, N_POINTS, Evaluation
from fusion.detection.kitti.calibration import lidar_to_camera, project
from fusion.detection.kitti.files import Frame
from fusion.detection.kitti.objects import Objects, select

TRUTH, FOUND = "#009e73", "#e69f00"
# The four edges of the bottom, of the top, and between them.
_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4)]
_EDGES += [(0, 4), (1, 5), (2, 6), (3, 7)]


def _corners(objects: Objects) -> np.ndarray:
    """`[n, 8, 3]` corners of the 3D boxes; objects without one are left out."""
    objects = select(objects, np.flatnonzero((objects.dimensions > 0).all(axis=1)))
    boxes = np.concatenate(
        [objects.location, objects.dimensions[:, [2, 1, 0]], objects.rotation_y[:, None]], axis=1
    )
    return np.asarray(box_corners(jnp.asarray(boxes, jnp.float32)), np.float64)


def _labelled(frame: Frame, detections: Objects) -> Objects:
    """Labels of the classes that are detected, cars where nothing is."""
    assert frame.labels is not None
    names = set(detections.type.tolist()) or {"Car"}
    return select(frame.labels, np.isin(frame.labels.type, sorted(names)))


def _draw_ground(axes: Axes, objects: Objects, colour: str, label: str) -> None:
    for i, corners in enumerate(_corners(objects)):
        ground = corners[[0, 1, 2, 3, 0]][:, [0, 2]]
        axes.plot(*ground.T, color=colour, lw=1.2, label=label if i == 0 else None)
        axes.plot(*ground[:2].T, color=colour, lw=2.6)  # the front


def _draw_bird(
    axes: Axes,
    frame: Frame,
    detections: Objects,
    x_range: tuple[float, float],
    z_range: tuple[float, float],
) -> None:
    points = lidar_to_camera(frame.calibration, frame.points[:, :3])
    inside = (points[:, 0] > x_range[0]) & (points[:, 0] < x_range[1])
    inside &= (points[:, 2] > z_range[0]) & (points[:, 2] < z_range[1])
    x, z = points[inside, 0], points[inside, 2]
    axes.scatter(x, z, s=0.2, color="0.55", linewidths=0, rasterized=True)
    if frame.labels is not None:
        _draw_ground(axes, _labelled(frame, detections), TRUTH, "label")
    _draw_ground(axes, detections, FOUND, "detection")
    axes.set(xlim=x_range, ylim=z_range, xlabel="x [m]", ylabel="z [m]", aspect="equal")
    axes.set_title(f"frame {frame.name}", fontsize=10)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper right", fontsize=8)


def _draw_image(axes: Axes, frame: Frame, detections: Objects) -> None:
    height, width = frame.image.shape[:2]
    axes.imshow(frame.image)
    groups = [(detections, FOUND)]
    if frame.labels is not None:
        groups.insert(0, (_labelled(frame, detections), TRUTH))
    for objects, colour in groups:
        for corners in _corners(objects):
            pixels, depth = project(frame.calibration, corners)
            if (depth < 0.5).any():
                continue
            for a, b in _EDGES:
                axes.plot(*pixels[[a, b]].T, color=colour, lw=1.0)
    for box, score in zip(detections.bbox, detections.score, strict=True):
        axes.text(box[0], box[1] - 2, f"{score:.2f}", color=FOUND, fontsize=7, va="bottom")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_axis_off()


def plot_bird(
    frame: Frame,
    detections: Objects,
    *,
    x_range: tuple[float, float] = (-25.0, 25.0),
    z_range: tuple[float, float] = (0.0, 50.0),
) -> Figure:
    """Lidar points from above with labelled cars and detections; thick edges are fronts."""
    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    _draw_bird(figure.subplots(), frame, detections, x_range, z_range)
    return figure


def plot_image(frame: Frame, detections: Objects) -> Figure:
    """Camera image with the 3D boxes of labelled cars and detections, scores beside the latter."""
    height, width = frame.image.shape[:2]
    figure = Figure(figsize=(9.0, 9.0 * height / width), layout="constrained")
    _draw_image(figure.subplots(), frame, detections)
    return figure


def plot_detections(frames: Sequence[Frame], detections: Sequence[Objects]) -> Figure:
    """Frames below each other: the image with boxes, and the road from above.

    Raises:
        ValueError: no frame, or not as many detections as frames.
    """
    if not frames or len(frames) != len(detections):
        raise ValueError(
            f"{len(frames)} frames and {len(detections)} sets of detections, expected the same "
            "number, at least one"
        )
    n = len(frames)
    figure = Figure(figsize=(10.0, 2.7 * n), layout="constrained")
    panels = figure.subplots(n, 2, squeeze=False, width_ratios=(2.6, 1.0))
    for (left, right), frame, found in zip(panels, frames, detections, strict=True):
        _draw_image(left, frame, found)
        _draw_bird(right, frame, found, (-25.0, 25.0), (0.0, 50.0))
        if right is not panels[0, 1] and (legend := right.get_legend()) is not None:
            legend.remove()
    return figure


def plot_precision(evaluations: Mapping[str, Evaluation], metric: str = "3d") -> Figure:
    """Precision over recall of cars, one panel a difficulty, one line a model.

    Args:
        evaluations: name -> evaluation whose first class is drawn.
        metric: of `METRICS`.

    Raises:
        ValueError: unknown metric.
    """
    if metric not in METRICS:
        raise ValueError(f"metric={metric!r}, expected one of {', '.join(METRICS)}")
    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    panels = figure.subplots(1, len(DIFFICULTIES), sharey=True)
    recall = np.arange(N_POINTS) / (N_POINTS - 1)
    for d, (axes, difficulty) in enumerate(zip(panels, DIFFICULTIES, strict=True)):
        for name, evaluation in evaluations.items():
            axes.plot(recall, evaluation.precision[0, METRICS.index(metric), d], label=name)
        n = int(next(iter(evaluations.values())).n_objects[0, d])
        axes.set_title(f"{difficulty}, {n} cars", fontsize=10)
        axes.set(xlabel="recall", xlim=(0, 1), ylim=(0, 1.02))
    panels[0].set_ylabel(f"precision ({metric})")
    panels[-1].legend(fontsize=8)
    return figure


def plot_training(history: list[dict[str, float]]) -> Figure:
    """Terms of the loss over the steps."""
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    steps = [row["step"] for row in history]
    for name in ("total", "rpn_classes", "rpn_boxes", "classes", "boxes", "angle"):
        axes.plot(steps, [row[name] for row in history], label=name.replace("_", " "))
    axes.set(xlabel="step", ylabel="loss", yscale="log")
    axes.legend(fontsize=8, ncols=2)
    return figure
