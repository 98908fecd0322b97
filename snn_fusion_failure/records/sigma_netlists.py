"""Rows of the table at fixed probability whose circuit is a netlist: known through ngspice only."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from snn_fusion_failure.records.sigma_cases import Case, cached
from snn_fusion_failure.runs import repository

LINES = 100
"""Lines behind the probability of each region; every one costs two or three runs of ngspice."""

WEIGHTED = 1500
"""Samples of the importance sampling that checks it."""


class NetlistRow(NamedTuple):
    """A netlist of `examples/`, what varies, and what must stay below the threshold."""

    file: str
    vary: tuple[str, ...]
    worst_of: tuple[tuple[float, str], ...]
    """(factor, measure): the output is the largest of their products."""


NETLISTS = {
    "memory_cell": NetlistRow(
        "sram_cell.cir",
        ("pu1:20m", "pd1:20m", "ax1:20m", "pu2:20m", "pd2:20m", "ax2:20m"),
        ((-1.0, "snm1"), (-1.0, "snm2")),
    ),
    "opamp_settling": NetlistRow(
        "opamp.cir",
        ("dvt1:2m", "dvt2:2m", "dvt3:3m", "dvt4:3m", "w6:2%", "w7:2%", "cc:5%", "rz:10%", "rl:1%"),
        ((1e9, "tset"),),
    ),
    "opamp_offset": NetlistRow(
        "opamp.cir",
        ("dvt1:2m", "dvt2:2m", "dvt3:3m", "dvt4:3m", "w6:2%", "w7:2%", "cc:5%", "rz:10%", "rl:1%"),
        ((1.0, "offset"), (-1.0, "offset")),
    ),
}
"""Name in the table -> netlist: read margin of both halves of a memory cell [mV], settling time of
an operational amplifier [ns], its offset in a window [mV]."""


def outputs_of(row: NetlistRow) -> Callable[[Any], Any]:
    """`x [n, D] in sigma -> [n, k]`, the terms of a row's output by ngspice; NaN where missing."""
    import numpy as np

    from failure.simulators.deck import read_deck
    from failure.simulators.measures import Limit
    from failure.simulators.netlist_simulator import NetlistSimulator
    from failure.simulators.variation import parse_variation

    simulator = NetlistSimulator(
        read_deck(repository.ROOT / "examples" / row.file),
        parse_variation(row.vary),
        [Limit(name, -math.inf, math.inf) for _, name in row.worst_of],
        workers=2,
    )
    factors = np.array([factor for factor, _ in row.worst_of])
    columns = [simulator.names.index(name) for _, name in row.worst_of]

    def outputs(x: Any) -> Any:
        values, _ = simulator.measure(np.asarray(x, np.float64))
        return factors * values[:, 0, columns]

    return outputs


def netlist_case(name: str, p: float, folder: Path) -> Case:
    """A netlist at the threshold of a wanted probability."""
    import numpy as np

    row = NETLISTS[name]
    outputs = outputs_of(row)
    dim, terms = len(row.vary), len(row.worst_of)

    def performance(x: Any) -> Any:
        return outputs(x).max(axis=1)

    def term(k: int) -> Callable[[Any], Any]:
        return lambda x: outputs(x)[:, k]

    target = cached(
        folder / f"threshold_{name}_{p:.0e}.json",
        lambda: measured_threshold([term(k) for k in range(terms)], performance, dim, p),
    )
    return Case(
        f"{name} P={p:.0e}", performance, None, target["threshold"], dim,
        target["probability"], np.asarray(target["points"]), performance,
        tuple(target["interval"]),
    )  # fmt: skip


def measured_threshold(
    terms: list[Callable[[Any], Any]], worst: Callable[[Any], Any], dim: int, p: float
) -> dict[str, Any]:
    r"""The threshold at which the terms together fail with probability p; what it is there.

    Every term has a region of its own, and with rare failures no sample is in two of them:

    .. math:: P = \sum_k P_k(T), \qquad P_k \text{ by lines from the term's own design point}

    Args:
        terms: `x [n, D] -> y [n]`, each.
        worst: the largest of them.
        dim: D.
        p: wanted.
    Returns:
        Threshold, probability and interval there, design points, importance sampling of `worst`
        from all of them as a check, verdict.
    """
    import jax
    import numpy as np
    from scipy.stats import norm

    from failure.estimates import GOOD
    from failure.hlrf import find_design_point
    from failure.lines import line_sampling
    from failure.performances import Counted
    from failure.rare_events import importance_sampling

    reach, origin = float(norm.isf(p)), np.zeros(dim)

    def measured(threshold: float, lines: int) -> tuple[list[Any], list[Any]]:
        designs, found = [], []
        for k, term in enumerate(terms):
            designs.append(find_design_point(term, threshold, dim))
            found.append(
                line_sampling(
                    term, threshold, designs[-1], key=jax.random.key(7 + k),
                    min_lines=lines, max_lines=lines, scan=0,
                )
            )  # fmt: skip
        return designs, found

    starts = []
    for term in terms:
        counted = Counted(term)
        y = float(counted(origin[None])[0])
        starts.append(y + reach * float(np.linalg.norm(counted.differences(origin, y, 0.3))))
    threshold = max(starts)
    for _ in range(4):
        designs, found = measured(threshold, 20)
        gap = reach - float(norm.isf(sum(f.probability for f in found)))
        if abs(gap) < 0.02:
            break
        nearest = min(designs, key=lambda d: d.beta)
        threshold += gap * float(np.linalg.norm(nearest.gradient))
    designs, found = measured(threshold, LINES)
    points = np.stack([d.point for d in designs])
    check = importance_sampling(worst, threshold, points, key=jax.random.key(9), n=WEIGHTED, scan=0)
    verdicts = [f.verdict for f in found if f.verdict != GOOD]
    return {
        "threshold": threshold, "probability": sum(f.probability for f in found),
        "interval": [sum(f.lower for f in found), sum(f.upper for f in found)],
        "points": points, "beta": [d.beta for d in designs],
        "check": check.probability, "check_interval": [check.lower, check.upper],
        "verdict": "; ".join(verdicts) or GOOD,
    }  # fmt: skip
