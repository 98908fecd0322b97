"""Files of a netlist analysis: tables as CSV, decks of the worst cases, earlier samples."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def write_table(path: Path, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A CSV file; numbers with ten digits."""

    def cell(value: Any) -> Any:
        return f"{value:.10g}" if isinstance(value, float | np.floating) else value

    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(head)
        writer.writerows([cell(value) for value in row] for row in rows)


def read_start(path: Path, simulator: Any) -> tuple[np.ndarray, np.ndarray]:
    """Earlier samples: (in sigma `[n, d]`, violations `[n, k]`).

    Args:
        path: CSV with a column per varied parameter, in its unit; where it has a column for every
            measure as well (and there is one corner), nothing is simulated again.
        simulator: NetlistSimulator.
    Raises:
        ValueError: a column is missing, or a row is no row of numbers, named.
    """
    if not path.is_file():
        raise FileNotFoundError(f"start={str(path)!r}: expected a file; there is none")
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        head, *rows = [row for row in csv.reader(file) if row] or [[]]
    columns = {name.strip().lower(): k for k, name in enumerate(head)}
    missing = [name for name in simulator.variation.names if name not in columns]
    if missing or not rows:
        raise ValueError(
            f"start={str(path)!r}: expected samples under a line of names; missing: "
            f"{', '.join(missing) or 'samples'}"
        )

    def table(names: Sequence[str]) -> np.ndarray:
        values = []
        for number, row in enumerate(rows, start=2):
            try:
                values.append([float(row[columns[name]]) for name in names])
            except (ValueError, IndexError) as error:
                raise ValueError(f"start={str(path)!r}, line {number}: {error}") from error
        return np.array(values)

    physical = table(simulator.variation.names)
    corner = simulator.corners[0]
    nominal = simulator.values_at(np.zeros((1, physical.shape[1])), corner)[0]
    x = simulator.variation.standard(physical, nominal)
    bad = np.flatnonzero(~np.all(np.isfinite(x), axis=1))
    if bad.size:
        raise ValueError(f"start={str(path)!r}, line {bad[0] + 2}: expected finite parameters")
    if len(simulator.corners) == 1 and all(name in columns for name in simulator.names):
        return x, simulator.violations(table(simulator.names)[:, None]).max(axis=1)
    return x, simulator(x)[0]


def shares(variation: Any, point: np.ndarray) -> np.ndarray:
    r"""Share of each parameter in a worst case, `[d]`, sum 1.

    .. math:: s_i = z_i (L^{-T} u)_i / |u|^2, \qquad z = L u

    which is :math:`u_i^2 / |u|^2` for independent parameters.
    """
    factor = variation.factor
    z = factor @ point
    pull = np.linalg.solve(factor.T, point)
    return z * pull / max(float(point @ point), 1e-300)


def _estimate(value: Any) -> dict[str, Any]:
    return {
        "probability": value.probability,
        "lower": value.lower,
        "upper": value.upper,
        "dppm": 1e6 * value.probability,
        "verdict": value.verdict,
    }


