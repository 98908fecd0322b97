"""What a sweep is: its settings, how its trials are dealt out, how a trial can end."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.runs import to_jsonable
from snn_fusion_failure.sweeps.designs import Design, digest
from snn_fusion_failure.sweeps.study import Metric, Study

OK, NON_FINITE, FAILED, MISSING = 0, 1, 2, 3
STATUS = ("ok", "non-finite", "failed", "missing")
SCHEME = 2
"""How keys follow from settings; numbers of another scheme are another sweep."""


@dataclasses.dataclass(frozen=True)
class Segment:
    """Settings times seeds on one budget, in chunks: what was planned at one time.

    Attributes:
        number: of the segment in its folder.
        budget: units of training; None: all of them.
        settings: numbers of settings, all with the same static values.
        seeds: the first, and one after the last.
    """

    number: int
    budget: int | None
    settings: tuple[int, ...]
    seeds: tuple[int, int]

    @functools.cached_property
    def trials(self) -> np.ndarray:
        """Setting and seed of each trial, `[n, 2]`."""
        seeds = np.arange(*self.seeds)
        settings = np.asarray(self.settings, np.int64)
        return np.stack([np.repeat(settings, len(seeds)), np.tile(seeds, len(settings))], 1)

    def n_chunks(self, sweep: Sweep) -> int:
        """Chunks of this segment."""
        return -(-len(self.settings) * (self.seeds[1] - self.seeds[0]) // sweep.chunk_trials)

    def chunk(self, sweep: Sweep, number: int) -> np.ndarray:
        """Trials of a chunk."""
        return self.trials[number * sweep.chunk_trials : (number + 1) * sweep.chunk_trials]


@dataclasses.dataclass(frozen=True)
class Sweep:
    """A sweep as its folder has it.

    Attributes:
        out: the folder.
        study: what a trial is; None where the folder is only looked at.
        design: what was asked for last.
        seeds: trials per setting.
        root: seed of all keys.
        chunk_trials: trials per file.
        width: trials side by side on a device.
        budgets: units of training after which settings are dropped; empty without halving.
        keep: share of the settings that stay at each of them.
        mode: `halving` waits for a whole rung, `asha` promotes whenever there is something to.
        common: seed k draws the same numbers in every setting.
        min_valid: share of a setting's seeds that must be valid for it to be ranked.
        batch: settings that an adaptive design asks for at a time.
        metrics, objective, budget_text: of the study.
        rung_objective: what settings are ranked by before they have all of their training.
        study_name, options, where: from which the study is made again.
        allow_mixed: chunks of other sources may stand beside.
        lease: seconds after which a silent worker's chunk is taken over.
    """

    out: Path
    study: Study | None
    design: Design
    seeds: int
    root: int = 0
    chunk_trials: int = 1
    width: int = 1
    budgets: tuple[int, ...] = ()
    keep: float = 0.25
    mode: str = "halving"
    common: bool = False
    min_valid: float = 0.75
    batch: int = 8
    metrics: Mapping[str, Metric] = dataclasses.field(default_factory=dict)
    objective: str = ""
    rung_objective: str = ""
    budget_text: str = ""
    study_name: str = ""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    where: str | None = None
    allow_mixed: bool = False
    lease: float = 60.0

    @property
    def leaves(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(axis.leaf for axis in self.design.axes)

    @property
    def static(self) -> tuple[str, ...]:
        """Names of the axes that compile anew."""
        return tuple(axis.leaf for axis in self.design.axes if axis.kind == "static")

    def static_values(self, row: Sequence[Any]) -> dict[str, Any]:
        """The static values of a setting."""
        return {a.leaf: v for a, v in zip(self.design.axes, row, strict=True) if a.kind == "static"}

    def columns(self, rows: Sequence[Sequence[Any]]) -> dict[str, np.ndarray]:
        """Numbers of the traced axes for some settings, in the axes' units."""
        found = {}
        for i, axis in enumerate(self.design.axes):
            if axis.kind == "category":
                found[axis.leaf] = np.asarray([axis.values.index(row[i]) for row in rows], float)
            elif axis.kind != "static":
                found[axis.leaf] = np.asarray([row[i] for row in rows], np.float64)
        return found

    def words(self, rows: Sequence[Sequence[Any]]) -> np.ndarray:
        """The words that keys are folded from, `[n, 2]` uint32."""
        found = [digest(self.leaves, row) for row in rows]
        return np.asarray(found, np.uint32).reshape(-1, 2)

    def settings(self) -> dict[str, Any]:
        """What cannot change while the sweep grows, JSON values."""
        value = {
            "scheme": SCHEME,
            "study": self.study_name,
            "options": self.options,
            "axes": [
                {"leaf": a.leaf, "unit": a.unit, "kind": a.kind} for a in self.design.axes
            ],
            # Labels are counted: another order would be another meaning.
            "labels": {a.leaf: a.values for a in self.design.axes if a.kind == "category"},
            "root": self.root,
            "common_seeds": self.common,
            "halving": {"budgets": self.budgets, "keep": self.keep, "mode": self.mode,
                        "min_valid": self.min_valid} if self.budgets else None,
            "adaptive": {"kind": self.design.kind, "batch": self.batch, "seed": self.design.seed,
                         "min_valid": self.min_valid}
            if self.design.kind in ("tpe", "cma", "gp") else None,
        }  # fmt: skip
        return dict(json.loads(json.dumps(to_jsonable(value))))


def valid(status: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Trials that count in a mean: they ended well, with a finite number."""
    return (status == OK) & np.isfinite(values)
