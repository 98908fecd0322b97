r"""The scan pattern of the lidar that KITTI was recorded with: elevation of its 64 beams.

.. math::
    \phi_k = 2^\circ - k/3^\circ \;(k < 32), \qquad \phi_k = -8.83^\circ - (k - 32)/2^\circ
    \;(k \ge 32)

Source: Velodyne, HDL-64E S2 data sheet (2 to -8.33 degrees in steps of 1/3, -8.83 to -24.33 in
steps of 1/2; accuracy of range below 2 cm; 0.17 degrees of azimuth between shots at 10 Hz).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

N_BEAMS = 64
ELEVATIONS = np.radians(
    np.concatenate([2.0 - np.arange(32) / 3.0, -8.83 - np.arange(32) / 2.0])
).astype(np.float32)
"""`[64]` elevation of the beams from the top one down [rad]."""
AZIMUTH_STEP = float(np.radians(0.1728))
"""Azimuth between two shots of a beam at 10 turns a second [rad]."""
RANGE_NOISE = 0.02
"""Standard deviation of a range [m]."""


def beam_of(
    points: Float[Array, "n c"], elevations: Float[np.ndarray, " b"] = ELEVATIONS
) -> Int[Array, "n"]:
    """Which beam measured a point: the one of nearest elevation, 0 for the top one.

    Args:
        points: `[n, >= 3]` x, y, z in the lidar frame [m]. The beams of the real sensor do not all
            start in the origin, so near points of real scans can be off by a beam or two.
        elevations: of the lidar's beams from the top one down [rad]; the HDL-64E's when left out.

    Example:
        >>> import jax.numpy as jnp
        >>> beam_of(jnp.array([[20.0, 0.0, 0.7], [10.0, 0.0, -4.0]])).tolist()
        [0, 58]
    """
    borders = -(elevations[1:] + elevations[:-1]) / 2  # ascending
    elevation = jnp.arctan2(points[:, 2], jnp.hypot(points[:, 0], points[:, 1]))
    return jnp.searchsorted(jnp.asarray(borders), -elevation)
