"""Pictures: worst case against simulations, active parameters, errors of a probability.

Each returns a figure; `figure.savefig(path)` is the caller's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from failure.search.bayesopt import best_so_far


def plot_trend(
    outputs: Mapping[str, np.ndarray],
    *,
    threshold: float | None = None,
    n_init: int | None = None,
    label: str = "specification",
) -> Figure:
    """Median worst case so far with the band of the middle half of the seeds (Figures 4.7, 4.8).

    Args:
        outputs: method -> `y [S, n]`, larger is worse.
        threshold: drawn as a line.
        n_init: end of the initial design.
        label: of the vertical axis.
    """
    figure = Figure(figsize=(7.0, 4.2), layout="constrained", dpi=150)
    axes = figure.add_subplot()
    for name, y in outputs.items():
        best = best_so_far(np.asarray(y))
        best = np.where(np.isfinite(best), best, np.nan)
        low, middle, high = np.nanquantile(best, [0.25, 0.5, 0.75], axis=0)
        steps = np.arange(1, best.shape[1] + 1)
        (line,) = axes.plot(steps, middle, label=name, linewidth=1.6)
        axes.fill_between(steps, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
    if threshold is not None:
        axes.axhline(threshold, color="black", linestyle="--", linewidth=1.0, label="threshold")
    if n_init is not None:
        axes.axvline(n_init, color="grey", linestyle=":", linewidth=1.0)
    axes.set_xlabel("simulations")
    axes.set_ylabel(f"worst {label} so far")
    axes.legend(fontsize=8)
    return figure


def plot_activity(names: Sequence[tuple[str, str]], values: np.ndarray, *, title: str) -> Figure:
    """A map of one value per parameter: transistors across, quantities down.

    Args:
        names: `(transistor, quantity)` of every parameter.
        values: `[D]`, such as a failure point in sigma.
        title: of the picture.
    """
    transistors = list(dict.fromkeys(name for name, _ in names))
    quantities = list(dict.fromkeys(quantity for _, quantity in names))
    grid = np.full((len(quantities), len(transistors)), np.nan)
    for (name, quantity), value in zip(names, values, strict=True):
        grid[quantities.index(quantity), transistors.index(name)] = value
    limit = float(np.nanmax(np.abs(grid))) or 1.0
    figure = Figure(figsize=(0.4 * len(transistors) + 2.0, 2.4), layout="constrained", dpi=150)
    axes = figure.add_subplot()
    image = axes.imshow(grid, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto")
    axes.set_xticks(range(len(transistors)), transistors, rotation=90, fontsize=7)
    axes.set_yticks(range(len(quantities)), quantities, fontsize=7)
    axes.set_title(title, fontsize=9)
    figure.colorbar(image, ax=axes)
    return figure


def plot_shares(shares: Mapping[str, float], *, title: str) -> Figure:
    """Bars of one share per transistor, and what each would have if all were alike.

    Args:
        shares: transistor -> share, in the order of the bars.
        title: of the picture.
    """
    figure = Figure(figsize=(0.32 * len(shares) + 1.6, 3.0), layout="constrained", dpi=150)
    axes = figure.add_subplot()
    axes.bar(list(shares), list(shares.values()))
    axes.axhline(1.0 / len(shares), color="black", linestyle="--", linewidth=1.0)
    axes.tick_params(axis="x", rotation=90, labelsize=7)
    axes.set_ylabel("mean fusion weight")
    axes.set_title(title, fontsize=9)
    return figure


def plot_errors(
    runs: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]]],
) -> Figure:
    """Estimated over true probability against simulations, one panel per problem, a mark per run.

    Filled marks are runs that call themselves good, hollow ones say that they do not know; the band
    is a factor 2. Ratios outside of the panel are drawn on its edge.

    Args:
        runs: problem -> method -> (simulations `[S]`, estimate over truth `[S]`, good `[S]`).
    """
    across = min(3, len(runs))
    down = -(-len(runs) // across)
    figure = Figure(figsize=(3.3 * across + 1.8, 2.7 * down + 0.4), layout="constrained", dpi=150)
    panels = list(figure.subplots(down, across, squeeze=False, sharey=True).flat)
    methods = list(dict.fromkeys(m for found in runs.values() for m in found))
    low, high = 0.05, 20.0
    for axes, (title, found) in zip(panels, runs.items(), strict=False):
        axes.axhspan(0.5, 2.0, color="0.92", zorder=0)
        axes.axhline(1.0, color="0.6", linewidth=0.8, zorder=1)
        for method, (simulations, ratio, good) in found.items():
            color = f"C{methods.index(method) % 10}"
            held = np.clip(np.nan_to_num(ratio, nan=low), low, high)
            for known in (True, False):
                rows = good == known
                axes.scatter(
                    simulations[rows], held[rows], s=14, linewidths=0.8, edgecolors=color,
                    facecolors=color if known else "none", zorder=2,
                )  # fmt: skip
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_yscale("log")
        axes.set_ylim(0.9 * low, 1.1 * high)
        axes.set_title(title, fontsize=8)
        axes.tick_params(which="both", labelsize=7)
        axes.set_xlabel("simulations", fontsize=7)
    for axes in panels[len(runs) :]:
        axes.set_visible(False)
    figure.supylabel("estimate / P", fontsize=8)
    marks = [
        Line2D([], [], marker="o", linestyle="", markersize=4, color=f"C{k % 10}", label=name)
        for k, name in enumerate(methods)
    ]
    figure.legend(handles=marks, loc="outside right upper", fontsize=7)
    return figure


def plot_design_points(
    names: Sequence[tuple[str, str]], points: Mapping[str, np.ndarray], *, title: str
) -> Figure:
    r"""Which transistors a failure is made of: share of each in the squared distance.

    .. math:: s_t = \sum_{i \in t} u_i^2 / |u|^2

    Args:
        names: `(transistor, quantity)` of every parameter.
        points: specification -> nearest failing point `[D]` [sigma].
        title: of the picture.
    """
    transistors = list(dict.fromkeys(name for name, _ in names))
    figure = Figure(figsize=(0.34 * len(transistors) + 2.0, 3.2), layout="constrained", dpi=150)
    axes = figure.add_subplot()
    width = 0.8 / len(points)
    for k, (label, point) in enumerate(points.items()):
        share = np.zeros(len(transistors))
        for (name, _), value in zip(names, point, strict=True):
            share[transistors.index(name)] += value**2 / float(point @ point)
        at = np.arange(len(transistors)) + (k - 0.5 * (len(points) - 1)) * width
        axes.bar(at, share, width, label=f"{label}, {np.linalg.norm(point):.2f} sigma")
    axes.set_xticks(range(len(transistors)), transistors, rotation=90, fontsize=7)
    axes.set_ylabel("share of the squared distance", fontsize=8)
    axes.set_title(title, fontsize=9)
    axes.legend(fontsize=7)
    return figure
