"""The intervals into which sensors are cut: one definition for networks, rewards and Q-learning.

The source prints integer bounds for the sonars (0 to 99, 100 to 199, 200 to 300 pixels) and says
that the distance of 0 to 800 pixels is divided evenly, so a bound belongs to the interval above it
and 99.5 px to the one below. Of the angle it says that four regions surround the robot, that region
2 rewards the turn to the right and region 4 the one to the left (section 2.2.2.3): the numbers run
clockwise from the heading, and here they count from 0. That the regions are quarters, centred on
the heading, and who owns the borders is ours: 45 degrees to either side is still ahead, 135 degrees
still aside, the same on the left and on the right.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

N_SONAR, N_DISTANCE, N_ANGLE = 3, 4, 4
N_NEAR, N_OCTANT = 4, 8
_SONAR_STEP = 100.0  # [px]
_DISTANCE_STEP = 200.0  # [px]


def sonar_interval(sonar: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """0, 1 or 2 for a reading of 0-99, 100-199 or 200-300 px.

    Source: Shim (2020), section 2.4.2.

    Example:
        >>> sonar_interval(jnp.array([0.0, 99.5, 100.0, 300.0])).tolist()
        [0, 0, 1, 2]
    """
    return jnp.clip(jnp.floor(sonar / _SONAR_STEP), 0, N_SONAR - 1).astype(jnp.int32)


def near_interval(sonar: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """0 to 3 for a reading below 50, 100, 200 px or beyond: the nearest interval cut in two.

    Source: ours.

    Example:
        >>> near_interval(jnp.array([49.0, 50.0, 100.0, 300.0])).tolist()
        [0, 1, 2, 3]
    """
    bounds = (50.0, 100.0, 200.0)
    return sum(((sonar >= bound).astype(jnp.int32) for bound in bounds), jnp.int32(0))


def angle_octant(angle: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """0 to 7: eighth of the circle that holds the target, 0 ahead, counted counter-clockwise.

    Source: ours.

    Example:
        >>> angle_octant(jnp.array([0.0, 45.0, 180.0, -90.0])).tolist()
        [0, 1, 4, 6]
    """
    return jnp.mod(jnp.floor((angle + 22.5) / 45.0), N_OCTANT).astype(jnp.int32)


def distance_interval(distance: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """0 to 3: which quarter of 0-800 px.

    Source: Shim (2020), section 2.4.2.

    Example:
        >>> distance_interval(jnp.array([199.0, 200.0, 800.0])).tolist()
        [0, 1, 3]
    """
    return jnp.clip(jnp.floor(distance / _DISTANCE_STEP), 0, N_DISTANCE - 1).astype(jnp.int32)


def angle_region(angle: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """Region that holds the target: 0 ahead, 1 right, 2 behind, 3 left.

    Regions 1 to 4 of Figure 2.4, less one.

    Args:
        angle: from the heading to the target [deg], positive to the left, in (-180, 180].

    Source: Shim (2020), sections 2.2.2.3 and 2.4.2.

    Example:
        >>> angle_region(jnp.array([0.0, -90.0, 180.0, 90.0])).tolist()
        [0, 1, 2, 3]
    """
    region = jnp.where(angle > 0, 3, 1)
    region = jnp.where(jnp.abs(angle) <= 45.0, 0, region)
    return jnp.where(jnp.abs(angle) > 135.0, 2, region).astype(jnp.int32)
