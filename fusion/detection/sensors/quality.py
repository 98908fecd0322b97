r"""Plain statistics of the raw readings, from which a gate can tell that a sensor fails.

Feature maps after normalization no longer hold what a failure changes most: level, contrast, the
number of points. These are some sixty numbers of the picture and of the map, all of the order of 1:
means and deviations, gradients and roughness, a histogram and its entropy, contrast of blocks;
occupied cells by bearing and by depth, isolated ones, mean height and density. A few lost beams or
degrees of the view hardly change any of these; they leave gaps in what is seen of the ground from
ring to ring and of the scene from bearing to bearing.

Source: statistics of natural scenes as measures of quality, Mittal, Moorthy, Bovik (2012); which of
them is our choice.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fusion.detection.geometry.bev import BevConfig

_LEVELS = np.linspace(-0.4, 0.6, 9, dtype=np.float32)  # of grey, mean colour subtracted
_BLOCKS = 8  # rows and columns of blocks
_SECTORS, _BANDS = 8, 6
_BEARINGS, _VIEW = 16, np.radians(38.0)  # parts of the view, its half
_RINGS, _HEIGHT = 30, 1.73  # parts of the ground by the angle under which it lies; of the lidar [m]
_NEAREST, _DEPTH = 4.0, 5.0  # [m] where the rings begin, how many times as far they end
_GAPS = 7
N_IMAGE = 3 + 3 + 6 + len(_LEVELS) + 1 + 4
N_SCAN = _SECTORS + _BANDS + 8 + 2 * _GAPS


def _log(x: Array) -> Array:
    """Logarithm of a share or variance, scaled to the order of 1."""
    return 0.3 * (jnp.log(x + 1e-5) + 4.0)


def _rough(bend: Array, slope: Array) -> Array:
    """Logarithm of mean curvature over mean slope, scaled as the others are."""
    ratio = (bend.mean(axis=(1, 2)) + 1e-5) / (slope.mean(axis=(1, 2)) + 1e-5)
    return 5.0 * (jnp.log(ratio) - 0.5)


def _spread(x: Array) -> Array:
    """Mean, deviation, least and largest of the last axis."""
    deviation = jnp.sqrt(x.var(axis=-1) + 1e-8)
    return jnp.stack([x.mean(axis=-1), deviation, x.min(axis=-1), x.max(axis=-1)], axis=-1)


def image_statistics(image: Float[Array, "b h w 3"]) -> Float[Array, "b n"]:
    """`N_IMAGE` statistics of pictures, mean colour subtracted."""
    b, height, width, _ = image.shape
    grey = image.mean(axis=-1)
    along, down = jnp.abs(jnp.diff(grey, axis=2)), jnp.abs(jnp.diff(grey, axis=1))
    bend = jnp.abs(jnp.diff(grey, 2, axis=2))
    flat = (along < 1e-3).astype(grey.dtype)  # nothing changes from pixel to pixel
    gradients = [_log(x.mean(axis=(1, 2))) for x in (along, down, bend, flat)]
    # How rough the grey levels are for their slope hardly depends on the scene: blur lowers it.
    bends = bend, jnp.abs(jnp.diff(grey, 2, axis=1))
    gradients += [_rough(b, slope) for b, slope in zip(bends, (along, down), strict=True)]
    level = grey.reshape(b, 1, -1) - jnp.asarray(_LEVELS)[None, :, None]
    histogram = jnp.exp(-0.5 * (level / 0.08) ** 2).mean(axis=-1)
    share = histogram / (histogram.sum(axis=-1, keepdims=True) + 1e-6)
    entropy = -(share * jnp.log(share + 1e-6)).sum(axis=-1, keepdims=True)
    rows, columns = height // _BLOCKS, max(1, width // _BLOCKS)
    blocks = grey[:, : _BLOCKS * rows, : _BLOCKS * columns]
    blocks = blocks.reshape(b, _BLOCKS, rows, _BLOCKS, columns)
    contrast = _log(blocks.var(axis=(2, 4)).reshape(b, -1))
    colour = image.reshape(b, -1, 3)
    return jnp.concatenate(
        [
            3.0 * colour.mean(axis=1),
            5.0 * jnp.sqrt(colour.var(axis=1) + 1e-8),
            jnp.stack(gradients, axis=-1),
            3.0 * histogram,
            entropy,
            _spread(contrast),
        ],
        axis=-1,
    )


class _Part(NamedTuple):
    """Which part every cell of a map belongs to.

    Attributes:
        of_cell: `[cells]`, `n` for those of none.
        n: number of parts that hold cells.
    """

    of_cell: np.ndarray
    n: int


def _cut(values: np.ndarray, edges: np.ndarray) -> _Part:
    """Cells between consecutive edges are a part; one without cells is none."""
    part = np.searchsorted(edges, values.ravel(), side="right") - 1
    inside = (part >= 0) & (part < len(edges) - 1)
    held, index = np.unique(part[inside], return_inverse=True)
    of_all = np.full(part.shape, len(held))
    of_all[inside] = index
    return _Part(of_all, len(held))


class _Parts(NamedTuple):
    """Cells by bearing, alike in number, and by depth; by bearing, alike in width, and by ring."""

    sectors: _Part
    bands: _Part
    bearings: _Part
    rings: _Part


def _parts(config: BevConfig) -> _Parts:
    rows, columns = config.shape
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    z = config.z_range[1] - (row + 0.5) * config.cell
    x = config.x_range[0] + (column + 0.5) * config.cell
    bearing = np.arctan2(x, np.maximum(z, 1e-3))
    within = np.quantile(bearing, np.linspace(0, 1, _SECTORS + 1)[1:-1])
    near = max(_NEAREST, config.z_range[0])
    low, high = (np.arctan2(_HEIGHT, end) for end in (_DEPTH * near, near))
    return _Parts(
        _Part(np.searchsorted(within, bearing.ravel()), _SECTORS),
        _Part(row.ravel() * _BANDS // rows, _BANDS),
        _cut(bearing, np.linspace(-_VIEW, _VIEW, _BEARINGS + 1)),
        _cut(np.arctan2(_HEIGHT, np.hypot(x, z)), np.linspace(low, high, _RINGS + 1)),
    )


def _count(cells: Float[Array, "b c"], part: _Part) -> Float[Array, "b p"]:
    """Sum over the cells of each part."""
    sums = jax.ops.segment_sum(cells.T, jnp.asarray(part.of_cell), part.n + 1)
    return sums[:-1].T


def _gaps(profile: Float[Array, "b p"]) -> Float[Array, "b g"]:
    """How low and how uneven a profile is: what is lost in between its parts."""
    if profile.shape[1] < 3:  # a map too coarse to show any
        return jnp.zeros((profile.shape[0], _GAPS), profile.dtype)
    step, bend = (jnp.abs(jnp.diff(profile, n, axis=1)) for n in (1, 2))
    spread = jnp.sqrt(profile.var(axis=1) + 1e-8)
    lowest = jnp.sort(profile, axis=1)[:, :3]
    values = [lowest[:, 0], lowest.mean(axis=1), spread]
    values += [step.mean(axis=1), bend.mean(axis=1), step.max(axis=1), bend.max(axis=1)]
    return jnp.stack(values, axis=1)


def scan_statistics(config: BevConfig, bev: Float[Array, "b r c s"]) -> Float[Array, "b n"]:
    """`N_SCAN` statistics of bird's-eye maps, whose last channel is the density."""
    b = bev.shape[0]
    occupied = (bev[..., -1] > 0).astype(bev.dtype)
    cells = occupied.reshape(b, -1)
    parts = _parts(config)
    sectors, bands, bearings = (jnp.log1p(_count(cells, part)) / 5.0 for part in parts[:3])
    ground = (bev[..., 0] > 0).astype(bev.dtype).reshape(b, -1)
    size = np.bincount(parts.rings.of_cell, minlength=parts.rings.n + 1)[:-1]
    rings = _count(ground, parts.rings) / jnp.asarray(size, bev.dtype)[None]
    total = occupied.sum(axis=(1, 2))
    around = jax.lax.reduce_window(occupied, 0.0, jax.lax.add, (1, 3, 3), (1, 1, 1), "SAME")
    around = around - occupied
    whole = total + 1.0
    alone = jnp.where(around == 0, occupied, 0.0).sum(axis=(1, 2))
    filled = (bev[..., :-1] > 0).astype(bev.dtype).sum(axis=-1)
    of_all = jnp.stack(
        [
            jnp.log1p(total) / 7.0,
            # A few per cent in any scene, and five times as many where ranges are noisy.
            0.5 * (jnp.log(alone / whole + 0.003) + 4.0),
            (occupied * around).sum(axis=(1, 2)) / whole / 4.0,
            bev[..., -1].sum(axis=(1, 2)) / whole,
            (filled * occupied).sum(axis=(1, 2)) / whole,
            jnp.sqrt(sectors.var(axis=-1) + 1e-8),
            sectors.min(axis=-1),
            jnp.sqrt(bands.var(axis=-1) + 1e-8),
        ],
        axis=-1,
    )
    return jnp.concatenate([sectors, bands, of_all, _gaps(bearings), _gaps(rings)], axis=-1)


def quality_statistics(
    config: BevConfig, image: Float[Array, "b h w 3"], bev: Float[Array, "b r c s"]
) -> tuple[Float[Array, "b n"], Float[Array, "b m"]]:
    """Statistics of camera and lidar; without gradient."""
    both = image_statistics(image), scan_statistics(config, bev)
    return jax.lax.stop_gradient(both)
