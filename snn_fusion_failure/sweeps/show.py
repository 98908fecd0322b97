"""What a sweep found: the best settings with intervals, heat maps, parallel coordinates."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.records.rows import summarize
from snn_fusion_failure.sweeps.folder import OK, STATUS

__all__ = ["draw", "rank", "table"]


def rank(dataset: Any) -> list[dict[str, Any]]:
    """Settings from best to worst by the mean of the objective over the trials that are ok.

    Returns:
        Per setting: `axes`, `n` trials that count, `mean` and `ci95` (Student's t) of the
        objective, and `broken`, the number of trials that are not finite or failed. Settings
        without a trial that counts are left out.
    """
    objective = dataset.attrs["objective"]
    goal = dataset[objective].attrs["goal"]
    leaves = axis_names(dataset)
    values = np.asarray(dataset[objective]).reshape(-1, dataset.sizes["seed"])
    status = np.asarray(dataset["status"]).reshape(values.shape)
    columns = _axis_columns(dataset, leaves)
    rows = []
    for index, (numbers, states) in enumerate(zip(values, status, strict=True)):
        # An optional objective may be NaN in a trial that is ok: it has no number to average.
        counted = numbers[(states == OK) & np.isfinite(numbers)]
        if len(counted) == 0:
            continue
        summary = summarize(counted.tolist())
        rows.append(
            {
                "axes": {leaf: float(columns[leaf][index]) for leaf in leaves},
                "n": summary["n"],
                "mean": summary["mean"],
                "ci95": summary["ci95"],
                "broken": int(np.isin(states, (1, 2)).sum()),
            }
        )
    return sorted(rows, key=lambda row: row["mean"], reverse=goal == "max")


def axis_names(dataset: Any) -> list[str]:
    """The swept leaves, in the order of the command line."""
    return [str(name) for name in dataset.coords if name not in ("seed", "setting")]


def _axis_columns(dataset: Any, leaves: list[str]) -> dict[str, np.ndarray]:
    """Value of each axis for each setting, in the order of the reshaped metrics."""
    if "setting" in dataset.dims:
        return {leaf: np.asarray(dataset[leaf]) for leaf in leaves}
    mesh = np.meshgrid(*(np.asarray(dataset[leaf]) for leaf in leaves), indexing="ij")
    return {leaf: m.ravel() for leaf, m in zip(leaves, mesh, strict=True)}


def table(dataset: Any, rows: list[dict[str, Any]], *, top: int = 10) -> str:
    """The best settings as text, and what became of the trials."""
    objective = dataset.attrs["objective"]
    leaves = axis_names(dataset)
    unit = dataset[objective].attrs["units"].replace("1", "", 1)

    def head(leaf: str) -> str:
        axis_unit = dataset[leaf].attrs["units"]
        return leaf if axis_unit == "1" else f"{leaf} [{axis_unit}]"

    title = f"{objective} [{unit}]" if unit else objective
    lines = [["", *map(head, leaves), title, "95 % interval", "n", "broken"]]
    for place, row in enumerate(rows[:top], 1):
        interval = "{:.4g} .. {:.4g}".format(*row["ci95"]) if row["ci95"] else "-"
        lines.append(
            [str(place), *(f"{row['axes'][leaf]:.6g}" for leaf in leaves), f"{row['mean']:.4g}",
             interval, str(row["n"]), str(row["broken"])]
        )  # fmt: skip
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    text = "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in lines
    )
    status = np.asarray(dataset["status"]).ravel()
    counts = [f"{int((status == k).sum())} {name}" for k, name in enumerate(STATUS)]
    return f"{text}\n{len(rows)} settings with results; trials: {', '.join(counts)}"


def draw(dataset: Any, out: Path, *, pairs: int = 6) -> list[Path]:
    """Draw into `out`: a heat map per pair of axes (of a grid) and parallel coordinates.

    In a heat map the other axes are averaged over. Returns the files.
    """
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    files = []
    objective = dataset.attrs["objective"]
    leaves = axis_names(dataset)
    mean = dataset[objective].where(dataset["status"] == OK).mean("seed")
    label = f"{objective} [{dataset[objective].attrs['units']}]".replace(" [1]", "")
    goal = dataset[objective].attrs["goal"]
    # Bright is better, whichever way the objective counts.
    colours = "viridis" if goal == "max" else "viridis_r"
    if "setting" not in dataset.dims and len(leaves) >= 2:
        for row, column in itertools.islice(itertools.combinations(leaves, 2), pairs):
            others = [leaf for leaf in leaves if leaf not in (row, column)]
            plane = mean.mean(others) if others else mean
            figure, axis = plt.subplots(figsize=(5.5, 4.2), layout="constrained")
            _heat_map(axis, plane.transpose(row, column), dataset, row, column, colours, label)
            files.append(out / f"heat_{row}_{column}.png")
            figure.savefig(files[-1], dpi=120)
            plt.close(figure)
    figure, axis = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    _parallel(axis, dataset, np.asarray(mean).ravel(), leaves, colours, label)
    files.append(out / "parallel.png")
    figure.savefig(files[-1], dpi=120)
    plt.close(figure)
    return files


def _heat_map(
    axis: Any, plane: Any, dataset: Any, row: str, column: str, colours: str, label: str
) -> None:
    values = np.ma.masked_invalid(np.asarray(plane))
    image = axis.imshow(values, origin="lower", aspect="auto", cmap=colours)
    axis.set_facecolor("0.85")  # nothing finite here
    for which, leaf in (("x", column), ("y", row)):
        ticks = np.asarray(dataset[leaf])
        step = max(1, -(-len(ticks) // 8))
        at = np.arange(0, len(ticks), step)
        getattr(axis, f"set_{which}ticks")(at, [f"{ticks[i]:.3g}" for i in at])
        unit = dataset[leaf].attrs["units"]
        getattr(axis, f"set_{which}label")(leaf if unit == "1" else f"{leaf} [{unit}]")
    axis.figure.colorbar(image, label=label)


def _parallel(
    axis: Any, dataset: Any, mean: np.ndarray, leaves: list[str], colours: str, label: str
) -> None:
    import matplotlib.pyplot as plt
    from matplotlib.colors import Normalize

    columns = _axis_columns(dataset, leaves)
    finite = np.isfinite(mean)
    heights, names = [], []
    for leaf in leaves:
        values = columns[leaf]
        # Ranks: evenly spread whatever the axis' scale.
        levels = np.unique(values)
        heights.append(np.searchsorted(levels, values) / max(1, len(levels) - 1))
        names.append(f"{leaf}\n{levels[0]:.3g} .. {levels[-1]:.3g}")
    low, high = (mean[finite].min(), mean[finite].max()) if finite.any() else (0.0, 1.0)
    span = high - low if high > low else 1.0
    heights.append(np.where(finite, (mean - low) / span, 0.0))
    names.append(f"{label}\n{low:.3g} .. {high:.3g}")
    norm = Normalize(low, low + span)
    better = np.argsort(mean if colours == "viridis" else -mean)
    palette = plt.get_cmap(colours)
    for index in better:
        if finite[index]:
            axis.plot([h[index] for h in heights], color=palette(norm(mean[index])), alpha=0.8)
    for place in range(len(names)):
        axis.axvline(place, color="0.3", lw=0.8)
    axis.set_xticks(range(len(names)), names)
    axis.set_yticks([])
    axis.spines[:].set_visible(False)
