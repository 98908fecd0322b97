"""Pictures of maps, trials, learning curves, plasticity curves and spikes; the one file with
matplotlib.

Every function returns a `matplotlib.figure.Figure` (`plot_trial` a `FuncAnimation`) that belongs
to nobody's window; saving it is the caller's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle, Wedge

from jaxsnn import planner, world

# Colour-blind safe (Okabe & Ito); black comes last.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_OBSTACLE = "#8c8c8c"
_TARGET = "#c62828"
_START = "#1565c0"
_ENDS = {"arrived": ("o", "#009E73"), "collided": ("X", "#c62828"), "open": ("s", "#8c8c8c")}


def _axes(ax: Axes | None, size: tuple[float, float]) -> tuple[Figure, Axes]:
    if ax is not None:
        figure = ax.get_figure()
        assert isinstance(figure, Figure)
        return figure, ax
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots()


def _open_spines(ax: Axes) -> None:
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(color="#dddddd", linewidth=0.6)
    ax.set_axisbelow(True)


def _draw_map(ax: Axes, params: world.WorldParams, *, t: int = 0) -> list[Any]:
    """Draw walls, obstacles (where they are at step `t`), start circles and the target.

    Returns:
        The patches of the obstacles, so that an animation can move them.
    """
    x0, y0, x1, y1 = np.asarray(params.bounds)
    ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, linewidth=2.5))
    for (x, y, r), p in zip(np.asarray(params.starts), np.asarray(params.start_probs), strict=True):
        if p > 0:
            ax.add_patch(Circle((x, y), r, color=_START, alpha=0.25, linewidth=0))
    # The box that the arrival circle just encloses: the "red box" of the source.
    half = float(params.arrival_radius) / np.sqrt(2.0)
    tx, ty = np.asarray(params.target)
    ax.add_patch(Rectangle((tx - half, ty - half), 2 * half, 2 * half, color=_TARGET, linewidth=0))
    loops, circles = _shapes(params, t)
    patches: list[Any] = [Polygon(loop, closed=True) for loop in loops]
    patches += [Circle((x, y), r) for x, y, r in circles]
    for patch in patches:
        patch.set(facecolor=_OBSTACLE, edgecolor="black", linewidth=1.0)
        ax.add_patch(patch)
    pad = 0.01 * (x1 - x0)
    ax.set(
        xlim=(x0 - pad, x1 + pad), ylim=(y0 - pad, y1 + pad), aspect="equal", xticks=[], yticks=[]
    )
    ax.spines[:].set_visible(False)
    return patches


def _shapes(params: world.WorldParams, t: int) -> tuple[list[np.ndarray], np.ndarray]:
    segments, circles = world.obstacles_at(params, jnp.asarray(t, jnp.int32))
    shown = planner.Obstacles(
        np.asarray(segments, np.float64)[np.asarray(params.segment_mask)],
        np.asarray(circles, np.float64)[np.asarray(params.circle_mask)],
        np.asarray(params.bounds, np.float64),
    )
    return shown.loops(), shown.circles


def plot_maps(maps: Mapping[str, world.WorldParams], *, columns: int = 3) -> Figure:
    """Several maps side by side, each under its name."""
    columns = min(columns, len(maps))
    rows = -(-len(maps) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.0 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for ax in grid.flat:
        ax.set_axis_off()
    for ax, (name, params) in zip(grid.flat, maps.items(), strict=False):
        _draw_map(ax, params)
        ax.set_title(name)
    return figure


def _end(arrived: bool, collided: bool) -> str:
    return "arrived" if arrived else "collided" if collided else "open"


def plot_trajectories(
    params: world.WorldParams,
    paths: Sequence[np.ndarray],
    *,
    arrived: Sequence[bool],
    collided: Sequence[bool],
    title: str = "",
    shortest: bool = False,
    ax: Axes | None = None,
) -> Figure:
    """Paths of trials on their map, each with a mark for how it ended (Figures 2.9-2.14).

    Args:
        params: the map.
        paths: one `[steps, 2]` array of positions for each trial [px].
        arrived: did the trial reach the target?
        collided: did it end in a collision? Neither: it ran out of steps.
        title: text above the picture.
        shortest: also draw the shortest collision-free path from the first trial's start.
        ax: axes to draw in.

    Raises:
        ValueError: the numbers of paths and outcomes differ.
    """
    if not len(paths) == len(arrived) == len(collided):
        raise ValueError(
            f"paths=<{len(paths)}>, arrived=<{len(arrived)}>, collided=<{len(collided)}>: expected "
            "equal numbers; give one flag of each kind for each path"
        )
    figure, ax = _axes(ax, (6.0, 4.6))
    _draw_map(ax, params)
    if shortest:
        _, points = planner.shortest_path(params, np.asarray(paths[0], np.float64)[0].tolist())
        ax.plot(*points.T, "k--", linewidth=1.2, label="shortest path")
    seen: set[str] = set()
    for i, path in enumerate(paths):
        path = np.asarray(path)
        end = _end(bool(arrived[i]), bool(collided[i]))
        marker, colour = _ENDS[end]
        line = COLOURS[i % 6]
        thin = len(paths) > 3
        ax.plot(*path.T, "-", color=line, linewidth=1.0 if thin else 1.6, alpha=0.7 if thin else 1)
        if not thin:
            ax.plot(*path.T, ".", color=line, markersize=3)
        label = {"arrived": "arrived", "collided": "collision", "open": "out of steps"}[end]
        ax.plot(
            *path[-1], marker, color=colour, markersize=7, markeredgecolor="white",
            linestyle="none", label=None if end in seen else label,
        )  # fmt: skip
        seen.add(end)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=4, frameon=False)
    ax.set_title(title)
    return figure


def plot_learning_curves(
    curves: Mapping[str, np.ndarray],
    *,
    window: int = 1,
    xlabel: str = "training trial",
    ylabel: str = "success rate [%]",
    x: np.ndarray | None = None,
    scale: float = 100.0,
    logx: bool = False,
    ax: Axes | None = None,
) -> Figure:
    """Mean over seeds with its 95 % interval, one curve for each name.

    Args:
        curves: name -> `[seeds, trials]`, for example success of each training trial as 0 or 1.
        window: width of the running mean over trials.
        xlabel: text of the x axis.
        ylabel: text of the y axis.
        x: positions of the trials; 1, 2, .. by default.
        scale: factor on the values.
        logx: logarithmic x axis.
        ax: axes to draw in.
    """
    figure, ax = _axes(ax, (5.6, 3.6))
    for i, (name, values) in enumerate(curves.items()):
        values = scale * np.asarray(values, np.float64)
        kernel = np.ones(min(window, values.shape[1])) / min(window, values.shape[1])
        smooth = np.stack([np.convolve(row, kernel, mode="valid") for row in values])
        mean = smooth.mean(axis=0)
        steps = np.arange(1, values.shape[1] + 1) if x is None else np.asarray(x)
        steps = steps[len(steps) - len(mean) :]
        colour = COLOURS[i % len(COLOURS)]
        ax.plot(steps, mean, color=colour, label=name)
        if len(values) > 1:
            half = 1.96 * smooth.std(axis=0, ddof=1) / np.sqrt(len(values))
            ax.fill_between(steps, mean - half, mean + half, color=colour, alpha=0.2, linewidth=0)
    ax.set(xlabel=xlabel, ylabel=ylabel)
    if logx:
        ax.set_xscale("log")
    _open_spines(ax)
    ax.legend(frameon=False)
    return figure


def plot_stdp_curve(lag: np.ndarray, change: np.ndarray, *, ax: Axes | None = None) -> Figure:
    """Weight change against `t_post - t_pre` (Figure 2.2).

    Args:
        lag: time of the postsynaptic spike minus that of the presynaptic one `[n]` [ms].
        change: change of the weight for one such pair `[n]` [mV].
        ax: axes to draw in.
    """
    return plot_rm_stdp_curves(lag, {"": change}, ax=ax)


def plot_rm_stdp_curves(
    lag: np.ndarray, changes: Mapping[str, np.ndarray], *, ax: Axes | None = None
) -> Figure:
    """Weight change against `t_post - t_pre`, one curve for each reward (Figure 2.3).

    Args:
        lag: time of the postsynaptic spike minus that of the presynaptic one `[n]` [ms].
        changes: label of the reward -> change of the weight `[n]` [mV].
        ax: axes to draw in.
    """
    figure, ax = _axes(ax, (5.0, 3.6))
    lag = np.asarray(lag)
    for i, (name, change) in enumerate(changes.items()):
        for j, side in enumerate((lag < 0, lag > 0)):
            label = name if name and j == 0 else None
            ax.plot(lag[side], np.asarray(change)[side], color=COLOURS[i], label=label)
    ax.axhline(0.0, color="black", linewidth=0.8)
    ax.axvline(0.0, color="black", linewidth=0.8)
    ax.set(xlabel=r"$t_\mathrm{post} - t_\mathrm{pre}$ [ms]", ylabel="change of weight [mV]")
    _open_spines(ax)
    if any(changes):
        ax.legend(frameon=False)
    return figure


def plot_spike_raster(
    spikes: Mapping[str, np.ndarray],
    weights: Mapping[str, np.ndarray] | None = None,
    *,
    dt: float = 1.0,
) -> Figure:
    """Spikes of each layer over time, and beside them its weights.

    Args:
        spikes: name of the layer -> `[steps, neurons]` bool.
        weights: name -> `[pre, post]` signed weights [mV]; red excites, blue inhibits.
        dt: length of a step [ms].
    """
    weights = weights or {}
    figure = Figure(figsize=(10.0 if weights else 6.5, 6.0), layout="constrained")
    parts: Any = figure.subfigures(1, 2, width_ratios=[3, 2]) if weights else [figure]
    left, right = parts[0], parts[-1]
    heights = [max(3.0, np.sqrt(s.shape[1])) for s in spikes.values()]
    rows = left.subplots(len(spikes), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    for ax, (name, fired) in zip(rows, spikes.items(), strict=True):
        fired = np.asarray(fired)
        t, neuron = np.nonzero(fired)
        length = max(0.8, 0.004 * fired.shape[1])
        ax.vlines(t * dt, neuron - length / 2, neuron + length / 2, color="black", linewidth=0.7)
        ax.set(ylim=(-1, fired.shape[1]), ylabel=name)
        rate = 1000.0 * fired.mean() / dt
        ax.set_title(f"mean {rate:.0f} Hz", loc="right", fontsize=8)
        ax.spines[["top", "right"]].set_visible(False)
        if fired.shape[1] < 5:
            ax.set_yticks(range(fired.shape[1]))
    rows[-1].set(xlabel="time [ms]", xlim=(0, next(iter(spikes.values())).shape[0] * dt))
    if weights:
        columns = right.subplots(len(weights), 1, squeeze=False)[:, 0]
        for ax, (name, w) in zip(columns, weights.items(), strict=True):
            w = np.asarray(w)
            top = max(float(np.abs(w).max()), 1e-6)
            image = ax.imshow(
                w.T, aspect="auto", cmap="RdBu_r", vmin=-top, vmax=top, interpolation="nearest",
                origin="lower",
            )  # fmt: skip
            ax.set(title=name, xlabel="from neuron", ylabel="to neuron")
            right.colorbar(image, ax=ax, label="weight [mV]")
            if w.shape[1] < 5:
                ax.set_yticks(range(w.shape[1]))
    return figure


def plot_trial(
    params: world.WorldParams,
    path: np.ndarray,
    headings: np.ndarray,
    *,
    sonar: np.ndarray | None = None,
    arrived: bool = False,
    collided: bool = False,
    title: str = "",
    fps: int = 12,
) -> FuncAnimation:
    """One trial as an animation: the robot, its trail, what its sonars see.

    Args:
        params: the map; moving obstacles move.
        path: positions `[steps, 2]` [px].
        headings: `[steps]` [rad].
        sonar: readings `[steps, sonars]` [px]; no rays are drawn without them.
        arrived: the trial ended at the target.
        collided: the trial ended in a collision.
        title: text above the picture.
        fps: frames per second; one frame is one control step, and the last one stays for a second.

    Returns:
        The animation; `animation.save(file, writer=PillowWriter(fps=fps))` makes a GIF of it.

    Raises:
        ValueError: the lengths of path, headings and sonar differ, or there is no step.
    """
    path, headings = np.asarray(path), np.asarray(headings)
    if (
        len(path) == 0
        or len(headings) != len(path)
        or (sonar is not None and len(sonar) != len(path))
    ):
        raise ValueError(
            f"path=<{len(path)} steps>, headings=<{len(headings)}>, sonar="
            f"<{'none' if sonar is None else len(sonar)}>: expected equal numbers >= 1; cut them"
        )
    figure = Figure(figsize=(5.0, 4.0), layout="constrained")
    ax = figure.subplots()
    obstacles = _draw_map(ax, params)
    ax.set_title(title)
    (trail,) = ax.plot([], [], "-", color=COLOURS[0], linewidth=1.4)
    rays = [ax.plot([], [], "-", color=COLOURS[4], linewidth=0.8)[0] for _ in params.sonar_angles]
    body = Circle((0, 0), 1.5 * float(params.robot_radius), color=COLOURS[0], zorder=3)
    nose = Wedge((0, 0), 3.0 * float(params.robot_radius), 0, 1, color=COLOURS[0], zorder=3)
    ax.add_patch(body)
    ax.add_patch(nose)
    status = ax.text(0.5, -0.02, "", transform=ax.transAxes, ha="center", va="top")
    angles = np.deg2rad(np.asarray(params.sonar_angles))
    moving = bool(np.any(np.asarray(params.segment_velocity)) | np.any(params.circle_velocity))

    def frame(i: int) -> list[Any]:
        last = i >= len(path) - 1
        i = min(i, len(path) - 1)
        trail.set_data(*path[: i + 1].T)
        body.set_center(tuple(path[i]))
        degrees = float(np.rad2deg(headings[i]))
        nose.set_center(tuple(path[i]))
        nose.set_theta1(degrees - 20)
        nose.set_theta2(degrees + 20)
        for ray, angle, reach in zip(rays, angles, [] if sonar is None else sonar[i], strict=False):
            tip = path[i] + reach * np.array(
                [np.cos(headings[i] + angle), np.sin(headings[i] + angle)]
            )
            ray.set_data([path[i][0], tip[0]], [path[i][1], tip[1]])
        if moving:
            loops, circles = _shapes(params, i)
            for patch, loop in zip(obstacles, loops, strict=False):
                patch.set_xy(loop)
            for patch, (x, y, _) in zip(obstacles[len(loops) :], circles, strict=True):
                patch.set_center((x, y))
        end = {"arrived": ": arrived", "collided": ": collision", "open": ""}
        status.set_text(f"step {i}" + (end[_end(arrived, collided)] if last else ""))
        return [trail, body, nose, status, *rays, *obstacles]

    return FuncAnimation(figure, frame, frames=len(path) + fps, blit=False)
