"""Anchors: sizes from labels by k-means, a grid on the ground, and the ones that hold points.

Source: Ku et al. (2018), AVOD, section III-C: two sizes of cars, two rotations, every 0.5 m; empty
anchors are removed with an integral image, as in Chen et al. (2015), 3DOP.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fusion.detection.geometry.bev import BevConfig, cell_index


@dataclasses.dataclass(frozen=True)
class AnchorConfig:
    """Grid and filter.

    Attributes:
        sizes: length, width, height [m] of each size, see `cluster_sizes`.
        stride: distance of the centres [m].
        occupied_height: range above ground in which points count [m].
        max_anchors: size of the result of the filter.
        fill: spare rows of the result hold anchors without points, evenly over the area, see
            `select_anchors`.
    """

    sizes: tuple[tuple[float, float, float], ...]
    stride: float = 0.5
    occupied_height: tuple[float, float] = (0.2, 2.0)
    max_anchors: int = 32_768
    fill: bool = True

    def __post_init__(self) -> None:
        """Check sizes and stride."""
        if not self.sizes or any(len(s) != 3 or min(s) <= 0 for s in self.sizes):
            raise ValueError(
                f"sizes={self.sizes}, expected at least one positive (length, width, height)"
            )
        if self.stride <= 0 or self.max_anchors < 1:
            raise ValueError(
                f"stride={self.stride}, max_anchors={self.max_anchors}: expected both above 0"
            )


class Anchors(NamedTuple):
    """Anchors that hold points, and others in the rows that are left, at a fixed size.

    Attributes:
        boxes: `[k, 6]`; rows without anchor repeat the first anchor of the grid.
        grid_index: `[k]` positions in the grid.
        mask: `[k]` the rows that hold an anchor.
        n_occupied: number of anchors of the grid that hold points; more than k means that the
            farthest ones are missing.
    """

    boxes: Array
    grid_index: Array
    mask: Array
    n_occupied: Array


def cluster_sizes(
    sizes: Float[np.ndarray, "n 3"], n_clusters: int, *, seed: int = 0
) -> Float[np.ndarray, "k 3"]:
    """Centres of box sizes by k-means (Lloyd), started by k-means++, sorted by length.

    Args:
        sizes: length, width, height [m] of labelled objects.
        n_clusters: number of sizes.
        seed: of the start.

    Raises:
        ValueError: fewer different sizes than clusters.

    Source: Lloyd (1982); Arthur, Vassilvitskii (2007).
    """
    if n_clusters < 1 or len(np.unique(sizes, axis=0)) < n_clusters:
        raise ValueError(
            f"{n_clusters} clusters of {len(np.unique(sizes, axis=0))} different sizes: expected "
            "at least one cluster and as many sizes"
        )
    rng = np.random.RandomState(seed)
    centres = sizes[rng.randint(len(sizes))][None]
    while len(centres) < n_clusters:
        distance = ((sizes[:, None] - centres[None]) ** 2).sum(axis=2).min(axis=1)
        new = sizes[rng.choice(len(sizes), p=distance / distance.sum())]
        centres = np.concatenate([centres, new[None]])
    for _ in range(300):
        nearest = ((sizes[:, None] - centres[None]) ** 2).sum(axis=2).argmin(axis=1)
        moved = np.stack(
            [
                sizes[nearest == i].mean(axis=0) if (nearest == i).any() else centres[i]
                for i in range(n_clusters)
            ]
        )
        if np.array_equal(moved, centres):
            break
        centres = moved
    return centres[np.argsort(centres[:, 0])]


def anchor_grid(
    config: AnchorConfig, bev: BevConfig, plane: Float[Array, "4"]
) -> Float[Array, "n 6"]:
    """All anchors on the ground plane, nearest row first: rows x columns x sizes x 2 rotations.

    Args:
        config: static.
        bev: the area (static).
        plane: ground plane a, b, c, d; the anchors stand on it.
    """
    half = config.stride / 2
    z = np.arange(bev.z_range[0] + half, bev.z_range[1], config.stride)
    x = np.arange(bev.x_range[0] + half, bev.x_range[1], config.stride)
    extents = np.array(
        [(a, h, b) for length, w, h in config.sizes for a, b in ((length, w), (w, length))]
    )
    zz, xx, which = (g.ravel() for g in np.meshgrid(z, x, np.arange(len(extents)), indexing="ij"))
    dtype = plane.dtype
    centre_x, centre_z = jnp.asarray(xx, dtype), jnp.asarray(zz, dtype)
    y = -(plane[0] * centre_x + plane[2] * centre_z + plane[3]) / plane[1]
    place = jnp.stack([centre_x, y, centre_z], axis=1)
    return jnp.concatenate([place, jnp.asarray(extents[which], dtype)], axis=1)


def _occupancy(
    config: AnchorConfig,
    bev: BevConfig,
    points: Float[Array, "n 3"],
    mask: Bool[Array, "n"],
    plane: Float[Array, "4"],
) -> Int[Array, "rows1 columns1"]:
    """Integral image, with a border of zeros, of the cells that hold points above ground."""
    rows, columns = bev.shape
    row, column, inside = cell_index(bev, points)
    height = points @ plane[:3] + plane[3]
    low, high = config.occupied_height
    used = mask & inside & (height > low) & (height < high)
    flat = jnp.where(used, row * columns + column, rows * columns)
    cells = jnp.zeros(rows * columns, jnp.int32).at[flat].set(1, mode="drop")
    total = jnp.cumsum(jnp.cumsum(cells.reshape(rows, columns), axis=0), axis=1)
    return jnp.pad(total, ((1, 0), (1, 0)))


def _spread(bev: BevConfig, config: AnchorConfig) -> np.ndarray:
    """Order of the places of the grid in which every beginning is spread over the whole area.

    The fractional part of an irrational combination of row and column: a lattice of rank one.
    """
    rows = len(np.arange(bev.z_range[0] + config.stride / 2, bev.z_range[1], config.stride))
    columns = len(np.arange(bev.x_range[0] + config.stride / 2, bev.x_range[1], config.stride))
    row, column = np.divmod(np.arange(rows * columns), columns)
    return np.argsort((0.7548776662 * row + 0.5698402910 * column) % 1.0, kind="stable")


def _evenly(occupied: Array, bev: BevConfig, config: AnchorConfig, size: int) -> Array:
    """Anchors without points that fill the rows which the others leave `[n]`."""
    n_kinds = 2 * len(config.sizes)
    empty = ~occupied.reshape(-1, n_kinds)  # all sizes and rotations of a place together
    order = _spread(bev, config)
    some = empty.any(axis=1)[order]
    taken = some & (jnp.cumsum(some) <= (size - occupied.sum()) // n_kinds)
    chosen = jnp.zeros(len(order), bool).at[order].set(taken)
    return (empty & chosen[:, None]).ravel()


def select_anchors(
    config: AnchorConfig,
    bev: BevConfig,
    grid: Float[Array, "n 6"],
    points: Float[Array, "p 3"],
    mask: Bool[Array, "p"],
    plane: Float[Array, "4"],
) -> Anchors:
    """The anchors of the grid over whose cells there is a point, at a fixed size, inside jit.

    A cell without points says where no car is only as long as the lidar works. The rows that are
    left over are computed all the same, so they take anchors of places without points, spread
    evenly over the area with all their sizes and rotations: where a sector or most beams are lost,
    the camera can still propose.

    Deviation: AVOD leaves these rows empty (`fill=False`).

    Args:
        config, bev: static.
        grid: `anchor_grid`.
        points, mask: camera-frame points, padded (`pad_points`).
        plane: ground plane.
    """
    rows, columns = bev.shape
    total = _occupancy(config, bev, points, mask, plane)
    x, _, z, dx, _, dz = grid.T

    def edge(metres: Array, limit: int) -> Array:
        return jnp.clip(jnp.round(metres / bev.cell), 0, limit).astype(jnp.int32)

    top, bottom = (
        edge(bev.z_range[1] - z - dz / 2, rows),
        edge(bev.z_range[1] - z + dz / 2, rows),
    )
    left, right = (
        edge(x - dx / 2 - bev.x_range[0], columns),
        edge(x + dx / 2 - bev.x_range[0], columns),
    )
    held = total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left]
    occupied = held > 0
    n_occupied = occupied.sum()
    n, k = grid.shape[0], min(config.max_anchors, grid.shape[0])
    chosen = occupied | _evenly(occupied, bev, config, k) if config.fill else occupied
    index = jnp.nonzero(chosen, size=k, fill_value=n)[0]
    found = index < n
    index = jnp.where(found, index, 0)
    return Anchors(grid[index], index, found, n_occupied)
