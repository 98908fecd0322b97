"""All failure regions that can be found, each with its design point, and their probability."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from failure.estimates import Estimate, add, check_threshold
from failure.hlrf import DesignPoint, find_design_point, onto_boundary
from failure.lines import BEND, sample_lines
from failure.opposite import (
    beside,
    check_scan,
    explained,
    fails,
    opposite_sides_fail,
    wide_scale,
)
from failure.performances import Counted, Performance, Slopes

ALIKE = 0.9
"""Design points with a larger cosine stand for one region."""

FURTHER = 2.5
"""A region that lies further out than the nearest one by this much does not count [sigma]."""


class Regions(NamedTuple):
    """Result of `probability_by_lines`.

    Attributes:
        estimate: of failing in any region; `n_simulations` is everything that was spent.
        points: the design point of each region, nearest first.
        shares: probability of each region over the sum.
        n_gradients: evaluations with a gradient among `n_simulations`.
    """

    estimate: Estimate
    points: list[DesignPoint]
    shares: Float[np.ndarray, " k"]
    n_gradients: int


class _Finder:
    """Design points from several starts, counted together."""

    def __init__(
        self, performance: Performance, threshold: float, dim: int, slopes: Slopes | None
    ) -> None:
        self.performance, self.threshold, self.dim, self.slopes = (
            performance, threshold, dim, slopes,
        )  # fmt: skip
        self.points: list[DesignPoint] = []
        self.values = self.gradients = 0
        self.failed = False

    def find(self, start: np.ndarray | None, *, restarts: int = 0) -> DesignPoint | None:
        """A design point of a region that is not known yet, or None.

        None is a descent that `failed`, or one that led to a known region or too far out to count.
        """
        found = find_design_point(
            self.performance, self.threshold, self.dim, slopes=self.slopes, start=start,
            restarts=restarts,
        )  # fmt: skip
        self.values += found.n_simulations
        self.gradients += found.n_gradients
        self.failed = not found.converged
        if self.failed:
            return None if self.points else found
        new = not any(self._alike(found.point, p.point) for p in self.points)
        near = not self.points or found.beta < self.points[0].beta + FURTHER
        return found if new and near else None

    @staticmethod
    def _alike(a: np.ndarray, b: np.ndarray) -> bool:
        return float(a @ b) > ALIKE * float(np.linalg.norm(a) * np.linalg.norm(b))

    @property
    def known(self) -> tuple[np.ndarray, np.ndarray]:
        """Axes `[k, D]` and distances `[k]` of the regions."""
        axes = np.array([p.axis for p in self.points]).reshape(-1, self.dim)
        return axes, np.array([p.beta for p in self.points])


def probability_by_lines(
    performance: Performance,
    threshold: float,
    dim: int,
    *,
    key: Key[Array, ""],
    slopes: Slopes | None = None,
    scan: int = 200,
    most: int = 10,
    factor: float = 2.0,
    max_lines: int = 200,
) -> Regions:
    r"""Failure probability as the sum over regions, each by line sampling.

    .. math:: P \approx \sum_k P_k

    Regions are looked for in three ways: from nominal; on the side opposite to a region (one
    simulation); where the boundary bends towards nominal, beside the point in the direction in
    which it bends. `scan` wide samples (standard deviation beta / 1.7, so that a region of the
    same distance holds one in 22 of them) say whether failures lie beside all of them; from such
    a one a further design point is sought. A region that was seen once only, or not at all, says
    that there may be more, and so does the verdict.

    Args:
        performance: `x [n, D] -> y [n]`, larger is worse.
        threshold: failure is `y > threshold`.
        dim: D.
        key: random key.
        slopes: `x [n, D] -> (y [n], dy/dx [n, D])`.
        scan: wide samples; 0 trusts that there is one mechanism.
        most: regions at most.
        factor: wanted half width of each region's interval, as a ratio.
        max_lines: lines at most, of each region.

    Returns:
        Regions. The verdict is that of the regions, and says when failures beside them were seen.

    Raises:
        ValueError: a threshold that is not finite, no region allowed.

    Source: Koutsourelakis, Pradlwarter and Schueller (2004) for the lines; Ditlevsen (1979) for
    the sum, an upper bound that overlaps of rare regions hardly lower.
    """
    check_threshold(threshold)
    check_scan(scan)
    if most < 1:
        raise ValueError(f"most={most}: expected at least 1 region")
    finder = _Finder(performance, float(threshold), dim, slopes)
    counted = Counted(performance)
    keys = list(jax.random.split(key, most + 1))
    results: list[Estimate] = []

    def measure(point: DesignPoint) -> None:
        """Lines of a new region; further starts where it bends, and on the other side."""
        waiting = [point]
        while waiting and len(finder.points) < most:
            new = waiting.pop(0)
            if any(finder._alike(new.point, p.point) for p in finder.points):
                continue
            lines = sample_lines(
                performance, threshold, new, key=keys[len(results)], slopes=slopes, factor=factor,
                max_lines=max_lines,
            )  # fmt: skip
            finder.values += 0 if slopes else lines.estimate.n_simulations
            finder.gradients += lines.estimate.n_simulations if slopes else 0
            starts = []
            if lines.bend > BEND:
                aside = 0.5 * new.beta * lines.direction
                starts += [new.point + aside, new.point - aside]
            if lines.bend > 1.05 and any(
                nearer := [f for s in starts if (f := finder.find(s)) and f.beta < new.beta]
            ):
                # A saddle between nearer points: they take its place.
                waiting += nearer
                continue
            finder.points.append(new)
            results.append(lines.estimate)
            if opposite_sides_fail(counted, threshold, new.axis[None], np.array([new.beta]))[0]:
                starts.append(-new.beta * new.axis)
            waiting += [found for start in starts if (found := finder.find(start))]

    first = finder.find(None, restarts=2)
    assert first is not None
    if not np.all(np.isfinite(first.gradient)) or not np.any(first.gradient):
        spent = finder.values + finder.gradients
        nothing = Estimate(math.nan, 0.0, 1.0, spent, 0, 0.0, f"no design point: {first.verdict}")
        return Regions(nothing, [first], np.ones(1), finder.gradients)
    measure(first)
    doubts: list[str] = []
    if scan:
        with jax.enable_x64(True):
            wide = wide_scale(finder.points[0].beta)
            x = wide * np.asarray(jax.random.normal(keys[-1], (scan, dim)))
        seen = failing = x[fails(counted, threshold, x)]
        tried = 0
        # Where a first sample beside a region leads back to it, it is the region that bends. Before
        # that a way that fails is no sign that a sample is explained: a saddle has it, too.
        bends = False
        while len(failing := failing[beside(failing, *finder.known)]) and tried < most:
            one, failing = failing[0], failing[1:]
            if bends and explained(counted, threshold, one, *finder.known):
                continue
            tried += 1
            found = finder.find(onto_boundary(counted, float(threshold), one))
            if found is not None:
                measure(found)
            elif finder.failed:
                doubts.append("a wide sample fails beside all regions and leads to no design point")
            else:
                bends = True
        if len(failing) or len(finder.points) == most:
            doubts.append(f"there may be more than most={most} regions")
        rare = sum(int(np.sum(seen @ p.axis >= 0.5 * p.beta)) <= 1 for p in finder.points)
        if (rare and len(finder.points) > 1) or len(seen) == 0:
            doubts.append(
                f"{rare} of {len(finder.points)} regions were seen by at most one of {scan} wide "
                "samples, so there may be more; raise scan"
            )
    doubts += _connected(finder, counted, float(threshold))
    return _sum(finder, results, counted, doubts)


def _connected(finder: _Finder, counted: Counted, threshold: float) -> list[str]:
    """Are two regions one that bends as the sphere does: halfway between them it fails as well."""
    pairs = [
        (a, b)
        for k, a in enumerate(finder.points)
        for b in finder.points[:k]
        if float(a.axis @ b.axis) > -0.5 and abs(a.beta - b.beta) < 0.2
    ]
    for a, b in pairs[:20]:
        middle = a.axis + b.axis
        middle *= 1.01 * max(a.beta, b.beta) / float(np.linalg.norm(middle))
        if fails(counted, threshold, middle[None])[0]:
            return ["two regions are connected: failures lie on a whole arc, use subset_simulation"]
    return []


def _sum(finder: _Finder, results: list[Estimate], counted: Counted, doubts: list[str]) -> Regions:
    """Sum of the regions with its interval and verdict."""
    spent = finder.values + finder.gradients + counted.n_values
    estimate = add(results)
    invalid = estimate.n_invalid + counted.n_invalid
    if doubts:
        reasons = [] if estimate.known else [estimate.verdict]
        verdict = "; ".join([*reasons, *sorted(set(doubts))])
        estimate = estimate._replace(upper=1.0, verdict=verdict)
    estimate = estimate._replace(n_simulations=spent, n_invalid=invalid)
    p, total = np.array([e.probability for e in results]), estimate.probability
    order = np.argsort([point.beta for point in finder.points])
    shares = p[order] / total if total > 0 else np.zeros(len(p))
    return Regions(estimate, [finder.points[k] for k in order], shares, finder.gradients)
