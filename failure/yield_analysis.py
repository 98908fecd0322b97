"""From a simulator and a budget to worst-case distances, failure probabilities and the yield."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from failure.archive import Archive
from failure.estimates import Estimate, add
from failure.exploration import explore
from failure.lines import line_sampling
from failure.worst_case import Region, find_regions
from failure.yields import Mixture, mixture_sampling


@dataclass(frozen=True)
class AnalysisConfig:
    """Budget of an analysis and how it is spent.

    Attributes:
        n_total: simulations in all.
        reach: nothing is looked for farther out [sigma].
        line_share: of what is left after the worst-case points, for line sampling; the rest goes
            to the mixture.
        max_lines: lines per region at most; more would not make a better number.
    """

    n_total: int = 1000
    reach: float = 8.0
    line_share: float = 0.5
    max_lines: int = 200

    def __post_init__(self) -> None:
        if self.n_total < 10:
            raise ValueError(f"n_total={self.n_total}: expected at least 10 simulations")
        if not 1.0 < self.reach <= 20.0:
            raise ValueError(f"reach={self.reach}: expected a distance from 1 to 20 sigma")
        if not 0.0 < self.line_share < 1.0:
            raise ValueError(f"line_share={self.line_share}: expected a share between 0 and 1")
        if self.max_lines < 2:
            raise ValueError(f"max_lines={self.max_lines}: expected at least 2")


class SpecAnalysis(NamedTuple):
    """What is known of one specification.

    Attributes:
        regions: failure regions, the nearest first; empty where no failure was seen.
        estimate: its failure probability; the interval covers both estimates where they disagree.
        lines: by line sampling.
        mixture: by the mixture.
    """

    regions: list[Region]
    estimate: Estimate
    lines: Estimate | None
    mixture: Estimate

    @property
    def distance(self) -> float:
        """Worst-case distance [sigma]; infinite where no failure was seen."""
        return self.regions[0].distance if self.regions else math.inf


class Analysis(NamedTuple):
    """Result of `analyse`; `archive` holds every sample, violations over their nominal size."""

    nominal: Float[np.ndarray, "k"]
    specs: list[SpecAnalysis]
    union: Estimate
    archive: Archive


def analyse(
    config: AnalysisConfig,
    evaluate: Callable[[np.ndarray], np.ndarray],
    dim: int,
    *,
    start: tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n k"]] | None = None,
    key: Key[Array, ""],
) -> Analysis:
    """Worst-case points, failure probabilities and yield of a simulator that gives values only.

    The budget goes to the worst-case points, to a look for further regions, to lines through the
    regions, and to a mixture of normals about all of them.

    Args:
        config: budget.
        evaluate: `x [n, d] -> g [n, k]`: above 0 where a specification fails.
        dim: number of parameters.
        start: samples that are known already.
        key: random key.

    Raises:
        ValueError: the nominal circuit fails, or the budget does not hold a difference per
            parameter.

    Example:
        >>> def simulate(x):
        ...     return np.stack([x[:, 0] - 4.0, -x[:, 1] - 4.5], axis=1)
        >>> found = analyse(AnalysisConfig(n_total=400), simulate, 3, key=jax.random.key(0))
        >>> [round(spec.distance, 2) for spec in found.specs]
        [4.0, 4.5]
    """
    if config.n_total < dim + 10:
        raise ValueError(
            f"n_total={config.n_total}: expected at least {dim + 10}: one simulation per parameter "
            "for the first slopes, and some"
        )
    origin = np.zeros((1, dim))
    at_origin = np.asarray(evaluate(origin), np.float64)
    if at_origin.ndim != 2 or len(at_origin) != 1 or not np.all(at_origin < 0.0):
        raise ValueError(
            f"violations at the nominal circuit {at_origin.tolist()}: expected one row [1, k] "
            "below 0; a nominal circuit that fails has no rare failures"
        )
    # Relative to the nominal distance from the limit: no number below depends on a unit.
    scale = np.abs(at_origin[0])
    archive = Archive(lambda x: np.asarray(evaluate(x), np.float64) / scale, dim, config.n_total)
    archive.add(origin, at_origin / scale, "nominal")
    archive.spent = 1
    if start is not None:
        archive.add(start[0], start[1] / scale, "start")
    nominal, regions = find_regions(archive, dim, reach=config.reach)
    n_specs = len(nominal)
    key_explore, key_lines, key_mixture = jax.random.split(key, 3)
    found = explore(
        archive, nominal, regions, archive.left // 5, reach=config.reach, key=key_explore
    )
    found = [*found, *_seen(archive, found, n_specs)]
    lines: dict[int, Estimate] = {}
    measured = _apart(found)
    if measured:
        share = int(config.line_share * archive.left / (2.5 * len(measured)))
        # Fewer than ten lines say little: then the mixture has to wait.
        most = int(0.9 * archive.left / (3 * len(measured)))
        count = min(max(share, min(10, most)), config.max_lines)
        for k in measured if count >= 3 else []:
            lines[k] = line_sampling(
                archive.violation(found[k].spec, "line"), 0.0, found[k].design,
                min_lines=count, max_lines=count, scan=0,
                key=jax.random.fold_in(key_lines, k),
            )  # fmt: skip
    mixture = mixture_sampling(archive, found, archive.left, n_specs, key=key_mixture)
    specs = [_of_spec(k, found, lines, mixture, config.reach) for k in range(n_specs)]
    return Analysis(at_origin[0], specs, _of_any(specs, mixture), archive)


def _seen(archive: Archive, regions: list[Region], n_specs: int) -> list[Region]:
    """For specifications without a region, the nearest failing sample there is, not verified."""
    more = []
    for k in range(n_specs):
        if archive.g is None or any(r.spec == k for r in regions):
            continue
        failing = np.flatnonzero(archive.g[:, k] > 0.0)
        if failing.size:
            nearest = failing[np.argmin(np.linalg.norm(archive.x[failing], axis=1))]
            point, gap = archive.x[nearest], float(archive.g[nearest, k])
            more.append(Region(k, point, np.zeros_like(point), gap, 0.0, True))
    return more


def _apart(regions: list[Region]) -> list[int]:
    """Verified regions whose probabilities add up: the nearest of each specification, opposites."""
    chosen: list[int] = []
    for k, region in enumerate(regions):
        own = [regions[j] for j in chosen if regions[j].spec == region.spec]
        opposite = all(r.point @ region.point < 0.0 for r in own)
        if region.converged and opposite:
            chosen.append(k)
    return chosen


def _of_spec(
    spec: int,
    regions: list[Region],
    lines: dict[int, Estimate],
    mixture: Mixture,
    reach: float,
) -> SpecAnalysis:
    own = [k for k, r in enumerate(regions) if r.spec == spec]
    other = mixture.specs[spec]
    mine = [k for k in own if k in lines]
    found = [regions[k] for k in own]
    if not found and math.isnan(other.probability):
        other = other._replace(verdict=f"no failing sample within {reach:g} sigma")
    if not mine:
        if found and other.verdict == "good":
            # Away from the nearest failing point the weights are more uneven than they look.
            width = math.sqrt(other.upper / other.lower)
            other = other._replace(
                lower=other.lower / width,
                upper=min(1.0, other.upper * width),
                verdict="the nearest failing point is not verified",
            )
        return SpecAnalysis(found, other, None, other)
    # Opposite regions add up.
    by_lines = add([lines[k] for k in mine])
    estimate = by_lines
    mean, lower, upper = by_lines[:3]
    known = not (math.isnan(mean) or math.isnan(other.probability))
    if math.isnan(mean):
        estimate = other
    elif len(own) > len(mine) and other.verdict == "good":
        # Regions that overlap: the mixture counts each failure once.
        estimate = other
    elif known and (other.lower > upper or other.upper < lower) and other.verdict == "good":
        estimate = by_lines._replace(
            lower=min(lower, other.lower),
            upper=max(upper, other.upper),
            verdict=f"two estimates disagree: {mean:.2g} by lines, {other.probability:.2g} by the "
            "mixture; raise n_total",
        )
    elif len(own) > len(mine):
        estimate = by_lines._replace(verdict="further regions overlap; raise n_total")
    return SpecAnalysis(found, estimate, by_lines, other)


def _of_any(specs: list[SpecAnalysis], mixture: Mixture) -> Estimate:
    """Probability of failing any specification: the sum, corrected for what fails together."""
    estimates = [s.estimate for s in specs]
    known = [e for e in estimates if not math.isnan(e.probability)]
    if not known:
        return mixture.union
    total = sum(e.probability for e in known)
    trusted = 0.0 < mixture.overlap <= 1.0 and mixture.union.verdict == "good"
    overlap = mixture.overlap if trusted else 1.0
    mean = overlap * total
    lower = max(e.lower for e in known)
    upper = min(1.0, sum(e.upper for e in known))
    bad = [e.verdict for e in estimates if e.verdict != "good"]
    if not trusted:
        bad.append("specifications may fail together: an upper bound")
    # The relative width of the sum, about the corrected mean.
    relative = [((e.upper / e.lower) if e.lower > 0 else 1e3, e.probability) for e in known]
    spread = math.sqrt(sum((math.log(w) / 2 * p) ** 2 for w, p in relative)) / max(total, 1e-300)
    width = math.exp(min(spread, 700.0))
    lower, upper = max(min(lower, mean), mean / width), min(upper, mean * width)
    verdict = bad[0] if bad else "good"
    n, effective = mixture.union.n_simulations, min(e.n_effective for e in known)
    return Estimate(mean, min(lower, mean), max(upper, mean), n, 0, effective, verdict)
