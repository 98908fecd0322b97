"""Pictures of calibrators and of slices through lattices; the only file here with matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from fusion.lattice import categorical, lattice_layer, pwl
from fusion.lattice.checks import refusal
from fusion.lattice.lattice_config import LatticeConfig, LatticeParams

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots()[1]


def _figure(ax: Axes) -> Figure:
    figure = ax.get_figure(root=True)
    assert figure is not None  # a parent is lost only by removing the axes
    return figure


def plot_calibrator(
    config: pwl.PWLConfig,
    params: pwl.PWLParams,
    index: int = 0,
    *,
    name: str | None = None,
    ax: Axes | None = None,
) -> Figure:
    """One calibrator of a layer: its keypoints joined by lines, the missing value dashed.

    Args:
        config: of the layer.
        params: of the layer, without a leading axis of seeds or networks.
        index: which input.
        name: label of the horizontal axis; `input <index>` without it.
        ax: axes to draw on; those of a new figure without it.

    Returns:
        The figure that holds the axes; saving it is the caller's.
    """
    if not 0 <= index < config.n_inputs:
        raise refusal("index", index, f"an input of 0..{config.n_inputs - 1}", "count from 0")
    ax = _axes(ax)
    where, outputs = (np.asarray(a[index]) for a in pwl.keypoints(config, params))
    ax.plot(where, outputs, marker="o")
    if params.missing is not None:
        ax.axhline(float(params.missing[index]), linestyle="--", color="grey", label="missing")
        ax.legend()
    ax.set_xlabel(name or f"input {index}")
    ax.set_ylabel("calibrated")
    return _figure(ax)


def plot_categorical(
    config: categorical.CategoricalConfig,
    params: categorical.CategoricalParams,
    *,
    names: tuple[str, ...] | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Bars of a categorical calibrator, the missing category last.

    Args:
        config: of the calibrator.
        params: of the calibrator.
        names: of the categories; their numbers without it.
        ax: axes to draw on; those of a new figure without it.

    Returns:
        The figure that holds the axes; saving it is the caller's.
    """
    labels = list(names or [str(i) for i in range(config.n_categories)])
    if len(labels) != config.n_categories:
        raise refusal("names", names, f"{config.n_categories} names", "name each category")
    ax = _axes(ax)
    heights = np.asarray(params.outputs).tolist()
    if params.missing is not None:
        labels, heights = [*labels, "missing"], [*heights, float(params.missing)]
    ax.bar(labels, heights)
    ax.set_ylabel("calibrated")
    return _figure(ax)


def plot_lattice_slice(
    config: LatticeConfig,
    params: LatticeParams,
    inputs: tuple[int, int] = (0, 1),
    at: tuple[float, ...] | None = None,
    *,
    resolution: int = 61,
    ax: Axes | None = None,
) -> Figure:
    """Filled contours of a lattice over two of its inputs, the others held.

    Args:
        config: of the lattice.
        params: of the lattice.
        inputs: horizontal and vertical input.
        at: where all inputs are held (the two drawn ones are ignored); the middle without it.
        resolution: points along each side.
        ax: axes to draw on; those of a new figure without it.

    Returns:
        The figure that holds the axes; saving it is the caller's.
    """
    across, up = inputs
    if across == up or not all(0 <= i < config.rank for i in inputs):
        raise refusal(
            "inputs", inputs, f"two different inputs of 0..{config.rank - 1}", "count from 0"
        )
    middle = tuple((size - 1) / 2 for size in config.sizes)
    if at is not None and len(at) != config.rank:
        raise refusal("at", at, f"{config.rank} numbers", "hold every input somewhere")
    ax = _axes(ax)
    x = np.linspace(0, config.sizes[across] - 1, resolution)
    y = np.linspace(0, config.sizes[up] - 1, resolution)
    points = np.broadcast_to(np.asarray(at or middle), (resolution, resolution, config.rank)).copy()
    points[..., across], points[..., up] = np.meshgrid(x, y)
    z = np.asarray(lattice_layer.apply(config, params, jnp.asarray(points, params.vertices.dtype)))
    levels = 20 if np.ptp(z) > 0 else None
    drawn = ax.contourf(x, y, z, levels=levels)
    ax.figure.colorbar(drawn, ax=ax)
    ax.set_xlabel(f"input {across}")
    ax.set_ylabel(f"input {up}")
    return _figure(ax)
