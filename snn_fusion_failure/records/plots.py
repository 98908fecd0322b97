"""Moving pictures of a running network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from matplotlib.animation import FuncAnimation
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fusion.plots import CLEAN, FAILED


def plot_stream(
    weights: Float[ArrayLike, "n k"],
    risks: Float[ArrayLike, "n k"],
    channels: Sequence[str],
    *,
    frames: int = 60,
) -> FuncAnimation:
    """Draw fusion weights and failure probabilities of a stream as bars that move.

    Args:
        weights, risks: one row a sample, from `fusion.streaming.SensorStream`.
        channels: names of the sensors.
        frames: pictures that the samples are thinned to.

    Returns:
        The animation, unsaved.
    """
    w, r = np.asarray(weights), np.asarray(risks)
    picked = np.unique(np.linspace(0, len(w) - 1, min(frames, len(w))).astype(int))
    figure = Figure(figsize=(7.0, 1.2 + 0.3 * len(channels)), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharey=True)
    rows = np.arange(len(channels))
    bars = [
        axes.barh(rows, values[0], color=color)
        for axes, values, color in ((left, w, CLEAN), (right, r, FAILED))
    ]
    left.set_yticks(rows, list(channels))
    left.invert_yaxis()
    left.set_xlim(0.0, max(0.5, float(w.max())))
    right.set_xlim(0.0, 1.0)
    left.set_xlabel("fusion weight")
    right.set_xlabel("probability of failure")

    def turn(sample: int) -> list[Any]:
        for group, values in zip(bars, (w, r), strict=True):
            for bar, value in zip(group, values[sample], strict=True):
                bar.set_width(float(value))
        figure.suptitle(f"window {sample}")
        return [bar for group in bars for bar in group]

    return FuncAnimation(figure, turn, frames=[int(p) for p in picked], blit=False)
