"""What is planned in a sweep's folder: settings and segments, in parts that are only appended."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.runs import provenance, to_jsonable
from snn_fusion_failure.runs.files import create_once
from snn_fusion_failure.sweeps.definition import Segment, Sweep


def read_plan(out: Path) -> list[dict[str, Any]]:
    """All parts of the plan, in order."""
    folder = out / "plan"
    if not folder.is_dir():
        return []
    names = sorted(n for n in os.listdir(folder) if n.endswith(".json") and not n.startswith("."))
    return [json.loads((folder / name).read_text(encoding="utf-8")) for name in names]


def append_plan(
    sweep: Sweep,
    rows: Sequence[Sequence[Any]],
    segments: Sequence[Mapping[str, Any]],
    *,
    after: int,
) -> bool:
    """Append settings and segments; of several processes one does.

    Args:
        sweep: its design and seeds are noted as what is asked for now.
        rows: settings that are new.
        segments: `budget`, `settings` and `seeds` of each new segment.
        after: parts of the plan that this follows from.

    Returns:
        Whether this call did; otherwise the plan has to be read again.
    """
    text = {
        "design": {**sweep.design.describe(), "seeds": sweep.seeds},
        "rows": rows,
        "segments": list(segments),
        "command": provenance()["command"],
    }
    path = sweep.out / "plan" / f"{after:06d}.json"
    return create_once(path, json.dumps(to_jsonable(text), allow_nan=False) + "\n")


def segments_of(plan: Sequence[Mapping[str, Any]]) -> list[Segment]:
    """The segments of a plan, numbered."""
    found: list[Segment] = []
    for part in plan:
        for s in part["segments"]:
            found.append(Segment(len(found), s["budget"], tuple(s["settings"]), tuple(s["seeds"])))
    return found


def all_chunks(sweep: Sweep) -> list[tuple[Segment, int]]:
    """Every chunk that is planned, in order."""
    segments = segments_of(read_plan(sweep.out))
    return [(s, number) for s in segments for number in range(s.n_chunks(sweep))]
