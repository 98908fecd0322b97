r"""Cars of another frame pasted into a frame: their points, their pixels, their labels.

A car keeps its place, its distance and so its look; its height follows the ground that it comes to
stand on. It is pasted where it touches no other box on the ground and hides no more than a tenth of
one in the picture (and none hides more of it). What it covers goes: points in its box and points
behind it, seen in its rectangle of the picture. A point p of the scan stays unless

.. math:: p \in B \quad \text{or} \quad \big( P_2 p \in R(B), \; z_p > z_B \big).

Left as it is: the rectangle holds some of the other frame's background, and what stands in front of
the car in this frame does not hide it.

Source: Yan, Mao, Li (2018), SECOND, section 3.3 (points); Wang et al. (2021), PointAugmenting,
section 3.3 (pixels with them).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from fusion.detection.geometry.encodings import box_corners, ground_box, project_boxes
from fusion.detection.geometry.inside import points_in_boxes
from fusion.detection.geometry.overlaps import image_iou, rotated_intersection
from fusion.detection.geometry.planes import plane_y
from fusion.detection.learning.examples import Example, camera_frame

_MARGIN = 0.2  # around a box within which a point belongs to its car [m]
_APART = 0.3  # least distance between pasted and other boxes, each side [m]
_HIDDEN = 0.1  # share of a box's rectangle that another one may cover


def _rectangles(example: Example, boxes: Array) -> Array:
    """y1, x1, y2, x2 in units of the picture, cut to it."""
    height, width = jnp.asarray(example.image_size)
    seen = project_boxes(box_corners(boxes), jnp.asarray(example.p2), height, width)
    return jnp.clip(seen, 0.0, 1.0)


def _cover(a: Array, b: Array) -> Array:
    """`[n, m]` larger share of either rectangle that the other one covers."""
    one, two = a[:, None], b[None]
    return jnp.maximum(image_iou(one, two, over="first"), image_iou(two, one, over="first"))


def _free(
    boxes: Array, wanted: Array, seen: Array, others: Array, there: Array, others_seen: Array
) -> Bool[Array, "g"]:
    """Which boxes have room beside the boxes that are there."""
    wide = ground_box(boxes).at[:, 2:4].add(2.0 * _APART)
    touch = rotated_intersection(wide[:, None], ground_box(others)[None]) > 0.0
    hide = _cover(seen, others_seen) > _HIDDEN
    return wanted & ~((touch | hide) & there[None]).any(axis=1)


def paste_objects(
    example: Example, other: Example, share: float | Float[Array, ""], *, key: PRNGKeyArray
) -> Example:
    """A frame with objects of another one, inside jit.

    Args:
        example: the frame.
        other: of the same sizes and the same picture's size up to a few pixels.
        share: of the other frame's objects that are pasted where there is room.
        key: of the draw.

    Returns:
        The frame with at most as many objects and points as it has rows: nearest boxes of the other
        frame last, points of the pasted objects first.
    """
    boxes = jnp.asarray(other.truth)
    grounds = (plane_y(jnp.asarray(e.plane), boxes[:, 0], boxes[:, 2]) for e in (example, other))
    shift = next(grounds) - next(grounds)
    landed = boxes.at[:, 1].add(shift)
    truth = jnp.asarray(example.truth)
    there = truth[:, 3] > 0.0
    seen, others_seen = _rectangles(other, boxes), _rectangles(example, truth)
    drawn = jax.random.uniform(key, (boxes.shape[0],)) < share
    room = (~there).sum()
    pasted = _free(landed, jnp.asarray(other.truth_mask) & drawn, seen, truth, there, others_seen)
    pasted = pasted & (jnp.cumsum(pasted) <= room)
    image = _paste_pixels(example.image, other.image, jnp.where(pasted[:, None], seen, -1.0))
    points, mask = _paste_points(example, other, boxes, landed, pasted, shift)
    rows = jnp.argsort(~jnp.concatenate([there, pasted]), stable=True)[: truth.shape[0]]
    all_boxes = jnp.concatenate([truth, jnp.where(pasted[:, None], landed, 0.0)])[rows]
    ignored = jnp.concatenate([jnp.asarray(example.ignored), jnp.zeros_like(pasted)])[rows]
    return example._replace(
        image=image, points=points, point_mask=mask, truth=all_boxes,
        truth_mask=(all_boxes[:, 3] > 0.0) & ~ignored, ignored=ignored,
    )  # fmt: skip


def _paste_pixels(image: Any, other: Any, rectangles: Float[Array, "g 4"]) -> Array:
    """The other picture in the rectangles, which are in units of the picture; -1 for none."""
    image, other = jnp.asarray(image), jnp.asarray(other)
    rows, columns = (jnp.linspace(0.0, 1.0, n)[None] for n in image.shape[:2])
    y1, x1, y2, x2 = (rectangles[:, i, None] for i in range(4))
    high, wide = (rows >= y1) & (rows <= y2), (columns >= x1) & (columns <= x2)
    inside = high[:, :, None] & wide[:, None]
    return jnp.where(inside.any(axis=0)[..., None], other, image)


def _paste_points(
    example: Example, other: Example, boxes: Array, landed: Array, pasted: Array, shift: Array
) -> tuple[Float[Array, "p 4"], Bool[Array, "p"]]:
    """The scan without what the pasted objects cover, and their own points before it."""
    camera = camera_frame(example.points, example.to_camera)
    kept = jnp.asarray(example.point_mask)
    in_box = points_in_boxes(camera, landed, margin=_MARGIN)
    p2, size = jnp.asarray(example.p2), jnp.asarray(example.image_size)
    pixel = camera @ p2[:, :3].T + p2[:, 3][None]
    unit = pixel[:, 1::-1] / jnp.maximum(pixel[:, 2:], 0.1) / (size[None] - 1.0)
    rectangles = _rectangles(example, landed)
    behind = (unit[:, None] >= rectangles[None, :, :2]) & (unit[:, None] <= rectangles[None, :, 2:])
    behind = behind.all(axis=-1) & (camera[:, 2:] > landed[None, :, 2])
    kept = kept & ~((in_box | behind) & pasted[None]).any(axis=1)

    theirs = camera_frame(other.points, other.to_camera)
    own = points_in_boxes(theirs, boxes, margin=_MARGIN) & pasted[None]
    moved = theirs.at[:, 1].add(jnp.where(own, shift[None], 0.0).sum(axis=1))
    to_camera = jnp.asarray(example.to_camera)
    # Lidar to camera is a rotation and a shift.
    back = (moved - to_camera[:, 3][None]) @ to_camera[:, :3]
    new = jnp.concatenate([back, jnp.asarray(other.points)[:, 3:]], axis=1)
    taken = own.any(axis=1) & jnp.asarray(other.point_mask)
    mask = jnp.concatenate([taken, kept])
    rows = jnp.argsort(~mask, stable=True)[: kept.shape[0]]
    points = jnp.concatenate([new, jnp.asarray(example.points)])[rows]
    return jnp.where(mask[rows][:, None], points, 0.0), mask[rows]
