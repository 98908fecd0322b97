r"""Failures of the lidar, as pure functions of a key on scans of fixed size.

`lidar_failure` turns a clean scan into what a failed lidar would have measured. Severity runs from
0 (nothing happens, exactly) to 1 (next to nothing is left); it may be traced, the kind is static.
`random_lidar_failure` draws the kind in jit.

===============  ===================================================================================
lidar            severity s
===============  ===================================================================================
noise            range error of 1 m (sd) along the beam at s = 1, reflectance error of 0.3
beam_loss        a share s of the beams returns nothing; at least one of 16 stays (4 of 64)
sector_dropout   a sector of the view ahead returns nothing, 60 degrees wide at s = 1
loss             no point at any s > 0
===============  ===================================================================================

Sizes at s = 1 are our choice: each makes its sensor nearly useless for detection, which is what the
protocol of the source calls a failure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from fusion.detection.sensors.hdl64 import ELEVATIONS, beam_of
from fusion.detection.sensors.severity import Severity, check_failure

LidarFailure = Literal["noise", "beam_loss", "sector_dropout", "loss"]
LIDAR_FAILURES: tuple[LidarFailure, ...] = get_args(LidarFailure)

RANGE_ERROR = 1.0  # sd [m]
REFLECTANCE_ERROR = 0.3  # sd
BEAMS_PER_KEPT = 16
SECTOR_WIDTH = math.radians(60.0)
VIEW_HALF = math.radians(40.0)  # the camera sees 40 degrees to each side

Beams = Float[np.ndarray, " b"]
Points = Float[Array, "n 4"]
Mask = Bool[Array, "n"]


def _check_beams(kinds: Sequence[str], beams: Beams) -> None:
    if "beam_loss" in kinds and len(beams) < 2:
        raise ValueError(
            f"beams={beams.tolist()}: expected the elevations of the lidar's beams, which its "
            "scans do not show; prepare the frames with their number or elevations (`--beams`, "
            "`--beam-elevations`), or leave out lidar_beam_loss"
        )


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


def _beam_loss(
    key: PRNGKeyArray, points: Array, mask: Array, s: Array, *, beams: Beams
) -> tuple[Array, Array]:
    n = len(beams)
    most = n - max(1, n // BEAMS_PER_KEPT)
    n_lost = jnp.minimum(jnp.round(s * n).astype(jnp.int32), most)
    lost = jax.random.permutation(key, n) < n_lost
    return points, mask & ~lost[beam_of(points, beams)]


def _sector_dropout(key: PRNGKeyArray, points: Array, mask: Array, s: Array) -> tuple[Array, Array]:
    middle = jax.random.uniform(key, (), points.dtype, -VIEW_HALF, VIEW_HALF)
    away = jnp.arctan2(points[:, 1], points[:, 0]) - middle
    away = jnp.mod(away + math.pi, 2 * math.pi) - math.pi
    return points, mask & (jnp.abs(away) > 0.5 * SECTOR_WIDTH * s)


def _loss(key: PRNGKeyArray, points: Array, mask: Array, s: Array) -> tuple[Array, Array]:
    return points, jnp.zeros_like(mask)


_LIDAR: dict[str, Callable[..., tuple[Array, Array]]] = {
    "noise": _range_noise,
    "sector_dropout": _sector_dropout,
    "loss": _loss,
}


def lidar_failure(
    points: Points,
    mask: Mask,
    kind: str,
    severity: Severity = 1.0,
    *,
    key: PRNGKeyArray,
    beams: Beams = ELEVATIONS,
) -> tuple[Points, Mask]:
    """What a failed lidar would have measured.

    Args:
        points: `[n, 4]` x, y, z [m] in the lidar frame and reflectance in [0, 1].
        mask: `[n]` which rows are points; the others are padding.
        kind: one of `LIDAR_FAILURES` (static).
        severity: 0 returns points and mask as they are, 1 is the strongest; may be traced.
        key: typed PRNG key.
        beams: elevations of the lidar's beams from the top one down [rad] (static), see
            `find_beams`; those of the HDL-64E when left out.

    Returns:
        points and mask of the same sizes; rows that are no points any more are 0.

    Raises:
        ValueError: unknown kind (the message lists the known ones) or severity outside [0, 1], or
            lost beams of a lidar whose beams are not known (an empty array).

    Example:
        >>> import jax, jax.numpy as jnp
        >>> points, mask = jnp.ones((3, 4)), jnp.ones(3, bool)
        >>> int(lidar_failure(points, mask, "loss", key=jax.random.key(0))[1].sum())
        0
    """
    check_failure("lidar", (kind,), LIDAR_FAILURES, severity)
    _check_beams((kind,), beams)
    s = jnp.asarray(severity, points.dtype)
    fail = partial(_beam_loss, beams=beams) if kind == "beam_loss" else _LIDAR[kind]
    new_points, new_mask = fail(key, points, mask, s)
    new_points = jnp.where(new_mask[:, None], new_points, 0.0)
    return jnp.where(s > 0.0, new_points, points), jnp.where(s > 0.0, new_mask, mask)


def random_lidar_failure(
    points: Points,
    mask: Mask,
    severity: Severity = 1.0,
    *,
    key: PRNGKeyArray,
    kinds: Sequence[str] = LIDAR_FAILURES,
    beams: Beams = ELEVATIONS,
) -> tuple[Points, Mask]:
    """`lidar_failure` of a kind that is drawn evenly from `kinds`. Raises like it."""
    check_failure("lidar", kinds, LIDAR_FAILURES, severity)
    _check_beams(kinds, beams)
    choice, rest = jax.random.split(key)
    branches = [
        lambda k, p, m, s, kind=kind: lidar_failure(p, m, kind, s, key=k, beams=beams)
        for kind in kinds
    ]
    index = jax.random.randint(choice, (), 0, len(branches))
    return jax.lax.switch(index, branches, rest, points, mask, jnp.asarray(severity, points.dtype))
