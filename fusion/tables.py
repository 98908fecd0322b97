"""Scalar sensors by learned tables: one row of features for every value that a sensor gives.

A signal on a digital bus takes few values, and what they tell changes from one to the next. A table
has no smoothness to fight against, and a reading that is no value of the table is implausible.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

BINS = 1024
"""Rows of a table; a sensor with more values shares them among neighbours of rank."""
KNOWN = 1e-5
"""A reading farther than this from every known one is unknown; readings lie in [-1, 1]."""
FLAG = 4.0
"""The flag of an unknown reading: large beside the other features, so that a gate sees it soon."""

Rows = tuple[tuple[float, ...], ...]


def reading_ranks(x: Float[np.ndarray, "n k 1"], levels: Rows) -> tuple[tuple[float, ...], ...]:
    r"""Share of the training rows below each level, the level's own rows counted half.

    .. math:: r_{kj} = \frac{1}{N} \left(\#\{x_k < l_{kj}\} + \tfrac12 \#\{x_k = l_{kj}\}\right)

    Args:
        x: training rows of scalar sensors.
        levels: of `fusion.encoders.reading_levels`.

    Example:
        >>> x = np.array([0.0, 0.0, 0.5, 1.0], np.float32)[:, None, None]
        >>> reading_ranks(x, ((0.0, 0.5, 1.0),))
        ((0.25, 0.625, 0.875),)
    """
    ranks = []
    for k, row in enumerate(levels):
        values = np.sort(x[:, k, 0])
        below, up_to = (np.searchsorted(values, row, side=side) for side in ("left", "right"))
        ranks.append(tuple(float(r) for r in (below + up_to) / (2 * len(values))))
    return tuple(ranks)


def _padded(levels: Rows) -> np.ndarray:
    """Levels as one array; what a sensor lacks lies beyond every reading."""
    longest = max(2, *(len(row) for row in levels))
    rows = [(*row, *(np.inf,) * (longest - len(row))) for row in levels]
    return np.asarray(rows, np.float32)


def _bins(levels: Rows) -> np.ndarray:
    """The row of the table that each level reads: its own, or shared in order of rank."""
    longest = max(2, *(len(row) for row in levels))
    found = np.zeros((len(levels), longest), np.int32)
    for k, row in enumerate(levels):
        n = len(row)
        found[k, :n] = np.arange(n) if n <= BINS else np.arange(n) * BINS // n
    return found


def codes(levels: Rows, x: Float[Array, "k b"]) -> tuple[Int[Array, "k b"], Bool[Array, "k b"]]:
    """Row of the table of each reading, by the nearest known one, and which are unknown.

    Args:
        levels: sorted readings of each sensor in training.
        x: readings.

    Returns:
        (rows, True where a reading is none of the levels).

    Example:
        >>> rows, unknown = codes(((0.0, 0.5, 1.0),), jnp.array([[0.5, 0.9]]))
        >>> rows.tolist(), unknown.tolist()
        ([[1, 2]], [[False, True]])
    """
    known, bins = jnp.asarray(_padded(levels)), jnp.asarray(_bins(levels))

    def find(row: Array, bin_of: Array, values: Array) -> tuple[Array, Array]:
        right = jnp.clip(jnp.searchsorted(row, values), 1, row.shape[0] - 1)
        far, near = jnp.abs(row[right] - values), jnp.abs(row[right - 1] - values)
        index = jnp.where(far < near, right, right - 1)
        return bin_of[index], jnp.minimum(far, near) > KNOWN

    return jax.vmap(find)(known, bins, x)


def _waves(levels: Rows, ranks: Rows, width: int) -> np.ndarray:
    r"""First rows of the tables: cosines and sines of the rank, damped by octave.

    .. math:: \sqrt{12/K}\; 2^{-m/2} \left(\cos 2^m \pi r, \sin 2^m \pi r\right), \; m = 0, 1 \ldots
    """
    size = min(BINS, max(2, *(len(row) for row in levels)))
    bins = _bins(levels)
    rank = np.zeros((len(levels), size))
    for k, row in enumerate(levels):
        mine = bins[k, : len(row)]
        values = ranks[k] if ranks else np.linspace(0.0, 1.0, len(row))
        count = np.bincount(mine, minlength=size)
        rank[k] = np.bincount(mine, values, size) / np.maximum(count, 1)
    octave = np.arange(width) // 2
    angle = np.pi * rank[:, :, None] * 2.0**octave
    wave = np.where(np.arange(width) % 2 == 0, np.cos(angle), np.sin(angle))
    return (np.sqrt(12.0 / len(levels)) * wave * 2.0 ** (-octave / 2.0)).astype(np.float32)


class TableEncoder(nn.Module):
    """Encode K scalar sensors by a learned table each; the last feature flags unknown readings.

    `[branch, batch, 1] -> [branch, batch, features]`. A sensor whose reading is unknown gives its
    learned token instead of a row of the table.

    Attributes:
        levels: sorted readings of each sensor in training.
        ranks: of `reading_ranks`, for the first rows of the tables; evenly spaced when empty.
        features: width, the flag included.
        known_readings: use the flag and the token; else an unknown reading is its nearest known.
    """

    levels: Rows
    ranks: Rows
    features: int
    known_readings: bool = True

    def setup(self) -> None:
        """Tables and tokens."""
        width = self.features - 1
        first = _waves(self.levels, self.ranks, width)
        self.table = self.param("table", lambda _: jnp.asarray(first))
        self.token = self.param("token", nn.initializers.zeros, (len(self.levels), width))

    def __call__(self, x: Float[Array, "k b 1"]) -> Float[Array, "k b f"]:
        """Return one feature vector per sensor and example."""
        rows, unknown = codes(self.levels, x[:, :, 0])
        if not self.known_readings:
            unknown = jnp.zeros_like(unknown)
        found = jnp.where(unknown[:, :, None], self.token[:, None, :], self._read(rows))
        flag = FLAG * unknown.astype(found.dtype)
        return jnp.concatenate([found, flag[:, :, None]], axis=-1)

    def recall(self, rows: Int[Array, "m k"]) -> Float[Array, "k m g"]:
        """Features of remembered rows, without the flag."""
        return self._read(rows.T)

    def _read(self, rows: Int[Array, "k b"]) -> Float[Array, "k b g"]:
        return jax.vmap(lambda table, row: table[row])(self.table, rows)
