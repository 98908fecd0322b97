r"""Box encodings: anchors and their offsets, four ground corners with two heights, angle vector.

A 3D box is x, y, z, length, width, height, rotation_y in the camera frame; (x, y, z) is the centre
of its bottom face, length lies along (cos r, -sin r) in (x, z). An anchor is x, y, z and its
extents along the axes, dx, dy, dz. Everything is batched over the first axis and runs inside jit.

Source: Ku et al. (2018), AVOD: RPN offsets, section III-C; corners, heights and orientation vector,
section III-D.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from fusion.detection.geometry.planes import plane_y

Box3D = Float[Array, "n 7"]
Anchor = Float[Array, "n 6"]


def box_corners(boxes: Box3D) -> Float[Array, "n 8 3"]:
    """Corners of 3D boxes: four of the bottom face, then the four above them."""
    x, y, z, length, width, height, yaw = boxes.T
    along = 0.5 * jnp.array([1.0, 1.0, -1.0, -1.0], boxes.dtype)[None] * length[:, None]
    across = 0.5 * jnp.array([1.0, -1.0, -1.0, 1.0], boxes.dtype)[None] * width[:, None]
    cos, sin = jnp.cos(yaw)[:, None], jnp.sin(yaw)[:, None]
    corner_x = x[:, None] + cos * along + sin * across
    corner_z = z[:, None] - sin * along + cos * across
    bottom = jnp.broadcast_to(y[:, None], corner_x.shape)
    top = bottom - height[:, None]
    return jnp.concatenate(
        [jnp.stack([corner_x, level, corner_z], axis=2) for level in (bottom, top)], axis=1
    )


def ground_box(boxes: Box3D) -> Float[Array, "n 5"]:
    """x, z, length, width, rotation of 3D boxes: what rotated overlap reads."""
    return boxes[:, jnp.array([0, 2, 3, 4, 6])]


def box3d_to_anchor(boxes: Box3D, *, square: bool = False) -> Anchor:
    """The smallest anchor around 3D boxes.

    Args:
        boxes: `[n, 7]`.
        square: first turn each box to the nearest quarter of a circle, so that the anchor has the
            size of the box (targets of offsets).
    """
    x, y, z, length, width, height, yaw = boxes.T
    if square:
        yaw = jnp.round(yaw / (jnp.pi / 2)) * (jnp.pi / 2)
    cos, sin = jnp.abs(jnp.cos(yaw)), jnp.abs(jnp.sin(yaw))
    dx, dz = length * cos + width * sin, length * sin + width * cos
    return jnp.stack([x, y, z, dx, height, dz], axis=1)


def anchor_ground(anchors: Anchor) -> Float[Array, "n 4"]:
    """x1, z1, x2, z2 of anchors on the ground: what upright overlap reads."""
    x, _, z, dx, _, dz = anchors.T
    return jnp.stack([x - dx / 2, z - dz / 2, x + dx / 2, z + dz / 2], axis=1)


def encode_offsets(anchors: Anchor, targets: Anchor) -> Float[Array, "n 6"]:
    r"""Offsets from anchors to targets.

    .. math:: t_{x} = (x - x_a) / d_a, \qquad t_{d} = \log(d / d_a)
    """
    size = anchors[:, 3:]
    return jnp.concatenate(
        [(targets[:, :3] - anchors[:, :3]) / size, jnp.log(targets[:, 3:] / size)], axis=1
    )


def decode_offsets(anchors: Anchor, offsets: Float[Array, "n 6"]) -> Anchor:
    """The anchors that `encode_offsets` came from."""
    size = anchors[:, 3:]
    return jnp.concatenate(
        [anchors[:, :3] + offsets[:, :3] * size, size * jnp.exp(offsets[:, 3:])], axis=1
    )


def box3d_to_box4c(boxes: Box3D, plane: Float[Array, "4"]) -> Float[Array, "n 10"]:
    """Four corners and two heights: x1..x4, z1..z4, h1, h2.

    The corners are numbered from the one that is at (+x, +z) once the box is turned to the nearest
    quarter of a circle, so that the encoding of a box differs little from that of its anchor; the
    heading's sign is lost and kept by the angle vector instead. h1 and h2 are the heights of bottom
    and top above the ground below the centre.

    Args:
        boxes: `[n, 7]`.
        plane: ground plane a, b, c, d.
    """
    x, y, z, _, _, height, yaw = boxes.T
    anchor = box3d_to_anchor(boxes, square=True)
    turn = yaw - jnp.round(yaw / (jnp.pi / 2)) * (jnp.pi / 2)
    upright = jnp.stack([x, y, z, anchor[:, 3], anchor[:, 5], height, turn], axis=1)
    corners = box_corners(upright)[:, :4]
    h1 = plane_y(plane, x, z) - y
    heights = jnp.stack([h1, h1 + height], axis=1)
    return jnp.concatenate([corners[:, :, 0], corners[:, :, 2], heights], axis=1)


def box4c_to_box3d(boxes: Float[Array, "n 10"], plane: Float[Array, "4"]) -> Box3D:
    """The upright box with right angles that fits four corners.

    The longer one of the two lines between midpoints of opposite sides is the heading; the corners
    projected on it and across it give length, width and the centre between their extremes.

    Args:
        boxes: `[n, 10]`, corners in order around the box; they need not form a rectangle.
        plane: ground plane a, b, c, d.

    Returns:
        `[n, 7]`; the heading is one of two, see `resolve_heading`.

    Deviation: AVOD's code adds the sum of the extremes across the heading to the centre where half
    of it would be the middle. The sum is always zero: the line runs through the midpoints of two
    sides, so their corners lie symmetric about it. Neither form is needed.
    """
    corner = jnp.stack([boxes[:, :4], boxes[:, 4:8]], axis=2)
    p1, p2, p3, p4 = (corner[:, i] for i in range(4))
    first = (p1 + p2) / 2 - (p3 + p4) / 2
    second = (p1 + p4) / 2 - (p2 + p3) / 2
    norm1, norm2 = jnp.linalg.norm(first, axis=1), jnp.linalg.norm(second, axis=1)
    longer = (norm1 > norm2)[:, None]
    heading = jnp.where(longer, first, second)
    origin = jnp.where(longer, (p3 + p4) / 2, (p2 + p3) / 2)
    norm = jnp.maximum(jnp.maximum(norm1, norm2), 1e-6)[:, None]
    along = heading / norm
    across = jnp.stack([-along[:, 1], along[:, 0]], axis=1)
    from_origin = corner - origin[:, None]
    on_heading = (from_origin * along[:, None]).sum(axis=2)
    on_side = (from_origin * across[:, None]).sum(axis=2)
    low_l, high_l = on_heading.min(axis=1), on_heading.max(axis=1)
    width = on_side.max(axis=1) - on_side.min(axis=1)
    centre = origin + along * (0.5 * (low_l + high_l))[:, None]
    x, z = centre[:, 0], centre[:, 1]
    h1, h2 = boxes[:, 8], boxes[:, 9]
    y = plane_y(plane, x, z) - h1
    yaw = -jnp.arctan2(heading[:, 1], heading[:, 0])
    return jnp.stack([x, y, z, high_l - low_l, width, h2 - h1, yaw], axis=1)


def angle_vector(rotation: Float[Array, "n"]) -> Float[Array, "n 2"]:
    """(cos, sin) of a heading: no jump at half a circle."""
    return jnp.stack([jnp.cos(rotation), jnp.sin(rotation)], axis=1)


def wrap_angle(angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The same direction in [-pi, pi) [rad]."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def resolve_heading(rotation: Float[Array, "n"], vector: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """The heading `rotation` or its opposite, whichever the angle vector (of any length) prefers.

    Returns:
        Heading in [-pi, pi).
    """
    agrees = (angle_vector(rotation) * vector).sum(axis=1) >= 0
    turned = jnp.where(agrees, rotation, rotation + jnp.pi)
    return wrap_angle(turned)


def project_boxes(
    corners: Float[Array, "n k 3"],
    p2: Float[Array, "3 4"],
    height: Float[Array, ""] | float,
    width: Float[Array, ""] | float,
) -> Float[Array, "n 4"]:
    """Image boxes around projected corners, as y1, x1, y2, x2 in units of the whole image.

    0 and 1 are the first and the last pixel centre, as `crop_and_resize` reads boxes; they are not
    clipped. Corners nearer than 0.1 m in front of the camera are moved to that distance, because
    their projection would change sides.

    Args:
        corners: camera-frame corners.
        p2: projection of the left colour camera.
        height, width: of the image [pixel].
    """
    homogeneous = corners @ p2[:, :3].T + p2[:, 3][None, None]
    pixels = homogeneous[..., :2] / jnp.maximum(homogeneous[..., 2:], 0.1)
    scale = jnp.stack([jnp.asarray(width), jnp.asarray(height)]).astype(pixels.dtype) - 1.0
    unit = pixels / scale[None, None]
    low, high = unit.min(axis=1), unit.max(axis=1)
    return jnp.stack([low[:, 1], low[:, 0], high[:, 1], high[:, 0]], axis=1)
