r"""Failures of both sensors together: each reads well, and they do not fit.

`misaligned` displaces a scan against the picture and the labels, which stay. Severity runs from 0
(nothing happens, exactly) to 1; it may be traced, the kind is static.

==================  ================================================================================
kind                severity s
==================  ================================================================================
calibration_shift   the lidar's mount is off by a rotation of 5 degrees about a drawn axis and by
                    0.3 m in a drawn direction at s = 1
time_lag            the scan is 0.5 s older or newer than the picture at s = 1: the car drives 5 to
                    15 m/s and turns at up to 10 degrees/s, every second labelled car drives too
==================  ================================================================================

Both are drawn anew for every frame, so that no one correction undoes them; after a lag, cars that
drive are in other places than what stands, and no map of one frame undoes it.

Source: Yu et al. (2023), benchmark of the robustness of camera and lidar fusion (spatial and
temporal misalignment). Sizes are our choice.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from fusion.detection.geometry.inside import points_in_boxes
from fusion.detection.sensors.severity import Severity, check_failure

Misalignment = Literal["calibration_shift", "time_lag"]
MISALIGNMENTS: tuple[Misalignment, ...] = get_args(Misalignment)

ROTATION, SHIFT = math.radians(5.0), 0.3  # of the mount [rad, m]
LAG = 0.5  # [s]
SPEED = (5.0, 15.0)  # of the own car [m/s]
TURN_RATE = math.radians(10.0)  # largest [rad/s]
OTHERS_SPEED = 15.0  # largest, of other cars [m/s]
_MARGIN = 0.2  # around a box within which a point belongs to its car [m]


def _direction(key: PRNGKeyArray) -> Array:
    vector = jax.random.normal(key, (3,))
    return vector / jnp.maximum(jnp.sqrt((vector**2).sum()), 1e-6)


def _rotation(axis: Array, angle: Array) -> Array:
    """Rodrigues' formula."""
    x, y, z = axis
    zero = jnp.zeros(())
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    return jnp.eye(3) + jnp.sin(angle) * cross + (1.0 - jnp.cos(angle)) * (cross @ cross)


def _calibration_shift(
    key: PRNGKeyArray, camera: Array, truth: Array, truth_mask: Array, s: Array
) -> Array:
    by_axis, by_shift = jax.random.split(key)
    rotation = _rotation(_direction(by_axis), ROTATION * s)
    return camera @ rotation.T + (SHIFT * s * _direction(by_shift))[None]


def _time_lag(key: PRNGKeyArray, camera: Array, truth: Array, truth_mask: Array, s: Array) -> Array:
    by_sign, by_speed, by_turn, by_cars, by_parked = jax.random.split(key, 5)
    lag = LAG * s * jnp.where(jax.random.bernoulli(by_sign), 1.0, -1.0)
    n = truth.shape[0]
    speed = jax.random.uniform(by_cars, (n,), maxval=OTHERS_SPEED)
    speed = jnp.where(jax.random.bernoulli(by_parked, shape=(n,)), speed, 0.0)
    heading = jnp.stack(
        [jnp.cos(truth[:, 6]), jnp.zeros(n, truth.dtype), -jnp.sin(truth[:, 6])], axis=1
    )
    # Where each car was (lag > 0), in the frame of the picture's time ...
    inside = points_in_boxes(camera, truth, margin=_MARGIN) & truth_mask[None]
    moved = jnp.where(inside, 1.0, 0.0) @ (speed[:, None] * heading)
    camera = camera - lag * moved
    # ... as seen from where the own car was then: it stood that much farther back.
    ahead = jax.random.uniform(by_speed, (), minval=SPEED[0], maxval=SPEED[1]) * lag
    turn = jax.random.uniform(by_turn, (), minval=-TURN_RATE, maxval=TURN_RATE) * lag
    rotation = _rotation(jnp.array([0.0, 1.0, 0.0]), turn)
    return camera @ rotation.T + jnp.array([0.0, 0.0, 1.0])[None] * ahead


_KINDS = {"calibration_shift": _calibration_shift, "time_lag": _time_lag}


def misaligned(
    points: Float[Array, "n 4"],
    mask: Bool[Array, "n"],
    to_camera: Float[Array, "3 4"],
    truth: Float[Array, "g 7"],
    truth_mask: Bool[Array, "g"],
    kind: str,
    severity: Severity = 1.0,
    *,
    key: PRNGKeyArray,
) -> Float[Array, "n 4"]:
    """A scan that does not fit the picture and the labels of its frame.

    Args:
        points: `[n, 4]` x, y, z [m] in the lidar frame and reflectance.
        mask: `[n]` which rows are points; the others are padding and stay 0.
        to_camera: `[3, 4]` lidar to rectified camera, a rotation and a shift.
        truth, truth_mask: labelled boxes in the camera frame; their points move with them.
        kind: one of `MISALIGNMENTS` (static).
        severity: 0 returns the points as they are, 1 is the strongest; may be traced.
        key: typed PRNG key, of one frame.

    Returns:
        `[n, 4]` in the lidar frame.

    Raises:
        ValueError: unknown kind (the message lists the known ones) or severity outside [0, 1].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> points, mask, boxes = jnp.ones((3, 4)), jnp.ones(3, bool), jnp.ones((1, 7))
        >>> none = jnp.zeros(1, bool)
        >>> turned = misaligned(points, mask, jnp.eye(4)[:3], boxes, none, "time_lag", 0.0,
        ...                     key=jax.random.key(0))
        >>> bool((turned == points).all())
        True
    """
    check_failure("both sensors'", (kind,), MISALIGNMENTS, severity)
    s = jnp.asarray(severity, points.dtype)
    rotation, shift = to_camera[:, :3], to_camera[:, 3]
    camera = points[:, :3] @ rotation.T + shift[None]
    moved = _KINDS[kind](key, camera, truth, truth_mask, s)
    place = (moved - shift[None]) @ rotation
    displaced = jnp.concatenate([place, points[:, 3:]], axis=1)
    return jnp.where((s > 0.0) & mask[:, None], displaced, points)
