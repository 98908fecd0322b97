r"""Other frames from one: mirrored, turned, scaled; labels and calibration follow.

The picture itself is only ever mirrored. A turned or scaled scene is seen in the same picture, by a
camera that stands otherwise in it: the projection is changed so that every point of the scene stays
at its pixel, and a network that reads the picture through it reads the right place.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from fusion.detection.geometry.bev import BevConfig
from fusion.detection.geometry.encodings import wrap_angle


def flip(
    image: Float[Array, "h w 3"],
    points: Float[Array, "p 3"],
    p2: Float[Array, "3 4"],
    width: Float[Array, ""],
    plane: Float[Array, "4"],
    truth: Float[Array, "g 7"],
) -> tuple[Array, Array, Array, Array, Array]:
    """A frame seen in a mirror: x of the camera frame changes sign.

    Returns:
        image, points, p2, plane, truth; column u becomes width - 1 - u.
    """
    mirror = jnp.array([-1.0, 1.0, 1.0])
    rows = jnp.stack([(width - 1.0) * p2[2] - p2[0], p2[1], p2[2]])
    new_p2 = rows * jnp.array([[-1.0, 1.0, 1.0, 1.0]])
    yaw = wrap_angle(jnp.pi - truth[:, 6])
    boxes = truth.at[:, 0].multiply(-1.0).at[:, 6].set(yaw)
    return (
        image[:, ::-1],
        points * mirror[None],
        new_p2,
        plane * jnp.array([-1.0, 1.0, 1.0, 1.0]),
        boxes,
    )


def turn_and_scale(
    angle: Float[Array, ""],
    factor: Float[Array, ""],
    points: Float[Array, "p 3"],
    p2: Float[Array, "3 4"],
    plane: Float[Array, "4"],
    truth: Float[Array, "g 7"],
) -> tuple[Array, Array, Array, Array]:
    r"""A scene turned around the camera's vertical axis and scaled about the camera.

    .. math:: x' = s R_y(a) x, \qquad P_2' = P_2 \begin{pmatrix} (s R_y(a))^{-1} & 0 \\ 0 & 1
        \end{pmatrix}

    Symbols: :math:`a` is `angle`, :math:`s` is `factor`. Projected points stay where they are.

    Args:
        angle: [rad], in the sense of rotation_y.
        factor: of all lengths.
        points: camera frame [m].
        p2: projection.
        plane: ground plane.
        truth: boxes.

    Returns:
        points, p2, plane, truth.
    """
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros(()), jnp.ones(())
    rotation = jnp.stack([c, zero, s, zero, one, zero, -s, zero, c]).reshape(3, 3)
    whole = jnp.concatenate([p2[:, :3] @ rotation.T / factor, p2[:, 3:]], axis=1)
    yaw = wrap_angle(truth[:, 6:] + angle)
    boxes = [factor * truth[:, :3] @ rotation.T, factor * truth[:, 3:6], yaw]
    return (
        factor * points @ rotation.T,
        whole,
        jnp.concatenate([rotation @ plane[:3], factor * plane[3:]]),
        jnp.concatenate(boxes, axis=1),
    )


def in_area(config: BevConfig, truth: Float[Array, "g 7"]) -> Bool[Array, "g"]:
    """Which boxes have their centre in the area."""
    inside = (truth[:, 0] > config.x_range[0]) & (truth[:, 0] < config.x_range[1])
    return inside & (truth[:, 2] > config.z_range[0]) & (truth[:, 2] < config.z_range[1])
