r"""Bird's-eye-view maps of a lidar scan: height slices and density.

For cell (i, j), slice s of height :math:`\Delta` and base :math:`b_s`, over the points of the cell,

.. math::
    H_{ijs} = \max_{p \in s} \frac{h_p - b_s}{\Delta}, \qquad
    D_{ij} = \min\left(1, \frac{\log(N_{ij} + 1)}{\log 16}\right),

where h is the height above the ground plane. Row 0 is the farthest row and column 0 the leftmost,
so that a map is a picture as the driver sees the road.

Source: Ku et al. (2018), AVOD, section III-A; Chen et al. (2017), MV3D.
"""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


@dataclasses.dataclass(frozen=True)
class BevConfig:
    """Area and resolution; the defaults are AVOD's 700 x 800 cells.

    Attributes:
        x_range, z_range: area in the camera frame [m].
        cell: side of a cell [m].
        height_range: of the slices above the ground plane [m].
        n_slices: height slices.
        density_points: points that saturate the density.
    """

    x_range: tuple[float, float] = (-40.0, 40.0)
    z_range: tuple[float, float] = (0.0, 70.0)
    cell: float = 0.1
    height_range: tuple[float, float] = (-0.2, 2.3)
    n_slices: int = 5
    density_points: int = 15

    def __post_init__(self) -> None:
        """Check that the cells fill the area."""
        if self.cell <= 0 or self.n_slices < 1 or self.density_points < 1:
            raise ValueError(
                f"cell={self.cell}, n_slices={self.n_slices}, density_points="
                f"{self.density_points}: expected a positive cell and counts of at least 1"
            )
        for name in ("x_range", "z_range", "height_range"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name}={(low, high)}: expected the lower bound first")
        for name in ("x_range", "z_range"):
            low, high = getattr(self, name)
            cells = (high - low) / self.cell
            if abs(cells - round(cells)) > 1e-6:
                raise ValueError(
                    f"{name}={(low, high)} holds {cells:g} cells of {self.cell} m: choose bounds "
                    "that are a whole number of cells apart"
                )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows (along z) and columns (along x)."""
        return (
            round((self.z_range[1] - self.z_range[0]) / self.cell),
            round((self.x_range[1] - self.x_range[0]) / self.cell),
        )


def pad_points(
    points: Float[np.ndarray, "n 3"], size: int
) -> tuple[Float[np.ndarray, "size 3"], Bool[np.ndarray, "size"]]:
    """Points filled up to a fixed `size` with zeros, and the mask of the real ones.

    Raises:
        ValueError: there is no point, or more than `size`.
    """
    n = len(points)
    if not 0 < n <= size:
        raise ValueError(
            f"{n} points, expected 1 to {size}: raise the size, or leave out points that lie "
            "outside the image first"
        )
    padded = np.zeros((size, 3), np.float32)
    padded[:n] = points
    return padded, np.arange(size) < n


def cell_index(
    config: BevConfig, points: Float[Array, "n 3"]
) -> tuple[Array, Array, Bool[Array, "n"]]:
    """Row and column of every point, and which points lie in the area."""
    rows, columns = config.shape
    # Subtract before scaling: float32 then puts points on cell borders where float64 does.
    row = jnp.floor((config.z_range[1] - points[:, 2]) / config.cell)
    column = jnp.floor((points[:, 0] - config.x_range[0]) / config.cell)
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    safe = jnp.where(inside, row, 0).astype(jnp.int32), jnp.where(inside, column, 0)
    return safe[0], safe[1].astype(jnp.int32), inside


def bev_maps(
    config: BevConfig,
    points: Float[Array, "n 3"],
    mask: Bool[Array, "n"],
    plane: Float[Array, "4"],
) -> Float[Array, "rows columns channels"]:
    """Height maps and density of one scan, inside jit; `vmap` it for a batch.

    Args:
        config: static.
        points: camera-frame points [m], padded to a fixed number (`pad_points`).
        mask: the points that are real. Points with NaN are left out as well.
        plane: ground plane a, b, c, d.

    Returns:
        `[rows, columns, n_slices + 1]` in [0, 1]; the last channel is the density.
    """
    rows, columns = config.shape
    low, high = config.height_range
    row, column, inside = cell_index(config, points)
    height = points @ plane[:3] + plane[3]
    level = (height - low) * (config.n_slices / (high - low))
    used = mask & inside & (level >= 0) & (level < config.n_slices)
    level = jnp.where(used, level, 0.0)
    slot = jnp.floor(level).astype(jnp.int32)
    flat = row * columns + column
    n_cells = rows * columns
    # Points that are not used point behind the last cell and are dropped by the scatter.
    heights = (
        jnp.zeros(n_cells * config.n_slices)
        .at[jnp.where(used, flat * config.n_slices + slot, n_cells * config.n_slices)]
        .max(level - slot.astype(level.dtype), mode="drop")
    )
    counts = jnp.zeros(n_cells).at[jnp.where(used, flat, n_cells)].add(1.0, mode="drop")
    density = jnp.minimum(1.0, jnp.log1p(counts) / math.log(config.density_points + 1))
    maps = jnp.concatenate([heights.reshape(n_cells, config.n_slices), density[:, None]], axis=1)
    return maps.reshape(rows, columns, config.n_slices + 1)


def ground_to_unit(config: BevConfig, boxes: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    """Ground boxes x1, z1, x2, z2 [m] as y1, x1, y2, x2 in units of the whole map.

    0 is the centre of the first row or column and 1 that of the last, as `crop_and_resize` reads
    boxes.
    """
    rows, columns = config.shape
    size = jnp.array([rows, columns, rows, columns], boxes.dtype)
    cells = jnp.stack(
        [
            config.z_range[1] - boxes[:, 3],
            boxes[:, 0] - config.x_range[0],
            config.z_range[1] - boxes[:, 1],
            boxes[:, 2] - config.x_range[0],
        ],
        axis=1,
    )
    return (cells / config.cell - 0.5) / (size[None] - 1.0)
