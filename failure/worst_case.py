"""Worst-case points of several specifications by values alone: where each begins to fail.

For a simulator that is known by its values only, say a netlist: differences at the nominal circuit,
then for each specification the nearest failing point by Hasofer-Lind steps, all specifications side
by side, so that parallel workers have something to do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

Evaluate = Callable[[np.ndarray], np.ndarray]
"""`x [n, d] -> g [n, k]`: violations, above 0 where a specification fails, NaN where unknown."""

COSINE = 0.98
"""A point is a worst-case point when its direction and the gradient there agree this well."""

GAP = 0.05
"""...and when it lies this near to the limit, in units of the nominal distance to it."""


class BudgetSpentError(RuntimeError):
    """More simulations were asked for than the budget holds."""


class Archive:
    """All samples of an analysis, each simulated once and counted against a budget."""

    def __init__(self, evaluate: Evaluate, dim: int, budget: int) -> None:
        self._evaluate = evaluate
        self.budget = budget
        self.x = np.zeros((0, dim))
        self.g: np.ndarray | None = None
        self.labels: list[str] = []
        self.spent = 0
        self._known: dict[bytes, np.ndarray] = {}

    @property
    def left(self) -> int:
        """Simulations that the budget still holds."""
        return self.budget - self.spent

    def add(self, x: Float[np.ndarray, "n d"], g: Float[np.ndarray, "n k"], label: str) -> None:
        """Samples that are known already, at no cost."""
        self.x = np.concatenate([self.x, x])
        self.g = g if self.g is None else np.concatenate([self.g, g])
        self.labels += [label] * len(x)
        self._known.update((row.tobytes(), values) for row, values in zip(x, g, strict=True))

    def __call__(self, x: Float[np.ndarray, "n d"], label: str) -> Float[np.ndarray, "n k"]:
        """Violations of new samples.

        Raises:
            BudgetSpentError: the budget does not hold them.
        """
        x = np.asarray(x, np.float64)
        new = np.array([row for row in x if row.tobytes() not in self._known])
        if len(new) > self.left:
            raise BudgetSpentError(f"{len(new)} simulations wanted, {self.left} left")
        if len(new):
            g = np.asarray(self._evaluate(new), np.float64)
            if g.ndim != 2 or len(g) != len(new):
                raise ValueError(f"violations of shape {g.shape}: expected [{len(new)}, k]")
            self.spent += len(new)
            self.add(new, g, label)
        if len(x) == 0 and self.g is not None:
            return np.zeros((0, self.g.shape[1]))
        return np.array([self._known[row.tobytes()] for row in x])


class Region(NamedTuple):
    """A failure region of one specification, by its worst-case point.

    Attributes:
        spec: column of the violations.
        point: `[d]`, on or just beyond the limit.
        slope: `[d]`, gradient of the violation there.
        gap: violation at the point.
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


def slopes_at(
    archive: Archive, points: Float[np.ndarray, "p d"], base: Float[np.ndarray, "p k"], step: float
) -> Float[np.ndarray, "p k d"]:
    r"""Forward differences of all violations at several points, in one batch.

    .. math:: \partial_i g \approx (g(u + h e_i) - g(u)) / h

    Args:
        archive: evaluates.
        points: u.
        base: g(u).
        step: h [sigma].
    """
    p, d = points.shape
    moved = (points[:, None] + step * np.eye(d)[None]).reshape(-1, d)
    g = archive(moved, "difference").reshape(p, d, -1)
    return np.nan_to_num((g - base[:, None]) / step).transpose(0, 2, 1)


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-300))


def _along_rays(
    archive: Archive,
    specs: np.ndarray,
    directions: np.ndarray,
    lengths: np.ndarray,
    nominal: np.ndarray,
    reach: float,
) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, "p"]]:
    """Where each ray meets its limit: (lengths, violations of all specifications there, failed)."""
    p = len(specs)
    rows = np.arange(p)
    tried = np.minimum(lengths[:, None] * np.array([0.8, 1.0, 1.25, 1.6]), reach)
    g = archive((tried[..., None] * directions[:, None]).reshape(p * 4, -1), "ray")
    g = g.reshape(p, 4, -1)
    own = np.nan_to_num(g[rows, :, specs], nan=-1.0)
    ts = np.concatenate([np.zeros((p, 1)), tried], 1)
    gs = np.concatenate([nominal[specs][:, None], own], 1)
    best_t, best_g = np.zeros(p), np.zeros((p, g.shape[2]))
    failed = np.asarray((gs > 0.0).any(1))
    for _ in range(3):
        t = np.empty(p)
        for k in range(p):
            order = np.argsort(ts[k])
            t_k, g_k = ts[k][order], gs[k][order]
            above = np.flatnonzero(g_k > 0.0)
            if len(above) == 0:
                t[k] = t_k[-1]
                continue
            j = int(above[0])
            share = -g_k[j - 1] / max(g_k[j] - g_k[j - 1], 1e-300)
            t[k] = t_k[j - 1] + min(max(share, 0.05), 0.95) * (t_k[j] - t_k[j - 1])
        full = archive(t[:, None] * directions, "ray")
        value = np.nan_to_num(full[rows, specs], nan=-1.0)
        ts, gs = np.concatenate([ts, t[:, None]], 1), np.concatenate([gs, value[:, None]], 1)
        best_t, best_g = t, full
        failed |= value > 0.0
        if np.all((np.abs(value) < 0.2 * GAP) | ~failed):
            break
    return best_t, best_g, failed


