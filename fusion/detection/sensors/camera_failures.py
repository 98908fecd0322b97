r"""Failures of the camera, as pure functions of a key on images.

`camera_failure` turns a clean picture into what a failed camera would have read. Severity runs from
0 (nothing happens, exactly) to 1 (next to nothing is left); it may be traced, the kind is static.
`random_camera_failure` draws the kind in jit.

===============  ===================================================================================
camera           severity s
===============  ===================================================================================
noise            sensor noise, variance :math:`s^2 (0.4^2 + 0.1 I)`
blackout         no picture at any s > 0
blur             Gaussian point spread of 2 % of the width at s = 1
fog              :math:`I e^{-\beta d} + A (1 - e^{-\beta d})`, visibility 15 m at s = 1
exposure         8 stops too bright or too dark at s = 1: saturated, or few photons
===============  ===================================================================================

Every failed picture is read with a noise of 2.5 grey levels and rounded to 8 bits, so that what a
failure hides cannot be computed back: dark or foggy pictures of endless digits are the clean ones
to within a linear map. Fog needs the distance of what each pixel shows (`depth_image`); of one
distance for all it would be such a map.

Source: Foi et al. (2008) for noise that depends on the signal; Koschmieder (1924) for fog, with the
contrast threshold of 5 % that the meteorological range is defined by. Sizes at s = 1, the read
noise and the full well of 10,000 electrons (typical of small sensors) are our choice: each failure
makes its sensor nearly useless for detection, which is what the protocol of the source calls one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from fusion.detection.sensors.severity import Severity, check_failure

CameraFailure = Literal["noise", "blackout", "blur", "fog", "exposure"]
CAMERA_FAILURES: tuple[CameraFailure, ...] = get_args(CameraFailure)

SENSOR_NOISE = 0.4  # sd, of a pixel in [0, 1]
SHOT_NOISE = 0.1  # variance per unit of signal
BLUR_SHARE = 0.02  # sd of the point spread over the image width
READ_NOISE = 0.01  # sd, of every failed picture
VISIBILITY = 15.0  # [m], of the densest fog
CONTRAST = 0.05  # contrast left at the visibility (meteorological optical range)
AIRLIGHT = 0.8  # brightness of the fog itself
STOPS = 8.0  # exposure error [factors of 2]
FULL_WELL, READ_ELECTRONS = 10_000.0, 10.0  # of a pixel
GAMMA = 2.2  # pixel value = light ** (1 / GAMMA)

Image = Float[Array, "h w 3"]
Depth = Float[Array, "h w"]


def _digitize(key: PRNGKeyArray, image: Array) -> Array:
    """Read noise, then 8 bits: what every failed picture goes through after its failure.

    Without it a dark or foggy picture would hold all of its contrast in the last digits.
    """
    noisy = image + READ_NOISE * jax.random.normal(key, image.shape, image.dtype)
    return jnp.round(255.0 * jnp.clip(noisy, 0.0, 1.0)) / 255.0


def _noise(key: PRNGKeyArray, image: Array, s: Array, depth: Array | None) -> Array:
    sd = s * jnp.sqrt(SENSOR_NOISE**2 + SHOT_NOISE * image)
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
    # As products with banded matrices: a convolution of one channel leaves a CPU's registers empty.
    columns = [_banded(kernel, side) for side in image.shape[:2]]
    return jnp.einsum("ia,jb,abc->ijc", *columns, padded, optimize="optimal")


def _banded(kernel: Float[Array, "k"], n: int) -> Float[Array, "n m"]:
    """The matrix whose product is the convolution without padding, with n results."""
    offset = jnp.arange(n + kernel.size - 1)[None] - jnp.arange(n)[:, None]
    inside = (offset >= 0) & (offset < kernel.size)
    return jnp.where(inside, kernel[jnp.clip(offset, 0, kernel.size - 1)], 0.0)


def _fog(key: PRNGKeyArray, image: Array, s: Array, depth: Array | None) -> Array:
    beta = -math.log(CONTRAST) / VISIBILITY * s
    assert depth is not None
    through = jnp.exp(-beta * jnp.maximum(depth, 0.0))[..., None]
    return image * through + AIRLIGHT * (1.0 - through)


def _exposure(key: PRNGKeyArray, image: Array, s: Array, depth: Array | None) -> Array:
    by_sign, by_photons = jax.random.split(key)
    stops = jnp.where(jax.random.bernoulli(by_sign), STOPS, -STOPS).astype(image.dtype) * s
    light = jnp.maximum(image, 0.0) ** GAMMA * 2.0**stops
    electrons = jnp.sqrt(light * FULL_WELL + READ_ELECTRONS**2) / FULL_WELL  # sd, as light
    light = light + electrons * jax.random.normal(by_photons, image.shape, image.dtype)
    return jnp.clip(light, 0.0, 1.0) ** (1.0 / GAMMA)


_CAMERA: dict[str, Callable[..., Array]] = {
    "noise": _noise,
    "blackout": _blackout,
    "blur": _blur,
    "fog": _fog,
    "exposure": _exposure,
}


def _check_depth(kinds: Sequence[str], depth: Depth | None) -> None:
    if "fog" in kinds and depth is None:
        raise ValueError(
            "depth=None: expected the distance of each pixel [m] for fog; `depth_image` computes "
            "it from a scan"
        )


def camera_failure(
    image: Image,
    kind: str,
    severity: Severity = 1.0,
    *,
    key: PRNGKeyArray,
    depth: Depth | None = None,
) -> Image:
    r"""What a failed camera would have read.

    .. math:: \text{fog: } I' = I e^{-\beta d} + A (1 - e^{-\beta d}), \quad
        \beta = -\ln 0.05 \, s / 15 \mathrm{m}; \qquad
        \text{exposure: } I' = \min(2^{\pm 8 s} I^{2.2} + \epsilon, 1)^{1 / 2.2}

    Symbols: :math:`I` is `image`; :math:`s` is `severity`; :math:`d` is `depth` [m]; the airlight
    :math:`A` is 0.8; the sign of the exposure error is drawn, and :math:`\epsilon` is the noise of
    the photons that are left. Then read noise and 8 bits.

    Args:
        image: `[h, w, 3]` in [0, 1].
        kind: one of `CAMERA_FAILURES` (static).
        severity: 0 returns the image itself, 1 is the strongest; may be traced.
        key: typed PRNG key.
        depth: `[h, w]` distance of what each pixel shows [m], inf for sky; fog alone uses it and
            needs it, see `depth_image`.

    Returns:
        `[h, w, 3]` in [0, 1].

    Raises:
        ValueError: unknown kind (the message lists the known ones), severity outside [0, 1], or fog
            without depth.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> image = jnp.full((2, 2, 3), 0.5)
        >>> float(camera_failure(image, "blackout", key=jax.random.key(0)).max())
        0.0
    """
    check_failure("camera", (kind,), CAMERA_FAILURES, severity)
    _check_depth((kind,), depth)
    s = jnp.asarray(severity, image.dtype)
    failed = _CAMERA[kind](key, image, s, depth)
    if kind != "blackout":  # a dead sensor reads nothing, not even noise
        failed = _digitize(jax.random.fold_in(key, 1), failed)
    return jnp.where(s > 0.0, failed, image)


def random_camera_failure(
    image: Image,
    severity: Severity = 1.0,
    *,
    key: PRNGKeyArray,
    kinds: Sequence[str] = CAMERA_FAILURES,
    depth: Depth | None = None,
) -> Image:
    """`camera_failure` of a kind that is drawn evenly from `kinds`. Raises like it."""
    check_failure("camera", kinds, CAMERA_FAILURES, severity)
    _check_depth(kinds, depth)
    choice, rest = jax.random.split(key)
    branches = [
        lambda k, x, s, kind=kind: camera_failure(x, kind, s, key=k, depth=depth) for kind in kinds
    ]
    index = jax.random.randint(choice, (), 0, len(branches))
    return jax.lax.switch(index, branches, rest, image, jnp.asarray(severity, image.dtype))
