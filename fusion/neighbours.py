"""A head that remembers: classes of the training rows that lie near in the sensors that count.

Source: Goldberger et al. (2004), Neighbourhood components analysis, for learning from leave-one-out
soft neighbours; the fusion weights inside the distance are ours.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from fusion.tables import codes

EPSILON = 1e-3
"""Probability that every class keeps, so that its logarithm is bounded."""
EXAMPLES, ROWS = 512, 1024
"""Examples and rows in memory that are compared at once: a tile that a core's cache holds."""


class Memory(NamedTuple):
    """Clean training rows: rows of the tables `[m, sensor]` and classes `[m]`."""

    rows: Int[Array, "m k"]
    labels: Int[Array, " m"]


def remember(
    levels: tuple[tuple[float, ...], ...], x: Float[Array, "m k 1"], y: Int[Array, " m"]
) -> Memory:
    """The memory of clean training rows.

    Args:
        levels: `EncoderConfig.levels`.
        x: clean rows scaled to [-1, 1]; y: their classes.
    """
    rows, _ = codes(levels, jnp.asarray(x)[:, :, 0].T)
    return Memory(rows.T, jnp.asarray(y, jnp.int32))


def neighbour_probabilities(
    features: Float[Array, "k b g"],
    weights: Float[Array, "b k"],
    remembered: Float[Array, "k m g"],
    labels: Int[Array, " m"],
    n_classes: int,
    sharpness: Float[Array, ""],
    *,
    excluded: Bool[Array, "b m"] | None = None,
) -> Float[Array, "b c"]:
    r"""Share of each class among the soft neighbours of each example.

    .. math::
        d(x, x') = \sum_k K w_k(x)\, \lVert e_k(x_k) - e_k(x'_k) \rVert^2, \qquad
        p(c \mid x) \propto \sum_{i:\, y_i = c} e^{-s\, d(x, x_i)}

    A sensor of weight zero has no influence at all.

    Args:
        features: :math:`e_k(x_k)`.
        weights: fusion weights :math:`w_k`.
        remembered: features of the rows in memory.
        labels: their classes.
        n_classes: static.
        sharpness: s, > 0.
        excluded: rows that an example may not see, such as itself in training.

    Returns:
        Probabilities; rows sum to one.
    """
    k, b, g = features.shape
    m = remembered.shape[1]
    gain = k * weights
    # -s d without the part that is the same for all rows in memory.
    query = jnp.concatenate(
        [
            2.0 * jnp.transpose(features * gain.T[:, :, None], (1, 0, 2)).reshape(b, k * g),
            -gain,
        ],
        axis=1,
    )
    known = jnp.concatenate(
        [
            jnp.transpose(remembered, (1, 0, 2)).reshape(m, k * g),
            jnp.sum(remembered**2, axis=-1).T,
        ],
        axis=1,
    )
    classes = jax.nn.one_hot(labels, n_classes, dtype=features.dtype)
    if excluded is None:
        return _tiled_shares(sharpness * query, known, classes)
    score = jnp.where(excluded, jnp.finfo(features.dtype).min, sharpness * (query @ known.T))
    top = jax.lax.stop_gradient(jnp.max(score, axis=-1, keepdims=True))
    found = jnp.exp(score - top) @ classes
    return found / jnp.sum(found, axis=-1, keepdims=True)


def _tiled_shares(
    query: Float[Array, "b f"], known: Float[Array, "m f"], classes: Float[Array, "m c"]
) -> Float[Array, "b c"]:
    """`softmax(query @ known.T) @ classes`, in tiles: the sums move to each new largest score.

    Source: Milakov and Gimelshein (2018), Online normalizer calculation for softmax.
    """
    (b, _), (m, c) = query.shape, classes.shape
    examples, rows = min(EXAMPLES, b), min(ROWS, m)
    # Rows that fill up the last tile repeat a true one, so no largest score changes, and count for
    # no class.
    known = jnp.pad(known, ((0, -m % rows), (0, 0)), mode="edge").reshape(-1, rows, known.shape[1])
    classes = jnp.pad(classes, ((0, -m % rows), (0, 0))).reshape(-1, rows, c)
    tiles = jnp.pad(query, ((0, -b % examples), (0, 0))).reshape(-1, examples, query.shape[1])

    def shares(query: Array) -> Array:
        def add(held: tuple[Array, Array], tile: tuple[Array, Array]) -> Any:
            top, found = held
            known, classes = tile
            score = query @ known.T
            largest = jax.lax.stop_gradient(jnp.max(score, axis=-1, keepdims=True))
            new = jnp.maximum(top, largest)
            return (new, found * jnp.exp(top - new) + jnp.exp(score - new) @ classes), None

        lowest = jnp.full((examples, 1), jnp.finfo(query.dtype).min)
        start = lowest, jnp.zeros((examples, c), query.dtype)
        (_, found), _ = jax.lax.scan(add, start, (known, classes))
        return found / jnp.sum(found, axis=-1, keepdims=True)

    return jax.lax.map(shares, tiles).reshape(-1, c)[:b]


def read_memory(main: dict[str, Any]) -> tuple[dict[str, Any], Memory | None]:
    """Parameters without the memory, and the memory where there is one."""
    if "memory" not in main:
        return main, None
    rest = {name: value for name, value in main.items() if name != "memory"}
    return rest, Memory(main["memory"]["rows"], main["memory"]["labels"])


def recall(
    size: int, memory: dict[str, Array], *, key: Key[Array, ""]
) -> tuple[dict[str, Any], Int[Array, " m"]]:
    """The part of the memory that a training step compares with, and the numbers of its rows.

    The memory is shuffled (`fusion.train.init_state`), so a block at a random place is a random
    part of it.
    """
    n = memory["labels"].shape[0]
    start = jax.random.randint(key, (), 0, n)
    index = (start + jnp.arange(min(size, n))) % n
    seen = {"rows": memory["rows"][index], "labels": memory["labels"][index]}
    return {"memory": seen}, memory["number"][index]
