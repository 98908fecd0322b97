r"""Overlap of boxes: upright in the image, rotated on the ground, and in 3D.

The intersection of two rotated rectangles is a closed form without vertex lists. In the frame of
the second one, B, it is the upright rectangle :math:`|x| \le h_x, |y| \le h_y`, and the theorem of
Green turns the area shared with the first, A, into an integral along the four edges of A,

.. math::
    |A \cap B| = \oint_{\partial A} \mathrm{clip}(x, -h_x, h_x) \; 1[|y| < h_y] \; dy ,

because the integrand's derivative in x is the indicator of B. Each edge is a straight line, so its
integral is the length in y of the part between the two bounds times the mean of the clipped x.
Nothing branches on which vertex lies where, so identical and touching boxes need no tolerance, and
the same lines run in numpy (float64, the evaluator) and inside jit (float32), with a gradient.

All functions are elementwise over leading axes that broadcast: give `[n, 1, 5]` and `[1, m, 5]` for
all pairs.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

Box2D = Float[Any, "*#batch 4"]
GroundBox = Float[Any, "*#batch 5"]
Box3D = Float[Any, "*#batch 7"]


def _namespace(x: Any) -> Any:
    return np if isinstance(x, np.ndarray) else jnp


def _ratio(xp: Any, top: Any, bottom: Any) -> Any:
    """top / bottom, and 0 where bottom is 0 (boxes without area overlap nothing)."""
    zero = bottom == 0
    return xp.where(zero, 0.0, top / xp.where(zero, 1.0, bottom))


def image_iou(a: Box2D, b: Box2D, *, over: str = "union") -> Float[Any, "..."]:
    """Overlap of upright boxes `[..., 4]` given as left, top, right, bottom.

    Args:
        a, b: boxes; leading axes broadcast.
        over: `union` for intersection over union; `first` for intersection over the area of `a`
            (how KITTI measures cover by a DontCare region).

    Raises:
        ValueError: `over` is neither.

    Example:
        >>> float(image_iou(np.array([0.0, 0, 2, 2]), np.array([1.0, 0, 3, 2])))
        0.3333333333333333
    """
    if over not in ("union", "first"):
        raise ValueError(f"over={over!r}, expected 'union' or 'first'")
    xp = _namespace(a)
    width = xp.minimum(a[..., 2], b[..., 2]) - xp.maximum(a[..., 0], b[..., 0])
    height = xp.minimum(a[..., 3], b[..., 3]) - xp.maximum(a[..., 1], b[..., 1])
    inter = xp.maximum(width, 0.0) * xp.maximum(height, 0.0)
    area_a = (a[..., 2] - a[..., 0]) * (a[..., 3] - a[..., 1])
    if over == "first":
        return _ratio(xp, inter, area_a)
    area_b = (b[..., 2] - b[..., 0]) * (b[..., 3] - b[..., 1])
    return _ratio(xp, inter, area_a + area_b - inter)


def _edge(xp: Any, x0: Any, y0: Any, x1: Any, y1: Any, hx: Any, hy: Any) -> Any:
    """Integral of clip(x, -hx, hx) dy along the part of the edge with |y| < hy."""
    ya, yb = xp.clip(y0, -hy, hy), xp.clip(y1, -hy, hy)
    slope = _ratio(xp, x1 - x0, y1 - y0)  # where y1 == y0, yb - ya is 0 as well
    xa, xb = x0 + (ya - y0) * slope, x1 - (y1 - yb) * slope
    dx = xb - xa
    low = xp.minimum(xb, -hx) - xp.minimum(xa, -hx)
    high = xp.maximum(xb, hx) - xp.maximum(xa, hx)
    ca, cb = xp.clip(xa, -hx, hx), xp.clip(xb, -hx, hx)
    middle = 0.5 * (ca + cb)
    mean = _ratio(xp, (cb - ca) * middle - low * hx + high * hx, dx)
    return (yb - ya) * xp.where(dx == 0, middle, mean)


def rotated_intersection(a: GroundBox, b: GroundBox) -> Float[Any, "..."]:
    """Area shared by rotated rectangles `[..., 5]`: x, z, length, width, rotation_y.

    Length lies along the heading (x at rotation 0) and rotation_y turns from +x towards -z, as in
    KITTI's camera frame. Signs of length and width do not matter.

    Returns:
        Area [m^2] over the broadcast leading axes.
    """
    xp = _namespace(a)
    cos_b, sin_b = xp.cos(b[..., 4]), xp.sin(b[..., 4])
    turn = a[..., 4] - b[..., 4]
    cos, sin = xp.cos(turn), xp.sin(turn)
    dx, dz = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
    x, z = cos_b * dx - sin_b * dz, sin_b * dx + cos_b * dz
    half_l, half_w = 0.5 * xp.abs(a[..., 2]), 0.5 * xp.abs(a[..., 3])
    hx, hy = 0.5 * xp.abs(b[..., 2]), 0.5 * xp.abs(b[..., 3])
    # Half axes of a in the frame of b; the corners are their four signed sums.
    lx, lz, wx, wz = cos * half_l, -sin * half_l, sin * half_w, cos * half_w
    corners = [
        (x + s * lx + t * wx, z + s * lz + t * wz)
        for s, t in ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
    ]
    edges = zip(corners, corners[1:] + corners[:1], strict=True)
    area = sum(_edge(xp, *p, *q, hx, hy) for p, q in edges)
    return xp.maximum(area, 0.0)


def ground_iou(a: GroundBox, b: GroundBox) -> Float[Any, "..."]:
    """Intersection over union of rotated rectangles on the ground `[..., 5]`.

    Example:
        >>> box = np.array([0.0, 10.0, 4.0, 2.0, 0.3])
        >>> round(float(ground_iou(box, box)), 12)
        1.0
    """
    xp = _namespace(a)
    inter = rotated_intersection(a, b)
    areas = xp.abs(a[..., 2] * a[..., 3]) + xp.abs(b[..., 2] * b[..., 3])
    return _ratio(xp, inter, areas - inter)


def box3d_iou(a: Box3D, b: Box3D) -> Float[Any, "..."]:
    """Intersection over union of 3D boxes `[..., 7]`: x, y, z, length, width, height, rotation_y.

    y is the bottom face (y points down), so a box spans y - height to y.
    """
    xp = _namespace(a)
    columns = np.array([0, 2, 3, 4, 6])
    inter = rotated_intersection(a[..., columns], b[..., columns])
    top = xp.maximum(a[..., 1] - a[..., 5], b[..., 1] - b[..., 5])
    inter = inter * xp.maximum(xp.minimum(a[..., 1], b[..., 1]) - top, 0.0)
    volumes = a[..., 3] * a[..., 4] * a[..., 5] + b[..., 3] * b[..., 4] * b[..., 5]
    return _ratio(xp, inter, volumes - inter)
