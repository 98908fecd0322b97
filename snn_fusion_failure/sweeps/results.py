"""What the chunks of a sweep say so far: numbers by setting and seed, and how settings stand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.sweeps.chunkfile import load_chunk
from snn_fusion_failure.sweeps.definition import MISSING, Segment, Sweep, valid
from snn_fusion_failure.sweeps.folder import chunk_name, chunk_path, done_chunks


@dataclasses.dataclass
class Found:
    """Numbers of all settings on one budget.

    Attributes:
        metrics: name -> `[settings, seeds]`, NaN where there is none.
        status: `[settings, seeds]`.
        source: `[settings, seeds]`, index into `sources`, -1 where there is none.
        sources: fingerprints of what made the chunks.
        seconds: of computing.
        messages: (setting, seed) -> what went wrong.
        notes: what chunks have to tell.
        devices: on which they were made.
    """

    metrics: dict[str, np.ndarray]
    status: np.ndarray
    source: np.ndarray
    sources: list[str]
    seconds: float
    messages: dict[tuple[int, int], str]
    notes: list[str]
    devices: list[str]


class Reader:
    """Reads chunk files, each once: they are never changed."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self._held: dict[str, dict[str, Any]] = {}
        self._skipped: set[str] = set()

    def skip(self, path: Path) -> None:
        """Leave a damaged file out of everything that is read."""
        self._skipped.add(path.stem)

    def skips(self, segment: int, number: int) -> bool:
        """Whether a chunk is left out."""
        return chunk_name(segment, number) in self._skipped

    def chunk(self, segment: int, number: int) -> dict[str, Any]:
        """A chunk's arrays.

        Raises:
            DamagedError: its checksum is wrong.
        """
        name = chunk_name(segment, number)
        if name not in self._held:
            self._held[name] = load_chunk(chunk_path(self.out, segment, number))
        return self._held[name]

    def found(
        self, sweep: Sweep, segments: Sequence[Segment], n_settings: int, budget: int | None
    ) -> Found:
        """All numbers of one budget.

        Raises:
            DamagedError: the checksum of a chunk is wrong.
        """
        shape = (n_settings, sweep.seeds)
        metrics = {name: np.full(shape, np.nan) for name in sweep.metrics}
        made = Found(
            metrics, np.full(shape, MISSING, np.int8), np.full(shape, -1, np.int16), [], 0.0, {},
            [], [],
        )  # fmt: skip
        budgets = {s.number: s.budget for s in segments}
        for number, chunk in sorted(done_chunks(self.out)):
            if number not in budgets or self.skips(number, chunk):
                continue
            held = self.chunk(number, chunk)
            about = held["about"]
            made.seconds += about["seconds"]
            at = (held["trial"][:, 0], held["trial"][:, 1])
            for note in about["notes"]:
                made.notes.append(f"chunk {chunk_name(number, chunk)}: {note}")
            if about["device"] not in made.devices:
                made.devices.append(about["device"])
            for place, message in about["messages"].items():
                setting, seed = held["trial"][int(place)]
                made.messages[int(setting), int(seed)] = message
            if budgets[number] != budget:
                continue
            if about["source"] not in made.sources:
                made.sources.append(about["source"])
            made.status[at] = held["status"]
            made.source[at] = made.sources.index(about["source"])
            for name in metrics:
                if name in held:
                    metrics[name][at] = held[name]
        return made


def setting_scores(
    values: np.ndarray, status: np.ndarray, goal: str, min_valid: float
) -> np.ndarray:
    """Mean of the objective over the valid seeds of each setting, larger is better, `[settings]`.

    Minus infinity where fewer than the share `min_valid` of the seeds is valid: what is left of a
    setting of which most trials broke says nothing about it. Ranking, halving and adaptive designs
    all go by this number.

    Example:
        >>> status = np.array([[0, 0], [0, 1]])
        >>> setting_scores(np.array([[1.0, 2.0], [9.0, np.nan]]), status, "max", 0.75).tolist()
        [1.5, -inf]
    """
    counts = valid(status, values)
    sign = 1.0 if goal == "max" else -1.0
    number = counts.sum(axis=1)
    total = np.where(counts, values, 0.0).sum(axis=1)
    enough = (number >= min_valid * values.shape[1] - 1e-9) & (number > 0)
    return np.where(enough, sign * total / np.maximum(number, 1), -math.inf)
