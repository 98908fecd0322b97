"""Pictures of a sweep: a heat map per pair of axes, and parallel coordinates.

Pictures are of the settings that are ranked; bright is better, whichever way the objective counts.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from snn_fusion_failure.sweeps.rank import axis_columns, axis_names, rank, value_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_all(dataset: Any, *, pairs: int = 6) -> dict[str, Figure]:
    """Heat maps (of a grid, at most `pairs`) and parallel coordinates, by file name."""
    leaves = axis_names(dataset)
    figures: dict[str, Figure] = {}
    if "setting" not in dataset.dims and len(leaves) >= 2:
        for row, column in itertools.islice(itertools.combinations(leaves, 2), pairs):
            figures[f"heat_{row}_{column}.png"] = plot_heat_map(dataset, row, column)
    return figures | {"parallel.png": plot_parallel(dataset)}


def _means(dataset: Any) -> np.ndarray:
    """Mean of the objective per setting, NaN where it is not ranked."""
    found = np.full(int(np.prod(dataset["status"].shape)) // dataset.sizes["seed"], np.nan)
    for row in rank(dataset):
        found[row["setting"]] = row["mean"]
    return found


def _style(dataset: Any) -> tuple[str, str]:
    objective = dataset.attrs["objective"]
    label = f"{objective} [{dataset[objective].attrs['units']}]".replace(" [1]", "")
    return label, "viridis" if dataset[objective].attrs["goal"] == "max" else "viridis_r"


def plot_heat_map(dataset: Any, row: str, column: str) -> Figure:
    """Mean objective over two axes of a grid; over the others it is averaged.

    Returns:
        matplotlib Figure.
    """
    import matplotlib.pyplot as plt
    import xarray as xr

    label, colours = _style(dataset)
    leaves = axis_names(dataset)
    shape = [dataset.sizes[leaf] for leaf in leaves]
    mean = xr.DataArray(_means(dataset).reshape(shape), dims=leaves)
    others = [leaf for leaf in leaves if leaf not in (row, column)]
    plane = mean.mean(others).transpose(row, column)
    figure, axis = plt.subplots(figsize=(5.5, 4.2), layout="constrained")
    image = axis.imshow(
        np.ma.masked_invalid(np.asarray(plane)), origin="lower", aspect="auto", cmap=colours
    )
    axis.set_facecolor("0.85")  # nothing ranked here
    for which, leaf in (("x", column), ("y", row)):
        ticks = np.asarray(dataset[leaf])
        at = np.arange(0, len(ticks), max(1, -(-len(ticks) // 8)))
        getattr(axis, f"set_{which}ticks")(at, [value_text(ticks[i]) for i in at])
        unit = dataset[leaf].attrs["units"]
        getattr(axis, f"set_{which}label")(leaf if unit == "1" else f"{leaf} [{unit}]")
    figure.colorbar(image, label=label)
    return figure


def plot_parallel(dataset: Any) -> Figure:
    """A line per setting through its values, by rank, and its objective.

    Returns:
        matplotlib Figure.
    """
    import matplotlib.pyplot as plt
    from matplotlib.colors import Normalize

    label, colours = _style(dataset)
    mean = _means(dataset)
    figure, axis = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    finite = np.isfinite(mean)
    heights, names = [], []
    for leaf, values in axis_columns(dataset).items():
        # Ranks: evenly spread whatever the axis' scale.
        levels = np.unique(values)
        heights.append(np.searchsorted(levels, values) / max(1, len(levels) - 1))
        names.append(f"{leaf}\n{value_text(levels[0])} .. {value_text(levels[-1])}")
    low, high = (mean[finite].min(), mean[finite].max()) if finite.any() else (0.0, 1.0)
    span = high - low if high > low else 1.0
    heights.append(np.where(finite, (mean - low) / span, 0.0))
    names.append(f"{label}\n{low:.3g} .. {high:.3g}")
    norm, palette = Normalize(low, low + span), plt.get_cmap(colours)
    for index in np.argsort(mean if colours == "viridis" else -mean):
        if finite[index]:
            axis.plot([h[index] for h in heights], color=palette(norm(mean[index])), alpha=0.8)
    for place in range(len(names)):
        axis.axvline(place, color="0.3", lw=0.8)
    axis.set_xticks(range(len(names)), names)
    axis.set_yticks([])
    axis.spines[:].set_visible(False)
    return figure