def write(out: Path, simulator: Any, found: Any) -> dict[str, Any]:
    """All tables and decks of an analysis.

    Args:
        out: run folder.
        simulator: NetlistSimulator.
        found: `failure.yield_analysis.Analysis`.
    Returns:
        What `result.json` holds.
    """
    names, corners = simulator.variation.names, simulator.corners
    archive = found.archive
    specs, parameters = [], []
    for k, (limit, spec) in enumerate(zip(simulator.limits, found.specs, strict=True)):
        record: dict[str, Any] = {
            "spec": limit.text,
            "nominal": float(simulator.nominal[0, simulator.names.index(limit.name)]),
            "distance": spec.distance if spec.regions else None,
            **_estimate(spec.estimate),
            "by_lines": _estimate(spec.lines) if spec.lines else None,
            "by_mixture": _estimate(spec.mixture),
            "regions": len(spec.regions),
        }
        if spec.regions:
            region = spec.regions[0]
            point = _inside(region.point, k, simulator)
            values, _ = simulator.measure(point[None])
            violations = simulator.violations(values)[0, :, k]
            worst = int(np.nanargmax(violations))
            physical = simulator.values_at(point[None], corners[worst])[0]
            share = shares(simulator.variation, region.point)
            deck = out / f"worst_{re.sub(r'[^A-Za-z0-9.-]+', '_', limit.text)}.cir"
            deck.write_text(simulator.deck_of(point, corners[worst]), encoding="utf-8")
            record.update(
                corner=corners[worst].name,
                deck=deck.name,
                verified=bool(region.converged),
                value=float(values[0, worst, simulator.names.index(limit.name)]),
                worst=dict(zip(names, physical.tolist(), strict=True)),
                shares=dict(zip(names, share.tolist(), strict=True)),
            )
            factor = simulator.variation.factor
            sigmas = (factor @ region.point).tolist()
            ranked = sorted(zip(names, share, sigmas, physical, strict=True), key=lambda r: -r[1])
            parameters += [[limit.text, n, 100.0 * s, z, p] for n, s, z, p in ranked]
        specs.append(record)
    union = _estimate(found.union)
    distances = [s["distance"] for s in specs if s["distance"] is not None]
    at_nominal = [
        {
            "corner": corner.name,
            **dict(zip(simulator.names, map(float, simulator.nominal[c]), strict=True)),
        }
        for c, corner in enumerate(corners)
    ]
    keys = ("nominal", "distance", "probability", "lower", "upper", "dppm", "verdict", "corner")
    write_table(
        out / "specs.csv", ["spec", *keys, "deck"],
        [[s["spec"], *(s.get(k) for k in keys), s.get("deck")] for s in specs],
    )  # fmt: skip
    write_table(
        out / "parameters.csv", ["spec", "parameter", "share_percent", "sigma", "value"], parameters
    )
    write_table(
        out / "corners.csv", ["corner", *simulator.names], [list(c.values()) for c in at_nominal]
    )
    _write_samples(out / "samples.csv", simulator, archive)
    return {
        "specs": specs,
        "yield": {**union, "yield": 1.0 - union["probability"]},
        "worst_distance": min(distances) if distances else math.inf,
        "corners": at_nominal,
        "simulations": archive.spent,
        "started": simulator.simulations,
    }


def _inside(point: np.ndarray, spec: int, simulator: Any) -> np.ndarray:
    """The point itself where it fails, else a little farther out."""
    for stretch in (1.0, 1.01, 1.03, 1.1):
        if simulator(stretch * point[None])[0][0, spec] > 0.0:
            return stretch * point
    return point


def _write_samples(path: Path, simulator: Any, archive: Any) -> None:
    """Every sample: what it was for, parameters, measures in the first corner, violations."""
    physical = simulator.values_at(archive.x, simulator.corners[0])
    # What is in the cache costs nothing; earlier samples keep their measures in their own file.
    new = np.array([label != "start" for label in archive.labels])
    measured = np.full((len(new), 1, len(simulator.names)), np.nan)
    measured[new] = simulator.measure(archive.x[new])[0][:, :1]
    head = ["what_for", *simulator.variation.names, *simulator.names]
    head += [f"violation {limit.text}" for limit in simulator.limits]
    columns = (archive.labels, physical.tolist(), measured[:, 0].tolist(), archive.g.tolist())
    write_table(path, head, ([label, *p, *m, *g] for label, p, m, g in zip(*columns, strict=True)))


def summary(result: dict[str, Any]) -> list[str]:
    """What a terminal shows: a line per specification, one for the yield."""
    lines = []
    for s in result["specs"]:
        distance = "no failure seen" if s["distance"] is None else f"{s['distance']:.2f} sigma"
        p, low, high = s["probability"], s["lower"], s["upper"]
        known = (
            f"P {p:.2g} [{low:.2g}, {high:.2g}]"
            if p is not None and not math.isnan(p)
            else (f"P below {high:.2g}")
        )
        lines.append(f"{s['spec']:<24} {distance:<16} {known}  {s['verdict']}")
    y = result["yield"]
    if not math.isnan(y["probability"]):
        lines.append(
            f"all specifications: yield {100.0 * y['yield']:.6g} %, {y['dppm']:.4g} DPPM "
            f"[{1e6 * y['lower']:.3g}, {1e6 * y['upper']:.3g}]  {y['verdict']}"
        )
    return lines
