"""Pictures of calibrators and of slices through lattices; the only file here with matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from fusion.lattice import categorical, grid, pwl

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_calibrator", "plot_categorical", "plot_lattice_slice"]


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots()[1]


def plot_calibrator(
    params: pwl.PWLParams,
    config: pwl.PWLConfig,
    index: int = 0,
    *,
    name: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """One calibrator of a layer: its keypoints joined by lines, the missing value dashed.

    Args:
        params: of the layer, without a leading axis of seeds or networks.
        config: of the layer.
        index: which input.
        name: label of the horizontal axis; `input <index>` without it.
        ax: axes to draw on; new ones without it.

    Returns:
        The axes.
    """
    if not 0 <= index < config.n_inputs:
        raise ValueError(f"index is {index}; expected an input of 0..{config.n_inputs - 1}")
    ax = _axes(ax)
    where, outputs = (np.asarray(a[index]) for a in pwl.keypoints(params, config))
    ax.plot(where, outputs, marker="o")
    if params.missing is not None:
        ax.axhline(float(params.missing[index]), linestyle="--", color="grey", label="missing")
        ax.legend()
    ax.set_xlabel(name or f"input {index}")
    ax.set_ylabel("calibrated")
    return ax


def plot_categorical(
    params: categorical.CategoricalParams,
    config: categorical.CategoricalConfig,
    *,
    names: tuple[str, ...] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Bars of a categorical calibrator, the missing category last.

    Args:
        params: of the calibrator.
        config: of the calibrator.
        names: of the categories; their numbers without it.
        ax: axes to draw on; new ones without it.

    Returns:
        The axes.
    """
    labels = list(names or [str(i) for i in range(config.n_categories)])
    if len(labels) != config.n_categories:
        raise ValueError(f"{len(labels)} names given; expected {config.n_categories}")
    ax = _axes(ax)
    heights = np.asarray(params.outputs).tolist()
    if params.missing is not None:
        labels, heights = [*labels, "missing"], [*heights, float(params.missing)]
    ax.bar(labels, heights)
    ax.set_ylabel("calibrated")
    return ax


def plot_lattice_slice(
    params: grid.LatticeParams,
    config: grid.LatticeConfig,
    inputs: tuple[int, int] = (0, 1),
    at: tuple[float, ...] | None = None,
    *,
    resolution: int = 61,
    ax: Axes | None = None,
) -> Axes:
    """Filled contours of a lattice over two of its inputs, the others held.

    Args:
        params: of the lattice.
        config: of the lattice.
        inputs: horizontal and vertical input.
        at: where all inputs are held (the two drawn ones are ignored); the middle without it.
        resolution: points along each side.
        ax: axes to draw on; new ones without it.

    Returns:
        The axes.
    """
    across, up = inputs
    if across == up or not all(0 <= i < config.rank for i in inputs):
        raise ValueError(
            f"inputs is {inputs}; expected two different inputs of 0..{config.rank - 1}"
        )
    middle = tuple((size - 1) / 2 for size in config.sizes)
    if at is not None and len(at) != config.rank:
        raise ValueError(f"at has {len(at)} entries; expected {config.rank}")
    ax = _axes(ax)
    x = np.linspace(0, config.sizes[across] - 1, resolution)
    y = np.linspace(0, config.sizes[up] - 1, resolution)
    points = np.broadcast_to(np.asarray(at or middle), (resolution, resolution, config.rank)).copy()
    points[..., across], points[..., up] = np.meshgrid(x, y)
    z = np.asarray(grid.apply(params, config, jnp.asarray(points, params.vertices.dtype)))
    levels = 20 if np.ptp(z) > 0 else None
    drawn = ax.contourf(x, y, z, levels=levels)
    ax.figure.colorbar(drawn, ax=ax)
    ax.set_xlabel(f"input {across}")
    ax.set_ylabel(f"input {up}")
    return ax
