"""Pictures of fusion models; each function draws one figure and returns it unsaved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fusion._checks import check_choice

Values = ArrayLike | Sequence[Any]

CLEAN = "#0072b2"
FAILED = "#d55e00"
LINES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")


def plot_cases(
    cases: Mapping[str, tuple[float, float | None, float | None]], *, title: str = "Accuracy"
) -> Figure:
    """Draw the accuracy of several cases as bars, with marks for printed and best possible values.

    Args:
        cases: name -> (accuracy, the source's, the ceiling) in percent; None where not known.
        title: of the figure.

    Returns:
        The figure, unsaved.

    Raises:
        ValueError: no cases.
    """
    if not cases:
        raise ValueError("cases={}: expected at least one case; give its accuracy")
    figure = Figure(figsize=(7.0, 1.3 + 0.55 * len(cases)), layout="constrained")
    axes = figure.subplots()
    rows = range(len(cases))
    axes.barh(rows, [value for value, _, _ in cases.values()], color=CLEAN, alpha=0.6, height=0.6)
    for column, color, label in ((1, FAILED, "source"), (2, "black", "best possible")):
        known = [(i, row[column]) for i, row in enumerate(cases.values())]
        marks = [(i, value) for i, value in known if value is not None]
        for number, (row, value) in enumerate(marks):
            axes.plot(
                [value, value],
                [row - 0.38, row + 0.38],
                color=color,
                linewidth=2.5,
                label=None if number else label,
            )
    for row, (accuracy, _, _) in enumerate(cases.values()):
        axes.text(1.0, row, f"{accuracy:.1f} %", va="center", fontsize=9, color="white")
    axes.set_yticks(rows, list(cases))
    axes.invert_yaxis()
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("accuracy, %")
    axes.set_title(title, fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0.1, 1.0))
    return figure


def plot_confusion(
    matrix: Values, classes: Sequence[str], *, title: str = "Confusion matrix"
) -> Figure:
    """Draw a confusion matrix: colour is the share of the true class, numbers are counts.

    Args:
        matrix: `[C, C]` counts, row = true class, as from `evaluate.confusion_matrix`.
        classes: C names.
        title: of the figure.

    Raises:
        ValueError: matrix and names do not fit each other.
    """
    counts = np.asarray(matrix)
    c = len(classes)
    if counts.shape != (c, c):
        raise ValueError(
            f"matrix.shape={counts.shape}: expected ({c}, {c}); give one name for each class"
        )
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    figure = Figure(figsize=(1.9 + 0.62 * c, 1.5 + 0.56 * c), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0)
    for i in range(c):
        for j in range(c):
            if counts[i, j]:
                color = "white" if share[i, j] > 0.5 else "black"
                text = f"{counts[i, j]:d}"
                axes.text(j, i, text, ha="center", va="center", color=color, fontsize=8)
    names = [name.replace("_", " ").lower() if len(name) > 1 else name for name in classes]
    rotate = 40 if max(map(len, names)) > 3 else 0
    axes.set_xticks(
        range(c), names, rotation=rotate, ha="right" if rotate else "center", rotation_mode="anchor"
    )
    axes.set_yticks(range(c), names)
    axes.set_xlabel("predicted")
    axes.set_ylabel("true")
    right = np.trace(counts) / max(counts.sum(), 1)
    axes.set_title(f"{title} (accuracy {100 * right:.1f} %)", fontsize=10)
    figure.colorbar(image, ax=axes, shrink=0.8, label="share of the true class")
    return figure


def plot_gate(
    weights: Values,
    mask: Values,
    channels: Sequence[str],
    *,
    title: str = "Fusion weights of corrupted examples",
) -> Figure:
    """Draw the fusion weights of every channel, when clean and when failed.

    Boxes span the quartiles over corrupted examples, whiskers 5 to 95 %; the dashed line is 1 / K.

    Args:
        weights: `[N, K]` fusion weights; mask: `[N, K]`, True where a channel has failed.
        channels: K names.
        title: of the figure.

    Raises:
        ValueError: shapes that do not fit, or no corrupted example.
    """
    w, m = _weights_and_mask(weights, mask, len(channels))
    w, m = w[m.any(axis=1)], m[m.any(axis=1)]
    if not len(w):
        raise ValueError(
            "mask=all False: expected examples with a failed channel; there is nothing to compare"
        )
    k = len(channels)
    figure = Figure(figsize=(2.0 + 0.62 * k, 4.4), layout="constrained")
    axes = figure.subplots()
    for side, failed, color, label in (
        (-0.19, False, CLEAN, "clean"),
        (0.19, True, FAILED, "failed"),
    ):
        values = [w[m[:, i] == failed, i] for i in range(k)]
        here = [i for i in range(k) if values[i].size]
        if here:
            axes.boxplot(
                [values[i] for i in here],
                positions=[i + side for i in here],
                widths=0.32,
                whis=(5, 95),
                showfliers=False,
                patch_artist=True,
                boxprops={"facecolor": color, "alpha": 0.55, "edgecolor": color},
                medianprops={"color": "black"},
                whiskerprops={"color": color},
                capprops={"color": color},
                manage_ticks=False,
            )
        axes.plot([], [], color=color, linewidth=6, alpha=0.55, label=label)
    axes.axhline(1.0 / k, color="gray", linestyle="--", linewidth=1, label=f"1 / {k}")
    names = [_short(name) for name in channels]
    axes.set_xticks(range(k), names, rotation=40, ha="right", rotation_mode="anchor", fontsize=8)
    axes.set_xlim(-0.6, k - 0.4)
    axes.set_ylim(0.0, 1.12 * axes.get_ylim()[1])
    axes.set_ylabel("fusion weight")
    axes.set_title(title, fontsize=10)
    axes.legend(frameon=False, ncols=3, fontsize=8, loc="upper right")
    return figure


def plot_channel_weights(
    models: Mapping[str, tuple[Values, Values]],
    channel: str,
    channels: Sequence[str],
    *,
    bins: int = 40,
) -> Figure:
    """Draw how the fusion weight of one channel is distributed, for several models.

    Top row: corrupted examples in which the channel has failed. Bottom row: corrupted examples in
    which it is clean (with one clean channel: the only clean one). The dashed line is 1 / K.

    Args:
        models: name -> (`[N, K]` fusion weights, `[N, K]` mask of failed channels).
        channel: the channel to look at, such as `total_acc_y`.
        channels: K names.
        bins: of the histograms, the same for all panels.

    Raises:
        ValueError: no models, an unknown channel (the message lists the known ones), wrong shapes.

    Source: Shim (2020), Figure 3.7.
    """
    check_choice("channel", channel, channels)
    if not models:
        raise ValueError("models={}: expected at least one; give its weights and mask")
    index, k = list(channels).index(channel), len(channels)
    data = {name: _weights_and_mask(*pair, k) for name, pair in models.items()}
    top = max(float(w[m.any(axis=1), index].max(initial=1.0 / k)) for w, m in data.values())
    edges = np.linspace(0.0, 1.05 * top, bins + 1)
    figure = Figure(figsize=(1.2 + 2.2 * len(data), 4.4), layout="constrained")
    grid = figure.subplots(2, len(data), sharex=True, sharey="row", squeeze=False)
    for column, (name, (w, m)) in enumerate(data.items()):
        failed = m[:, index]
        clean = m.any(axis=1) & ~failed
        for row, (chosen, color) in enumerate(((failed, FAILED), (clean, CLEAN))):
            axes: Axes = grid[row, column]
            n = int(chosen.sum())
            share = np.full(n, 100.0 / max(n, 1))
            axes.hist(w[chosen, index], bins=edges.tolist(), weights=share, color=color, alpha=0.75)
            axes.axvline(1.0 / k, color="gray", linestyle="--", linewidth=1)
            mean = f"mean {w[chosen, index].mean():.3f}" if n else "none"
            axes.text(
                0.97,
                0.95,
                f"{mean}\nn = {n}",
                transform=axes.transAxes,
                ha="right",
                va="top",
                fontsize=8,
            )
        grid[0, column].set_title(name, fontsize=10)
        grid[1, column].set_xlabel("fusion weight")
    grid[0, 0].set_ylabel("channel failed\n% of examples")
    grid[1, 0].set_ylabel("channel clean\n% of examples")
    figure.suptitle(f"Fusion weight of {channel} in corrupted examples", fontsize=10)
    return figure


def plot_training(curves: Mapping[str, Mapping[str, Values]], *, title: str = "Training") -> Figure:
    """Draw training curves, one panel per metric and one line per model.

    Args:
        curves: model -> metric -> values `[epochs]` or `[seeds, epochs]`; with seeds the line is
            the mean and the band spans the smallest to the largest seed.
        title: of the figure.

    Raises:
        ValueError: no curves.
    """
    metrics = list(dict.fromkeys(metric for by_metric in curves.values() for metric in by_metric))
    if not metrics:
        raise ValueError("curves={}: expected at least one model with one metric; give its values")
    figure = Figure(figsize=(1.0 + 3.6 * len(metrics), 3.4), layout="constrained")
    panels = figure.subplots(1, len(metrics), squeeze=False)[0]
    for axes, metric in zip(panels, metrics, strict=True):
        for number, (name, by_metric) in enumerate(curves.items()):
            if metric not in by_metric:
                continue
            values = np.atleast_2d(np.asarray(by_metric[metric], dtype=np.float64))
            epochs = np.arange(1, values.shape[1] + 1)
            color = LINES[number % len(LINES)]
            axes.plot(epochs, values.mean(axis=0), color=color, linewidth=1.4, label=name)
            if len(values) > 1:
                low, high = values.min(axis=0), values.max(axis=0)
                axes.fill_between(epochs, low, high, color=color, alpha=0.18, linewidth=0)
        axes.set_xlabel("epoch")
        axes.set_title(metric.replace("_", " "), fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=10)
    return figure


def _weights_and_mask(weights: Values, mask: Values, k: int) -> tuple[np.ndarray, np.ndarray]:
    w, m = np.asarray(weights, dtype=np.float64), np.asarray(mask, dtype=bool)
    if w.ndim != 2 or w.shape[1] != k or m.shape != w.shape:
        raise ValueError(
            f"weights.shape={w.shape}, mask.shape={m.shape}: expected [N, {k}] for both; give the "
            "names of all channels"
        )
    return w, m


def _short(name: str) -> str:
    """A channel name that fits under an axis."""
    text = name.replace("_", " ")
    return text if len(text) <= 36 else text[:35] + "…"
