"""Successive halving: after a few units of training only the best settings go on.

Which settings go on is a function of the files of the rung below, and a trial that goes on is run
from its start with its own key: what a surviving trial ends with is, to the bit, what it would have
ended with in the full sweep.
"""

from __future__ import annotations

import math

import numpy as np

from snn_fusion_failure.sweeps.folder import Sweep, chunk_path, done_chunks, load_chunk

__all__ = ["check_halving", "scores", "survivors"]


def check_halving(sweep: Sweep) -> None:
    """Refuse budgets that do not grow, or a study that cannot be cut.

    Raises:
        ValueError: names the budgets and what is expected.
    """
    if not sweep.budgets:
        return
    if sweep.study.with_budget is None:
        raise ValueError(f"study {sweep.study.name} has no budget to cut; leave --halving out")
    if list(sweep.budgets) != sorted(set(sweep.budgets)) or sweep.budgets[0] < 1:
        raise ValueError(
            f"halving at {', '.join(map(str, sweep.budgets))}: expected growing numbers of "
            f"{sweep.study.budget_text}"
        )
    if not 0.0 < sweep.keep < 1.0:
        raise ValueError(f"keep = {sweep.keep}: expected a share between 0 and 1")


def scores(sweep: Sweep, budget: int, trials: np.ndarray) -> np.ndarray:
    """Mean of the objective over the seeds of each setting of a complete rung, larger is better.

    A seed without a finite number counts as the worst that was seen.
    """
    assert sweep.study.with_budget is not None
    study = sweep.study.with_budget(budget)
    sign = 1.0 if study.metrics[study.objective].goal == "max" else -1.0
    value: dict[int, float] = {}
    for number in sorted(done_chunks(sweep, budget)):
        held = load_chunk(chunk_path(sweep, number, budget), [study.objective])
        value |= dict(zip(held["trial"].tolist(), sign * held[study.objective], strict=True))
    found = np.asarray([value[int(t)] for t in trials], np.float64)
    finite = np.isfinite(found)
    worst = found[finite].min() if finite.any() else 0.0
    found = np.where(finite, found, worst)
    # All seeds broken: behind every setting with one that works.
    means = found.reshape(-1, sweep.seeds).mean(axis=1)
    return np.where(finite.reshape(-1, sweep.seeds).any(axis=1), means, -math.inf)


def survivors(scores: np.ndarray, settings: np.ndarray, keep: float) -> np.ndarray:
    """The best share of the settings, at least one, in their old order; ties go to the earlier.

    Example:
        >>> survivors(np.array([1.0, 3.0, 3.0, 2.0]), np.array([4, 5, 6, 7]), 0.5).tolist()
        [5, 6]
    """
    count = max(1, math.ceil(keep * len(settings) - 1e-9))
    order = np.argsort(-scores, kind="stable")[:count]
    return settings[np.sort(order)]
