"""Sets of unequal size as arrays: padding with a mask, or rows with numbers of their examples."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from fusion.lattice.checks import refusal


def masked_mean(
    values: Float[Array, "*batch n_items n"],
    mask: Bool[Array, "*batch n_items"],
    empty: Float[Array, " n"],
) -> Float[Array, "*batch n"]:
    """Mean over the items that are there.

    Args:
        values: of each item.
        mask: True where there is an item, False where there is padding.
        empty: the result where there is none.

    Returns:
        The means.

    Example:
        >>> values = jnp.array([[[2.0], [4.0], [9.0]], [[7.0], [7.0], [7.0]]])
        >>> mask = jnp.array([[True, True, False], [False, False, False]])
        >>> masked_mean(values, mask, jnp.array([-1.0])).tolist()
        [[3.0], [-1.0]]
    """
    shown = jnp.where(mask[..., None], values, jnp.zeros_like(values))
    count = jnp.sum(mask, axis=-1, dtype=jnp.int32)[..., None]
    return _mean(jnp.sum(shown, axis=-2), count, empty)


def segment_mean(
    values: Float[Array, "n_rows n"],
    segment_ids: Int[Array, " n_rows"],
    n_examples: int,
    empty: Float[Array, " n"],
) -> Float[Array, "n_examples n"]:
    """Mean over the rows of each example.

    Args:
        values: of each row.
        segment_ids: the example of each row, in any order; rows of a number outside
            `0..n_examples - 1` are padding.
        n_examples: examples, a static number.
        empty: the result for an example without rows.

    Returns:
        The means.

    Example:
        >>> values, ids = jnp.array([[2.0], [9.0], [4.0]]), jnp.array([0, -1, 0])
        >>> segment_mean(values, ids, 2, jnp.array([-1.0])).tolist()
        [[3.0], [-1.0]]
    """
    mask = inside(segment_ids, n_examples)
    ids = jnp.where(mask, segment_ids, n_examples)
    shown = jnp.where(mask[:, None], values, jnp.zeros_like(values))
    sums = jax.ops.segment_sum(shown, ids, num_segments=n_examples + 1)[:-1]
    counts = jax.ops.segment_sum(mask.astype(jnp.int32), ids, num_segments=n_examples + 1)[:-1]
    return _mean(sums, counts[:, None], empty)


def inside(ids: Int[Array, " n_rows"], n_examples: int) -> Bool[Array, " n_rows"]:
    """Which numbers are those of an example, not of padding."""
    return (ids >= 0) & (ids < n_examples)


def _mean(sums: Array, count: Array, empty: Array) -> Array:
    means = sums / jnp.maximum(count, 1).astype(sums.dtype)
    lead = (1,) * (sums.ndim - 1)
    return jnp.where(count > 0, means, jnp.asarray(empty, sums.dtype).reshape(*lead, -1))


def padded(
    items: list[np.ndarray], n_items: int | None = None
) -> tuple[Float[Array, "n_examples n_items n_features"], Bool[Array, "n_examples n_items"]]:
    """A list of examples of unequal length as one array and its mask.

    Args:
        items: for each example an array `[any, n_features]`.
        n_items: length to pad to, which keeps shapes alike across batches; None is the longest.

    Returns:
        `(x, mask)` for `apply`, zeros in the padding.

    Raises:
        ValueError: examples of unequal width, or one longer than `n_items`.

    Example:
        >>> x, mask = padded([np.ones((2, 1)), np.zeros((0, 1))])
        >>> x.shape, mask.tolist()
        ((2, 2, 1), [[True, True], [False, False]])
    """
    shapes = [np.shape(example) for example in items]
    if not items or any(len(s) != 2 for s in shapes) or len({s[1] for s in shapes}) != 1:
        raise refusal(
            "items", shapes, "arrays [any, n_features] of one width", "write np.zeros((0, n)) for "
            "an example without items",
        )  # fmt: skip
    longest = max(shape[0] for shape in shapes)
    length = longest if n_items is None else n_items
    if length < longest:
        raise refusal("n_items", n_items, f"{longest} or more", "drop items, or raise it")
    x = np.zeros((len(items), length, shapes[0][1]), np.float32)
    mask = np.zeros((len(items), length), bool)
    for i, example in enumerate(items):
        x[i, : len(example)] = example
        mask[i, : len(example)] = True
    return jnp.asarray(x), jnp.asarray(mask)
