"""Worst-case points of several specifications by values alone: where each begins to fail."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from failure.archive import Archive
from failure.descents import COSINE, GAP, cosine_of
from failure.hlrf import DesignPoint, find_design_point, onto_boundary

STEP = 0.5
"""Of the differences [sigma]; a simulator of its own has some noise."""

BEYOND = 0.3
"""A converged point is a failure's when the boundary is really crossed this far behind it [sigma]:
an output that levels off just below its limit passes every other check."""


class Region(NamedTuple):
    """A failure region of one specification, by its worst-case point.

    Attributes:
        spec: column of the violations.
        point: `[d]`, on the limit where it is converged.
        slope: `[d]`, gradient of the violation there.
        gap: violation that was simulated last, near the point.
        cosine: of point and slope; 1 at the nearest failing point.
        failed: a failing sample of the region has been seen.
    """

    spec: int
    point: Float[np.ndarray, "d"]
    slope: Float[np.ndarray, "d"]
    gap: float
    cosine: float
    failed: bool

    @property
    def distance(self) -> float:
        """Worst-case distance [sigma]."""
        return float(np.linalg.norm(self.point))

    @property
    def converged(self) -> bool:
        """Whether it is the nearest failing point around, as far as checks can say."""
        return self.cosine >= COSINE and abs(self.gap) <= GAP and self.failed

    @property
    def design(self) -> DesignPoint:
        """What lines start from."""
        verdict = "good" if self.converged else "its worst-case point is not verified"
        axis = self.slope / max(float(np.linalg.norm(self.slope)), 1e-300)
        return DesignPoint(
            self.point, 0.0, self.slope, float(self.point @ axis), self.cosine, 0.0, 0, 0,
            float("nan"), verdict,
        )  # fmt: skip


def worst_case_points(
    archive: Archive,
    specs: Sequence[int],
    starts: Sequence[Float[np.ndarray, "d"] | None],
    *,
    gradients: Sequence[Float[np.ndarray, "d"] | None] | None = None,
    reach: float = 8.0,
) -> list[Region]:
    """The nearest failing point of specifications, each from a start (`hlrf`).

    Args:
        archive: evaluates; differences that two specifications share are simulated once.
        specs: column of each start.
        starts: a failing point, from which the limit is sought along the ray to nominal, or None
            for nominal.
        gradients: slope of each at nominal, where it is known.
        reach: no farther out than this [sigma].

    Returns:
        One region per start, as good as the budget could make it.

    Source: Hasofer and Lind (1974); Rackwitz and Fiessler (1978).
    """
    regions = []
    for k, (spec, start) in enumerate(zip(specs, starts, strict=True)):
        search = archive.violation(spec, "worst case")
        inner = None if start is None else onto_boundary(search, 0.0, np.asarray(start))
        gradient = gradients[k] if gradients is not None and start is None else None
        found = find_design_point(
            search, 0.0, archive.x.shape[1], start=inner, gradient=gradient, restarts=0,
            step=STEP, reach=reach,
        )  # fmt: skip
        if np.all(np.isfinite(found.point)):
            regions.append(_region(archive, spec, found, start is not None))
    return regions


def _region(archive: Archive, spec: int, found: DesignPoint, failed: bool) -> Region:
    """The design point as a region, on the limit where it is converged."""
    failed = failed or bool(np.isfinite(found.first_failure))
    point = found.point
    if found.converged:
        length2 = max(float(found.gradient @ found.gradient), 1e-300)
        point = point - found.value / length2 * found.gradient
        if not failed:
            beyond = (point + BEYOND * found.axis)[None]
            failed = bool(archive.violation(spec, "worst case")(beyond)[0] > 0.0)
    return Region(spec, point, found.gradient, found.gap, found.cosine, failed)


def find_regions(
    archive: Archive, dim: int, *, reach: float = 8.0, alike: float = 0.8
) -> tuple[Float[np.ndarray, "k"], list[Region]]:
    """Nominal violations and the failure regions that slopes and known failures lead to.

    Args:
        archive: evaluates; samples that it holds already serve as starts.
        dim: number of parameters.
        reach: no farther out than this [sigma].
        alike: failures of a direction with a larger cosine belong to one region.

    Returns:
        (violations at 0; regions, at most three of each specification).

    Raises:
        ValueError: the nominal circuit fails.
    """
    known = np.array([label == "start" for label in archive.labels], bool)
    known_x, known_g = archive.x[known], archive.g[known] if archive.g is not None else None
    nominal = archive(np.zeros((1, dim)), "nominal")[0]
    if not np.all(nominal < 0.0):
        bad = np.flatnonzero(~(nominal < 0.0))
        raise ValueError(
            f"nominal={nominal.tolist()}: expected violations below 0; the nominal circuit fails "
            f"specifications {bad.tolist()}"
        )
    slopes = _slopes_of_samples(known_x, known_g)
    every = list(range(len(nominal)))
    gradients = None if slopes is None else [slopes[k] for k in every]
    regions = worst_case_points(
        archive, every, [None] * len(every), gradients=gradients, reach=reach
    )
    if known_g is None:
        return nominal, merge_regions(regions, alike=alike)
    specs: list[int] = []
    starts: list[np.ndarray] = []
    for k in every:
        own = [r.point for r in regions if r.spec == k and r.failed]
        failing = known_x[known_g[:, k] > 0.0]
        for point in failing[np.argsort(np.linalg.norm(failing, axis=1))]:
            if len(own) < 3 and all(cosine_of(point, p) < alike for p in own):
                own.append(point)
                specs.append(k)
                starts.append(point)
    regions += worst_case_points(archive, specs, starts, reach=reach)
    return nominal, merge_regions(regions, alike=alike)


def merge_regions(regions: list[Region], *, alike: float = 0.8) -> list[Region]:
    """Regions with a failure, one per direction and specification, verified and nearest first."""
    kept: list[Region] = []
    for region in sorted(regions, key=lambda r: (not r.converged, r.distance)):
        twin = (r.spec == region.spec and cosine_of(r.point, region.point) > alike for r in kept)
        if region.failed and not any(twin):
            kept.append(region)
    return sorted(kept, key=lambda r: r.distance)


def _slopes_of_samples(x: np.ndarray, g: np.ndarray | None) -> Float[np.ndarray, "k d"] | None:
    """Slopes about the nominal circuit from known samples, where there are enough."""
    if g is None:
        return None
    good = np.all(np.isfinite(g), axis=1)
    if int(good.sum()) < 3 * (x.shape[1] + 1):
        return None
    design = np.concatenate([x[good], np.ones((int(good.sum()), 1))], axis=1)
    return np.asarray(np.linalg.lstsq(design, g[good], rcond=None)[0][:-1].T)
