"""Failure regions that slopes do not lead to: opposite sides, wide samples, jumps."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from failure.archive import Archive
from failure.worst_case import Region, merge_regions, worst_case_points
from failure.yields import normal_draws

_PER_SPEC = 3
"""Regions of one specification at most."""


def explore(
    archive: Archive,
    nominal: Float[np.ndarray, "k"],
    regions: Sequence[Region],
    n: int,
    *,
    reach: float = 8.0,
    alike: float = 0.6,
    key: Key[Array, ""],
) -> list[Region]:
    """Known regions and those that wide samples and the opposite side of known ones lead to.

    A failing sample whose cosine with all regions of its specification is below `alike` starts a
    region of its own. Where no nearest point can be verified there (jumps, steps, measures that
    fail), the region stands for the weighted mean of its failures instead.

    Args:
        archive: evaluates.
        nominal: violations at 0.
        regions: known ones.
        n: wide samples, N(0, s^2 I) with s up to 2.
        reach: no farther out than this [sigma].
        alike: see above.
        key: random key.
    """
    dim = archive.x.shape[1]
    key_wide, key_centre = jax.random.split(key)
    scale = float(np.clip(1.5 * 5.0 / math.sqrt(dim), 1.2, 2.0))
    mirrored = [-1.15 * r.point for r in regions if 1.15 * r.distance <= reach]
    points = np.array([*mirrored, *(scale * normal_draws(n, dim, key=key_wide))])
    points = points.reshape(-1, dim)[: archive.left]
    g = archive(points, "explore")
    known = {k: [r for r in regions if r.spec == k] for k in range(len(nominal))}
    starts: list[tuple[int, np.ndarray]] = []
    for k in range(len(nominal)):
        failing = points[g[:, k] > 0.0]
        taken = [r.point for r in known[k]]
        for point in failing[np.argsort(np.linalg.norm(failing, axis=1))]:
            length = float(np.linalg.norm(point))
            near = (p @ point > alike * np.linalg.norm(p) * length for p in taken)
            if length > 1.5 * reach or len(taken) >= _PER_SPEC or any(near):
                continue
            taken.append(point)
            starts.append((k, point))
    if not starts:
        return list(regions)
    found = worst_case_points(archive, [k for k, _ in starts], [p for _, p in starts], reach=reach)
    sure = [r for r in found if r.converged]
    for number, (k, point) in enumerate(starts):
        if any(r.spec == k for r in [*regions, *sure]):
            continue
        sub = jax.random.fold_in(key_centre, number)
        centre = centre_of_failures(archive, k, point, key=sub)
        if centre is not None:
            sure.append(Region(k, centre, np.zeros(dim), 0.0, 0.0, True))
    return merge_regions([*regions, *sure])


def centre_of_failures(
    archive: Archive,
    spec: int,
    point: Float[np.ndarray, "d"],
    *,
    rounds: int = 4,
    key: Key[Array, ""],
) -> Float[np.ndarray, "d"] | None:
    r"""Mean of the failures of a region under the normal distribution, by a few rounds of samples.

    .. math:: \mu \leftarrow \frac{\sum_i w_i 1[g(x_i) > 0]\, x_i}{\sum_i w_i 1[g(x_i) > 0]},
        \qquad x_i \sim N(\mu, I), \quad w_i = \phi(x_i) / \phi(x_i - \mu)

    Args:
        archive: evaluates.
        spec: column of the violations.
        point: where to begin.
        rounds: of samples.
        key: random key.

    Returns:
        The mean, or None when the budget or the failures run out.

    Source: Rubinstein and Kroese (2004), the cross-entropy method. Deviation: weights are tempered
    so that a tenth of the failures counts at least, and the covariance stays I.
    """
    dim = len(point)
    count = max(20, 2 * dim)
    centre = np.array(point, np.float64)
    for k in range(rounds):
        if archive.left < 2 * count:
            break
        x = centre + normal_draws(count, dim, key=jax.random.fold_in(key, k))
        failing = x[archive(x, "explore")[:, spec] > 0.0]
        if len(failing) < 3:
            break
        log_w = -failing @ centre
        power = 1.0
        for _ in range(20):
            w = np.exp(power * (log_w - log_w.max()))
            if w.sum() ** 2 / (w**2).sum() >= max(3.0, 0.1 * len(failing)):
                break
            power *= 0.7
        centre = (w / w.sum()) @ failing
    return centre
