r"""The beams of any spinning lidar, from the elevations of its points.

The points of one beam have one elevation :math:`\phi = \mathrm{atan2}(z, \sqrt{x^2 + y^2})`, but
for a spread that is small where the beams start in the sensor's origin and the scan is as it was
measured. Sorted elevations then have few large gaps, between beams, and many small ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fusion.detection.sensors.hdl64 import ELEVATIONS

FEWEST, MOST = 4, 256  # beams of a lidar that can be told
_CLEAR, _GIVEN = 4.0, 2.0  # least ratio of the smallest gap between beams to the largest in one
_NEAREST = 2.0  # [m]; from nearer points the offset of a beam from the origin shows
_FEWEST_POINTS = 3  # of a beam
_SAME = 0.1  # [degree] a beam may lie off the HDL-64E's
_SLACK, _INSIDE = 3.0, 0.95  # [degree] around the HDL-64E's view, share of the points in it


def elevations_of(points: Float[np.ndarray, "n c"]) -> Float[np.ndarray, " m"]:
    """Elevations [rad] of a scan's points that are at least 2 m away."""
    x, y, z = np.asarray(points, np.float64)[:, :3].T
    flat = np.hypot(x, y)
    return np.arctan2(z, flat)[np.hypot(flat, z) >= _NEAREST]


def find_beams(
    elevations: Float[np.ndarray, " n"], n_beams: int | None = None
) -> Float[np.ndarray, " b"]:
    """Elevations of the beams, from the top one down [rad].

    Args:
        elevations: of the points of some scans, see `elevations_of`; a beam that met nothing in any
            of them is not there.
        n_beams: how many there are; found when left out, where gaps between beams are at least four
            times the gaps within one (twice, where the number is given).

    Raises:
        ValueError: the beams cannot be told apart, as in a scan that was corrected for the motion
            of the car, or in too few points; the message says what to give.

    Example:
        >>> import numpy as np
        >>> three = np.repeat(np.radians([-15.0, -5.0, 3.0, 8.0]), 50)
        >>> np.degrees(find_beams(three)).round(2)
        array([  8.,   3.,  -5., -15.], dtype=float32)
    """
    e = np.sort(np.asarray(elevations, np.float64))
    if n_beams is not None and not FEWEST <= n_beams <= MOST:
        raise ValueError(f"n_beams={n_beams}: expected {FEWEST} to {MOST}; count the lidar's beams")
    gaps = np.diff(e)
    by_size = np.sort(gaps)[::-1]
    # Gaps of rounding alone are no measure of a beam's spread.
    ratio = by_size[:-1] / np.maximum(by_size[1:], 1e-6)
    counts = np.arange(2, len(ratio) + 2)
    asked = (counts >= FEWEST) & (counts <= MOST) if n_beams is None else counts == n_beams
    least = _CLEAR if n_beams is None else _GIVEN
    if asked.any():
        best = int(np.argmax(np.where(asked, ratio, 0.0)))
        n = int(counts[best])
        borders = np.flatnonzero(gaps > by_size[n - 1])
        beams = np.split(e, borders + 1)
        enough = min(len(beam) for beam in beams) >= _FEWEST_POINTS
        if ratio[best] >= least and len(beams) == n and enough:
            return np.array([beam.mean() for beam in beams[::-1]], np.float32)
    wanted = "them" if n_beams is None else f"{n_beams} of them"
    raise ValueError(
        f"beams=unknown: {len(e)} points do not show {wanted} by their elevations; give more scans "
        "as they were measured, or the elevations from the lidar's data sheet"
    )


def beams_of_scans(
    elevations: Sequence[Float[np.ndarray, " n"]], given: int | Sequence[float] | None = None
) -> tuple[float, ...] | None:
    """Beams of the lidar that made some scans, from the top one down [degree].

    Args:
        elevations: of each scan's points [rad].
        given: how many beams there are, or their elevations [degree], which are only sorted.

    Returns:
        None for those of the HDL-64E: more than half of its beams are there, or no beams can be
        told and the points lie in its view, as in the benchmark's scans, which are corrected for
        the motion of the car. Empty where beams can be told neither way.

    Raises:
        ValueError: a number of beams is given that cannot be told.
    """
    if given is not None and not isinstance(given, int):
        return tuple(sorted((float(beam) for beam in given), reverse=True))
    pooled = np.concatenate([np.zeros(0), *elevations])
    known = np.degrees(ELEVATIONS)
    try:
        found = np.degrees(find_beams(pooled, given))
    except ValueError:
        if given is not None:
            raise
        degrees = np.degrees(pooled)
        inside = (degrees > known.min() - _SLACK) & (degrees < known.max() + _SLACK)
        return None if not len(degrees) or inside.mean() >= _INSIDE else ()
    off = np.abs(found[:, None] - known[None]).min(axis=1)
    if given in (None, len(known)) and len(found) > len(known) // 2 and off.max() < _SAME:
        return None
    return tuple(round(float(beam), 4) for beam in found)
