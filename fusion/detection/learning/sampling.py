"""Which anchors or proposals are objects, and mini-batches of them at a fixed size, inside jit.

Source: Ren et al. (2015), Faster R-CNN, as Ku et al. (2018) use it with overlaps on the ground.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from fusion.detection.geometry.suppression import pairwise


class Assignment(NamedTuple):
    """Of each box: is it positive, is it negative (or neither), and the label it overlaps most."""

    positive: Array
    negative: Array
    match: Array


class Sample(NamedTuple):
    """Mini-batch of fixed size: positions, which of them are positive, which are there at all."""

    indices: Array
    positive: Array
    valid: Array


def assign(
    boxes: Float[Array, "n 4"],
    mask: Bool[Array, "n"],
    truth: Float[Array, "g 4"],
    truth_mask: Bool[Array, "g"],
    limits: tuple[float, float],
) -> Assignment:
    """Positive from the second limit of overlap on, negative below the first, else neither.

    Args:
        boxes, mask: ground boxes x1, z1, x2, z2 and which are real.
        truth, truth_mask: likewise of the labels.
        limits: overlap below which a box is negative and from which it is positive (static).
    """
    overlap = jnp.where(truth_mask[None], pairwise(boxes, truth), 0.0)
    best = overlap.max(axis=1)
    return Assignment(
        positive=mask & (best >= limits[1]),
        negative=mask & (best < limits[0]),
        match=overlap.argmax(axis=1),
    )


def draw(assignment: Assignment, size: int, *, key: PRNGKeyArray) -> Sample:
    """A random mini-batch, at most half of it positive, filled up with negatives.

    Args:
        assignment: of n boxes.
        size: of the mini-batch (static); smaller when there are fewer boxes.
        key: of the draw.
    """
    n = assignment.match.shape[0]
    size = min(size, n)
    priority = jax.random.uniform(key, (n,), minval=0.01)
    of_positives = jnp.where(assignment.positive, priority, 0.0)
    least = jax.lax.top_k(of_positives, max(1, size // 2))[0][-1]
    kept = assignment.positive & (of_positives >= least)
    order = jnp.where(kept, 1.0 + priority, jnp.where(assignment.negative, priority, 0.0))
    rank, indices = jax.lax.top_k(order, size)
    return Sample(indices, rank > 1.0, rank > 0.0)
