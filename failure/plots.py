"""Pictures of a search: worst case against simulations, and which parameters were active.

Each returns a figure; `figure.savefig(path)` is the caller's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

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
