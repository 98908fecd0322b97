"""Non-maximum suppression at fixed sizes, inside jit.

The best candidates are sorted by score, the table of their overlaps is computed as one block, and a
loop of fixed length keeps a box unless a kept box before it overlaps too much.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from fusion.detection.geometry.overlaps import ground_iou, image_iou

_OVERLAPS: dict[str, Callable[[Array, Array], Array]] = {
    "upright": image_iou,
    "rotated": ground_iou,
}


def pairwise(
    a: Float[Array, "n d"], b: Float[Array, "m d"], overlap: str = "upright"
) -> Float[Array, "n m"]:
    """Intersection over union of every box of `a` with every box of `b`.

    Args:
        a, b: `[n, 4]` corners for `upright`, `[n, 5]` x, z, length, width, yaw for `rotated`.
        overlap: `upright` or `rotated`.

    Raises:
        ValueError: an unknown kind of overlap, or boxes of the wrong width.
    """
    width = {"upright": 4, "rotated": 5}.get(overlap)
    if width is None:
        raise ValueError(f"overlap={overlap!r}, expected 'upright' or 'rotated'")
    if a.shape[1] != width or b.shape[1] != width:
        raise ValueError(
            f"boxes have {a.shape[1]} and {b.shape[1]} columns, expected {width} for {overlap!r}"
        )
    return _OVERLAPS[overlap](a[:, None, :], b[None, :, :])


def nms(
    boxes: Float[Array, "n d"],
    scores: Float[Array, "n"],
    mask: Bool[Array, "n"],
    *,
    iou_threshold: float,
    max_output: int,
    max_candidates: int = 4096,
    overlap: str = "upright",
) -> tuple[Int[Array, "k"], Bool[Array, "k"]]:
    """The best boxes of which no two overlap by more than `iou_threshold`.

    Args:
        boxes: as in `pairwise`.
        scores: higher is better.
        mask: the boxes that are real (the others are padding).
        iou_threshold: a box is dropped when a kept better box overlaps it by more than this.
        max_output: size of the result, k.
        max_candidates: boxes that are looked at, the best ones by score.
        overlap: `upright` or `rotated`.

    Returns:
        indices `[k]` into `boxes` by falling score, and the mask of the ones that are results;
        where the mask is False the index is 0 and means nothing.

    Raises:
        ValueError: sizes below 1 or a threshold outside [0, 1].
    """
    if max_output < 1 or max_candidates < 1 or not 0 <= iou_threshold <= 1:
        raise ValueError(
            f"max_output={max_output}, max_candidates={max_candidates}, iou_threshold="
            f"{iou_threshold}: expected sizes of at least 1 and a threshold in [0, 1]"
        )
    n = min(max_candidates, boxes.shape[0])
    k = min(max_output, n)
    real = mask & ~jnp.isnan(scores)
    top, order = jax.lax.top_k(jnp.where(real, scores, -jnp.inf), n)
    chosen = boxes[order]
    close = pairwise(chosen, chosen, overlap) > iou_threshold
    later = jnp.arange(n)

    def visit(i: Array, keep: Bool[Array, "n"]) -> Bool[Array, "n"]:
        return keep & ~(keep[i] & close[i] & (later > i))

    keep = jax.lax.fori_loop(0, n, visit, real[order] & (top > -jnp.inf))
    position = jnp.nonzero(keep, size=k, fill_value=n)[0]
    found = position < n
    index = jnp.where(found, order[jnp.minimum(position, n - 1)], 0)
    short = max_output - k
    return jnp.pad(index, (0, short)), jnp.pad(found, (0, short))