def worst_case_points(
    archive: Archive,
    nominal: Float[np.ndarray, "k"],
    specs: Float[np.ndarray, "p"] | list[int],
    starts: Float[np.ndarray, "p d"],
    *,
    reach: float = 8.0,
    iterations: int = 4,
    step: float = 0.5,
) -> list[Region]:
    r"""The nearest failing point of specifications, each from a start direction.

    .. math:: u' = \frac{\nabla g \cdot u - g}{|\nabla g|^2} \nabla g

    gives the next direction; along it the limit is found by a bracketed secant; there the gradient
    is taken again. A point is done when direction and gradient agree.

    Args:
        archive: evaluates.
        nominal: violations at 0, all below 0.
        specs: column of each start.
        starts: `[p, d]`, where the first rays point to; their lengths are first guesses.
        reach: no farther out than this [sigma].
        iterations: rays at most.
        step: of the differences [sigma].

    Returns:
        One region per start, as good as it could be made.

    Source: Hasofer and Lind (1974); Rackwitz and Fiessler (1978).
    """
    columns = np.asarray(specs, int)
    found: dict[int, Region] = {}
    active = np.flatnonzero(np.linalg.norm(starts, axis=1) > 0.0)
    target = np.array(starts, np.float64)
    for _ in range(iterations):
        if active.size == 0:
            break
        lengths = np.linalg.norm(target[active], axis=1)
        directions = target[active] / lengths[:, None]
        try:
            lengths, g, failed = _along_rays(
                archive, columns[active], directions, np.clip(lengths, 0.5, reach), nominal, reach
            )
            points = lengths[:, None] * directions
            slopes = slopes_at(archive, points, g, step)
        except BudgetSpentError:
            break
        still = []
        for row, k in enumerate(active.tolist()):
            spec = int(columns[k])
            slope, value = slopes[row, spec], float(np.nan_to_num(g[row, spec], nan=1.0))
            region = Region(
                spec, points[row], slope, value, _cosine(points[row], slope), bool(failed[row])
            )
            held = found.get(k)
            better = held is None or (region.failed, -region.distance) > (
                held.failed, -held.distance,
            )  # fmt: skip
            if better or region.converged:
                found[k] = _onto_limit(region)
            norm2 = float(slope @ slope)
            # Far from the limit at the end of the reach: the next ray will not meet it either.
            hopeless = not region.failed and value < -0.5 and lengths[row] >= 0.99 * reach
            if region.converged or hopeless or norm2 < 1e-20:
                continue
            target[k] = (slope @ points[row] - value) / norm2 * slope
            still.append(k)
        active = np.asarray(still, int)
    return [found[k] for k in sorted(found)]


def _onto_limit(region: Region) -> Region:
    """A converged point moved along its direction to where its slope puts the limit."""
    a = region.point / max(region.distance, 1e-300)
    rate = float(region.slope @ a)
    if not region.converged or rate <= 0.0:
        return region
    return region._replace(point=region.point - region.gap / rate * a)


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
    slopes = _first_slopes(archive, known_x, known_g, nominal)
    specs: list[int] = []
    starts: list[np.ndarray] = []
    for k in range(len(nominal)):
        norm2 = float(slopes[k] @ slopes[k])
        own: list[np.ndarray] = []
        if norm2 > 1e-12:
            own.append(-nominal[k] / norm2 * slopes[k])
        if known_g is not None:
            failing = known_x[known_g[:, k] > 0.0]
            for point in failing[np.argsort(np.linalg.norm(failing, axis=1))]:
                if len(own) < 3 and all(_cosine(point, other) < alike for other in own):
                    own.append(point)
        specs += [k] * len(own)
        starts += own
    if not starts:
        return nominal, []
    regions = worst_case_points(archive, nominal, specs, np.array(starts), reach=reach)
    return nominal, merge_regions(regions, alike=alike)


def merge_regions(regions: list[Region], *, alike: float = 0.8) -> list[Region]:
    """Regions with a failure, one per direction and specification, the nearest first."""
    kept: list[Region] = []
    for region in sorted(regions, key=lambda r: r.distance):
        twin = (r.spec == region.spec and _cosine(r.point, region.point) > alike for r in kept)
        if region.failed and not any(twin):
            kept.append(region)
    return kept


def _first_slopes(
    archive: Archive, x: np.ndarray, g: np.ndarray | None, nominal: np.ndarray
) -> Float[np.ndarray, "k d"]:
    """Slopes about the nominal circuit: from known samples where there are enough."""
    dim = archive.x.shape[1]
    if g is not None and len(x) >= 3 * (dim + 1):
        good = np.all(np.isfinite(g), axis=1)
        if int(good.sum()) >= 3 * (dim + 1):
            design = np.concatenate([x[good], np.ones((int(good.sum()), 1))], axis=1)
            return np.linalg.lstsq(design, g[good], rcond=None)[0][:-1].T
    return slopes_at(archive, np.zeros((1, dim)), nominal[None], 1.0)[0]
