r"""Failures of camera and lidar, as pure functions of a key on arrays of fixed size.

`camera_failure` and `lidar_failure` turn a clean reading into what a failed sensor would have read.
Severity runs from 0 (nothing happens, exactly) to 1 (next to nothing is left); it may be traced,
the kind is static. `random_camera_failure` and `random_lidar_failure` draw the kind in jit.

===============  ===================================================================================
camera           severity s
===============  ===================================================================================
noise            photon and read noise, variance :math:`s^2 (0.4^2 + 0.1 I)`
blackout         no picture at any s > 0
blur             Gaussian point spread of 2 % of the width at s = 1
fog              :math:`I e^{-\beta d} + A (1 - e^{-\beta d})`, visibility 25 m at s = 1
exposure         5 stops too bright or too dark at s = 1, saturated
===============  ===================================================================================

===============  ===================================================================================
lidar            severity s
===============  ===================================================================================
noise            range error of 1 m (sd) along the beam at s = 1, reflectance error of 0.3
beam_loss        a share s of the beams returns nothing, at most 60 of 64
sector_dropout   a sector of the view ahead returns nothing, 60 degrees wide at s = 1
loss             no point at any s > 0
===============  ===================================================================================

Source: Foi et al. (2008) for noise that depends on the signal; Koschmieder (1924) for fog, with the
contrast threshold of 5 % that the meteorological range is defined by. Sizes at s = 1 are our
choice: each makes its sensor nearly useless for detection, which is what the protocol of the source
calls a failure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from fusion.detection.kitti.hdl64 import N_BEAMS, beam_of

__all__ = [
    "CAMERA_FAILURES",
    "LIDAR_FAILURES",
    "CameraFailure",
    "LidarFailure",
    "camera_failure",
    "lidar_failure",
    "random_camera_failure",
    "random_lidar_failure",
]

CameraFailure = Literal["noise", "blackout", "blur", "fog", "exposure"]
LidarFailure = Literal["noise", "beam_loss", "sector_dropout", "loss"]
CAMERA_FAILURES: tuple[CameraFailure, ...] = get_args(CameraFailure)
LIDAR_FAILURES: tuple[LidarFailure, ...] = get_args(LidarFailure)

READ_NOISE = 0.4  # sd, of a pixel in [0, 1]
SHOT_NOISE = 0.1  # variance per unit of signal
BLUR_SHARE = 0.02  # sd of the point spread over the image width
VISIBILITY = 25.0  # [m], of the densest fog
CONTRAST = 0.05  # contrast left at the visibility (meteorological optical range)
AIRLIGHT = 0.8  # brightness of the fog itself
FOG_DISTANCE = 30.0  # [m], of the whole picture where no depth is given
STOPS = 5.0  # exposure error [factors of 2]
GAMMA = 2.2  # pixel value = light ** (1 / GAMMA)
RANGE_ERROR = 1.0  # sd [m]
REFLECTANCE_ERROR = 0.3  # sd
MAX_LOST_BEAMS = 60
SECTOR_WIDTH = math.radians(60.0)
VIEW_HALF = math.radians(40.0)  # the camera sees 40 degrees to each side

Image = Float[Array, "h w 3"]
Depth = Float[Array, "h w"]
Points = Float[Array, "n 4"]
Mask = Bool[Array, "n"]
Severity = Float[Array, ""] | float | int


def _noise(key: PRNGKeyArray, image: Array, s: Array, depth: Array | None) -> Array:
    sd = s * jnp.sqrt(READ_NOISE**2 + SHOT_NOISE * image)
    return jnp.clip(image + sd * jax.random.normal(key, image.shape, image.dtype), 0.0, 1.0)


def _blackout(key: PRNGKeyArray, image: Array, s: Array, depth: Array | None) -> Array:
    return jnp.zeros_like(image)


def _blur(key: PRNGKeyArray, image: Array, s: Array, depth: Array | None) -> Array:
    largest = BLUR_SHARE * image.shape[1]
    radius = max(1, math.ceil(2.5 * largest))
    offset = jnp.arange(-radius, radius + 1, dtype=image.dtype)
    # A hundredth of a pixel keeps the weights finite; it blurs nothing.
    kernel = jax.nn.softmax(-0.5 * (offset / jnp.maximum(s * largest, 0.01)) ** 2)
    padded = jnp.pad(image, ((radius, radius), (radius, radius), (0, 0)), mode="edge")
    planes = padded.transpose(2, 0, 1)[:, None]
    for window in (kernel[None, None, :, None], kernel[None, None, None, :]):
        planes = jax.lax.conv_general_dilated(planes, window, (1, 1), "VALID")
    return planes[:, 0].transpose(1, 2, 0)


def _fog(key: PRNGKeyArray, image: Array, s: Array, depth: Array | None) -> Array:
    beta = -math.log(CONTRAST) / VISIBILITY * s
    distance = jnp.full(image.shape[:2], FOG_DISTANCE, image.dtype) if depth is None else depth
    through = jnp.exp(-beta * jnp.maximum(distance, 0.0))[..., None]
    return image * through + AIRLIGHT * (1.0 - through)


def _exposure(key: PRNGKeyArray, image: Array, s: Array, depth: Array | None) -> Array:
    stops = jnp.where(jax.random.bernoulli(key), STOPS, -STOPS).astype(image.dtype) * s
    light = jnp.maximum(image, 0.0) ** GAMMA * 2.0**stops
    return jnp.minimum(light, 1.0) ** (1.0 / GAMMA)


def _range_noise(key: PRNGKeyArray, points: Array, mask: Array, s: Array) -> tuple[Array, Array]:
    by_range, by_light = jax.random.split(key)
    n = points.shape[:1]
    distance = jnp.sqrt(jnp.sum(points[:, :3] ** 2, axis=1))
    error = RANGE_ERROR * s * jax.random.normal(by_range, n, points.dtype)
    # A range cannot be negative; padding lies in the origin and stays there.
    factor = jnp.maximum(distance + error, 0.0) / jnp.maximum(distance, 1e-6)
    light = points[:, 3] + REFLECTANCE_ERROR * s * jax.random.normal(by_light, n, points.dtype)
    place = points[:, :3] * factor[:, None]
    return jnp.concatenate([place, jnp.clip(light, 0.0, 1.0)[:, None]], axis=1), mask


def _beam_loss(key: PRNGKeyArray, points: Array, mask: Array, s: Array) -> tuple[Array, Array]:
    n_lost = jnp.minimum(jnp.round(s * N_BEAMS).astype(jnp.int32), MAX_LOST_BEAMS)
    lost = jax.random.permutation(key, N_BEAMS) < n_lost
    return points, mask & ~lost[beam_of(points)]


def _sector_dropout(key: PRNGKeyArray, points: Array, mask: Array, s: Array) -> tuple[Array, Array]:
    middle = jax.random.uniform(key, (), points.dtype, -VIEW_HALF, VIEW_HALF)
    away = jnp.arctan2(points[:, 1], points[:, 0]) - middle
    away = jnp.mod(away + math.pi, 2 * math.pi) - math.pi
    return points, mask & (jnp.abs(away) > 0.5 * SECTOR_WIDTH * s)


def _loss(key: PRNGKeyArray, points: Array, mask: Array, s: Array) -> tuple[Array, Array]:
    return points, jnp.zeros_like(mask)


_CAMERA: dict[str, Callable[..., Array]] = {
    "noise": _noise,
    "blackout": _blackout,
    "blur": _blur,
    "fog": _fog,
    "exposure": _exposure,
}
_LIDAR: dict[str, Callable[..., tuple[Array, Array]]] = {
    "noise": _range_noise,
    "beam_loss": _beam_loss,
    "sector_dropout": _sector_dropout,
    "loss": _loss,
}


def _check(sensor: str, kinds: Sequence[str], known: Sequence[str], severity: Severity) -> None:
    unknown = [kind for kind in kinds if kind not in known]
    if unknown or not kinds:
        wrong = repr(unknown[0]) if unknown else "none given"
        raise ValueError(f"{sensor} failure {wrong}: expected one of {', '.join(known)}")
    if isinstance(severity, float | int | np.ndarray) and not 0.0 <= severity <= 1.0:
        raise ValueError(f"severity is {severity}, expected a number from 0 (none) to 1")


def camera_failure(
    key: PRNGKeyArray,
    image: Image,
    kind: str,
    severity: Severity = 1.0,
    *,
    depth: Depth | None = None,
) -> Image:
    r"""What a failed camera would have read.

    .. math:: \text{fog: } I' = I e^{-\beta d} + A (1 - e^{-\beta d}), \quad
        \beta = -\ln 0.05 \, s / 25 \mathrm{m}; \qquad
        \text{exposure: } I' = \min(2^{\pm 5 s} I^{2.2}, 1)^{1 / 2.2}

    Symbols: :math:`I` is `image`; :math:`s` is `severity`; :math:`d` is `depth` [m], or 30 m
    everywhere; the airlight :math:`A` is 0.8; the sign of the exposure error is drawn.

    Args:
        key: typed PRNG key.
        image: `[h, w, 3]` in [0, 1].
        kind: one of `CAMERA_FAILURES` (static).
        severity: 0 returns the image itself, 1 is the strongest; may be traced.
        depth: `[h, w]` distance of what each pixel shows [m], inf for sky; used by fog alone.

    Raises:
        ValueError: unknown kind (the message lists the known ones) or severity outside [0, 1].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jnp.full((2, 2, 3), 0.5)
        >>> float(camera_failure(jax.random.key(0), image, "blackout").max())
        0.0
    """
    _check("camera", (kind,), CAMERA_FAILURES, severity)
    s = jnp.asarray(severity, image.dtype)
    return jnp.where(s > 0.0, _CAMERA[kind](key, image, s, depth), image)


def lidar_failure(
    key: PRNGKeyArray, points: Points, mask: Mask, kind: str, severity: Severity = 1.0
) -> tuple[Points, Mask]:
    """What a failed lidar would have measured.

    Args:
        key: typed PRNG key.
        points: `[n, 4]` x, y, z [m] in the lidar frame and reflectance in [0, 1].
        mask: `[n]` which rows are points; the others are padding.
        kind: one of `LIDAR_FAILURES` (static).
        severity: 0 returns points and mask as they are, 1 is the strongest; may be traced.

    Returns:
        points and mask of the same sizes; rows that are no points any more are 0.

    Raises:
        ValueError: unknown kind (the message lists the known ones) or severity outside [0, 1].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> points, mask = jnp.ones((3, 4)), jnp.ones(3, bool)
        >>> int(lidar_failure(jax.random.key(0), points, mask, "loss")[1].sum())
        0
    """
    _check("lidar", (kind,), LIDAR_FAILURES, severity)
    s = jnp.asarray(severity, points.dtype)
    new_points, new_mask = _LIDAR[kind](key, points, mask, s)
    new_points = jnp.where(new_mask[:, None], new_points, 0.0)
    return jnp.where(s > 0.0, new_points, points), jnp.where(s > 0.0, new_mask, mask)


def random_camera_failure(
    key: PRNGKeyArray,
    image: Image,
    severity: Severity = 1.0,
    *,
    kinds: Sequence[str] = CAMERA_FAILURES,
    depth: Depth | None = None,
) -> Image:
    """`camera_failure` of a kind that is drawn evenly from `kinds`. Raises like it."""
    _check("camera", kinds, CAMERA_FAILURES, severity)
    choice, rest = jax.random.split(key)
    branches = [
        lambda k, x, s, kind=kind: camera_failure(k, x, kind, s, depth=depth) for kind in kinds
    ]
    index = jax.random.randint(choice, (), 0, len(branches))
    return jax.lax.switch(index, branches, rest, image, jnp.asarray(severity, image.dtype))


def random_lidar_failure(
    key: PRNGKeyArray,
    points: Points,
    mask: Mask,
    severity: Severity = 1.0,
    *,
    kinds: Sequence[str] = LIDAR_FAILURES,
) -> tuple[Points, Mask]:
    """`lidar_failure` of a kind that is drawn evenly from `kinds`. Raises like it."""
    _check("lidar", kinds, LIDAR_FAILURES, severity)
    choice, rest = jax.random.split(key)
    branches = [lambda k, p, m, s, kind=kind: lidar_failure(k, p, m, kind, s) for kind in kinds]
    index = jax.random.randint(choice, (), 0, len(branches))
    return jax.lax.switch(index, branches, rest, points, mask, jnp.asarray(severity, points.dtype))
