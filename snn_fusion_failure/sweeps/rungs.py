"""What comes next: growth of a design, rungs of successive halving, promotions of ASHA.

Everything follows from the plan and the chunk files, so that any process, after any number of kills
or repeated chunks, derives the same. A rung is derived again whenever the one below has changed;
what it then needs and is not planned yet becomes a new segment.

Source: Jamieson and Talwalkar (2016) for halving; Li et al. (2020), ASHA, for promotions.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from snn_fusion_failure.runs import to_jsonable
from snn_fusion_failure.sweeps.adaptive import ask
from snn_fusion_failure.sweeps.chunkfile import DamagedError
from snn_fusion_failure.sweeps.definition import MISSING, Segment, Sweep
from snn_fusion_failure.sweeps.designs import ADAPTIVE, digest
from snn_fusion_failure.sweeps.folder import done_chunks
from snn_fusion_failure.sweeps.plan import all_chunks, append_plan, read_plan, segments_of
from snn_fusion_failure.sweeps.results import Reader, setting_scores

Work = tuple[list[tuple[Any, ...]], list[dict[str, Any]]]


def check_halving(sweep: Sweep) -> None:
    """Refuse budgets that do not grow, or a study that cannot be cut.

    Raises:
        ValueError: names the budgets and what is expected.
    """
    if not sweep.budgets:
        return
    study = sweep.study
    if study is not None and study.with_budget is None and study.carry is None:
        raise ValueError(f"study {study.name} has no budget to cut; leave halving out")
    if list(sweep.budgets) != sorted(set(sweep.budgets)) or sweep.budgets[0] < 1:
        raise ValueError(
            f"halving={','.join(map(str, sweep.budgets))}: expected growing numbers of "
            f"{sweep.budget_text}"
        )
    if study is not None and study.carry is not None and sweep.budgets[-1] >= study.carry.total:
        raise ValueError(
            f"halving={','.join(map(str, sweep.budgets))}: expected less than the "
            f"{study.carry.total} {sweep.budget_text} of a whole trial"
        )
    if not 0.0 < sweep.keep < 1.0:
        raise ValueError(f"keep={sweep.keep}: expected a share between 0 and 1")
    if sweep.design.kind in ADAPTIVE:
        raise ValueError(f"halving={sweep.budgets[0]}: expected a grid, random or Sobol design")


def survivors(scores: np.ndarray, keep: float) -> np.ndarray:
    """Places of the best share of the settings, at least one; ties go to the earlier.

    Example:
        >>> survivors(np.array([1.0, 3.0, 3.0, 2.0]), 0.5).tolist()
        [1, 2]
    """
    count = max(1, math.ceil(keep * len(scores) - 1e-9))
    return np.sort(np.argsort(-scores, kind="stable")[:count])


def promotions(scores: np.ndarray, done: np.ndarray, keep: float) -> np.ndarray:
    """Places that ASHA promotes: among the best share of those that are done, however few.

    Example:
        >>> scores, done = np.array([1.0, 3.0, 2.0, 9.0]), np.array([True, True, True, False])
        >>> promotions(scores, done, 0.34).tolist()
        [1]
    """
    places = np.flatnonzero(done)
    count = int(keep * len(places) + 1e-9)
    best = places[np.argsort(-scores[places], kind="stable")[:count]]
    return np.sort(best[np.isfinite(scores[best])])


def planned(segments: Sequence[Segment], budget: int | None) -> dict[int, int]:
    """Setting -> seeds that are planned for it on a budget."""
    found: dict[int, int] = {}
    for segment in segments:
        if segment.budget == budget:
            for setting in segment.settings:
                found[setting] = max(found.get(setting, 0), segment.seeds[1])
    return found


def _segments(
    sweep: Sweep, rows: Sequence[Sequence[Any]], settings: Sequence[int], budget: int | None,
    have: dict[int, int],
) -> list[dict[str, Any]]:  # fmt: skip
    """Segments for what these settings lack, one per set of static values: each compiles once."""
    groups: dict[tuple[str, int], list[int]] = {}
    for setting in settings:
        first = have.get(setting, 0)
        if first < sweep.seeds:
            static = repr(sorted(sweep.static_values(rows[setting]).items()))
            groups.setdefault((static, first), []).append(int(setting))
    return [
        {"budget": budget, "settings": group, "seeds": [first, sweep.seeds]}
        for (_, first), group in groups.items()
    ]


def grow(sweep: Sweep) -> None:
    """Plan what the design and the seeds ask for and the folder does not hold yet.

    Raises:
        ValueError: the folder holds settings or seeds that are not asked for.
    """
    while True:
        plan = read_plan(sweep.out)
        held = [tuple(row) for part in plan for row in part["rows"]]
        known = {digest(sweep.leaves, row) for row in held}
        asked = {**sweep.design.describe(), "seeds": sweep.seeds}
        wanted = {digest(sweep.leaves, row): row for row in sweep.design.rows}
        before = plan[-1]["design"] if plan else None
        if before is not None:
            _refuse_less(sweep, before, len(held), len(known - wanted.keys()))
        fresh = [row for words, row in wanted.items() if words not in known]
        rows = [*held, *fresh]
        segments: list[dict[str, Any]] = []
        if sweep.design.kind not in ADAPTIVE and sweep.mode != "asha":
            budget = sweep.budgets[0] if sweep.budgets else None
            have = planned(segments_of(plan), budget)
            segments = _segments(sweep, rows, range(len(rows)), budget, have)
        same = before is not None and _as_json(before) == _as_json(asked)
        if same and not fresh and not segments:
            return
        if append_plan(sweep, fresh, segments, after=len(plan)):
            return


def _as_json(value: Any) -> str:
    return json.dumps(to_jsonable(value), sort_keys=True)


def _refuse_less(sweep: Sweep, before: dict[str, Any], n_held: int, gone: int) -> None:
    if sweep.seeds < before["seeds"]:
        raise ValueError(
            f"seeds={sweep.seeds}: expected at least the {before['seeds']} that out={sweep.out} "
            "holds; a sweep can grow, not shrink; choose another --out for less"
        )
    if sweep.design.kind in ADAPTIVE:
        if sweep.design.samples < n_held:
            raise ValueError(
                f"samples={sweep.design.samples}: expected at least the {n_held} that "
                f"out={sweep.out} holds; a sweep can grow, not shrink"
            )
        ranges = [[a[k] for k in ("leaf", "low", "high", "log")] for a in before["axes"]]
        wanted = [[a.leaf, a.low, a.high, a.log] for a in sweep.design.axes]
        if ranges != wanted:
            raise ValueError(
                f"out={sweep.out}: holds an adaptive sweep of other ranges ({ranges} -> {wanted}); "
                "give the same, or choose another --out"
            )
        return
    if gone:
        old, new = _axes_text(before["axes"]), _axes_text(sweep.design.axes)
        raise ValueError(
            f"out={sweep.out}: holds {gone} settings that are not asked for ({before['kind']} "
            f"{old} seed {before['seed']} -> {sweep.design.kind} {new} seed {sweep.design.seed}); "
            "a sweep can grow, not shrink or move: list the old values too, choose another --out, "
            "or --overwrite to delete it"
        )


def _axes_text(axes: Any) -> str:
    parts = []
    for axis in axes:
        a = axis if isinstance(axis, dict) else axis._asdict()
        few = ",".join(str(v) for v in a["values"][:4]) + (",..." if len(a["values"]) > 4 else "")
        parts.append(f"{a['leaf']}={few or '{:g}:{:g}'.format(a['low'], a['high'])}")
    return " ".join(parts)


def derive(sweep: Sweep, reader: Reader, *, idle: bool = False) -> Work | None:
    """What has to be planned next, or None when nothing has.

    Args:
        sweep: as its folder has it.
        reader: of the chunks.
        idle: work is left, but others have it; only ASHA finds more to do then.

    Raises:
        DamagedError: the checksum of a chunk is wrong.
    """
    plan = read_plan(sweep.out)
    rows = [tuple(row) for part in plan for row in part["rows"]]
    segments = segments_of(plan)
    if sweep.mode == "asha" and sweep.budgets:
        promoted = _asha(sweep, reader, rows, segments, idle=idle)
        if promoted or idle:
            return ([], promoted) if promoted else None
    if idle:
        return None
    if sweep.budgets:
        for budget, above in zip(sweep.budgets, [*sweep.budgets[1:], None], strict=True):
            have = planned(segments, budget)
            settings = np.asarray(sorted(have))
            scores = _scores(sweep, reader, segments, len(rows), budget)[settings]
            kept = settings[survivors(scores, sweep.keep)]
            lacking = _segments(sweep, rows, kept.tolist(), above, planned(segments, above))
            if lacking:
                return [], lacking
    if sweep.design.kind in ADAPTIVE and len(rows) < sweep.design.samples:
        found = reader.found(sweep, segments, len(rows), None)
        goal = sweep.metrics[sweep.objective].goal
        values = found.metrics[sweep.objective]
        scores = setting_scores(values, found.status, goal, sweep.min_valid)
        count = min(sweep.batch, sweep.design.samples - len(rows))
        fresh = ask(sweep, rows, scores, count)
        known = [*rows, *fresh]
        new = range(len(rows), len(known))
        return fresh, _segments(sweep, known, new, None, planned(segments, None))
    if sweep.design.kind in ADAPTIVE:
        # More seeds than when a setting was asked for.
        lacking = _segments(sweep, rows, range(len(rows)), None, planned(segments, None))
        return ([], lacking) if lacking else None
    return None


def _scores(
    sweep: Sweep, reader: Reader, segments: Sequence[Segment], n: int, budget: int | None
) -> np.ndarray:
    """How all settings stand on a budget."""
    found = reader.found(sweep, segments, n, budget)
    name = sweep.objective if budget is None else sweep.rung_objective
    goal = sweep.metrics[name].goal
    return setting_scores(found.metrics[name], found.status, goal, sweep.min_valid)


def _asha(
    sweep: Sweep, reader: Reader, rows: Sequence[Any], segments: Sequence[Segment], *, idle: bool
) -> list[dict[str, Any]]:
    """A promotion where there is one, from the top; else the next settings of the lowest rung."""
    ladder = [*sweep.budgets, None]
    for below, above in reversed(list(itertools.pairwise(ladder))):
        have = planned(segments, below)
        if not have:
            continue
        settings = np.asarray(sorted(have))
        found = reader.found(sweep, segments, len(rows), below)
        done = (found.status[settings] != MISSING).all(axis=1)
        scores = _scores(sweep, reader, segments, len(rows), below)[settings]
        best = settings[promotions(scores, done, sweep.keep)]
        lacking = _segments(sweep, rows, best.tolist(), above, planned(segments, above))
        if lacking:
            return lacking
    have = planned(segments, sweep.budgets[0])
    left = [i for i in range(len(rows)) if have.get(i, 0) < sweep.seeds]
    at_once = max(1, sweep.chunk_trials // sweep.seeds)
    return _segments(sweep, rows, left[:at_once], sweep.budgets[0], have)


def next_work(sweep: Sweep, reader: Reader, *, idle: bool = False) -> bool:
    """Plan what follows; False when the sweep is complete (or there is nothing for the idle)."""
    after = len(read_plan(sweep.out))
    work = derive(sweep, reader, idle=idle)
    if work is None:
        return False
    append_plan(sweep, work[0], work[1], after=after)
    return True


def is_complete(sweep: Sweep, reader: Reader | None = None) -> bool:
    """Whether all planned chunks are there and no more follows from them."""
    chunks = {(s.number, c) for s, c in all_chunks(sweep)}
    if not chunks <= done_chunks(sweep.out):
        return False
    try:
        return bool(chunks) and derive(sweep, reader or Reader(sweep.out)) is None
    except DamagedError:
        return False
