"""Single runs from the tables of record, so that a clone can add seeds to them.

A training costs up to a minute and its file stays on the machine that made it; its scores are in
`results/`, seed by seed. Written back as files, they are not trained again. What the tables do not
hold (accuracies of single test subjects, single fusion weights) is absent from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.records import fusion_tables
from snn_fusion_failure.records.rows import rows_with_origin, values_by_seed
from snn_fusion_failure.runs import write_json

Held = dict[tuple[str, str, int], dict[str, Any]]
"""(row, model, seed) -> metric -> value, and `git`."""


def unseen_case(table: str, row: str, kind: str | None = None) -> str:
    """Row of the study of unseen kinds: a case of a table, under one kind of failure or all."""
    return f"Table {table}, trained on {row}" + (f", tested on {kind}" if kind else "")


def channel_case(table: str, row: str, channel: str) -> str:
    """Row of Figure 3.7 in numbers."""
    return f"Table {table}, {row}: {channel}"


def _robustness(run: fusion_tables.Run, unseen: Held) -> dict[str, Any]:
    """Accuracy under each kind that is never trained on; nothing unless all are held."""
    found = {}
    for kind in fusion_tables.UNSEEN_KINDS:
        case = unseen_case(run.table, run.row.name, kind)
        value = unseen.get((case, run.model, run.seed), {}).get("accuracy")
        if value is None:
            return {}
        found[kind] = value
    return {"robustness": found}


def _channel(run: fusion_tables.Run, weights: Held) -> dict[str, Any]:
    """Fusion weights of the channel of Figure 3.7; their means are all that is held."""
    channel = run.row.channel or ""
    found: dict[str, Any] = {}
    for when in ("when_failed", "when_clean"):
        case = channel_case(run.table, run.row.name, channel)
        value = weights.get((case, run.model, run.seed), {}).get(f"weight_{when}")
        if value is None:
            return {}
        found[when] = [value]
    return {"channel": {"name": channel, "means_only": True, **found}}


def held_scores(path: Path) -> Held:
    """The single runs that a table of record holds; none where it has not been written."""
    held: Held = {}
    for row in rows_with_origin(path):
        for seed, value in values_by_seed(row).items():
            record = held.setdefault((row["row"], row["model"], seed), {"git": row.get("git", "")})
            record[row["metric"]] = value
    return held


def restore(tables: Sequence[str], results: Path, out: Path, seeds: int) -> int:
    """Write the single runs that `results` holds and `out` lacks; returns their number.

    Args:
        tables: their numbers, of 3.1 to 3.6.
        results: folder of the tables of record.
        out: folder of the single runs; what is there stays as it is.
        seeds: seeds below this number.
    """
    unseen = held_scores(results / "study_unseen_kinds.json")
    weights = held_scores(results / "study_channel_weights.json")
    written = 0
    for table in tables:
        held = held_scores(results / f"table_{table.replace('.', '_')}.json")
        for run in fusion_tables.runs(table, seeds):
            scores = held.get((run.row.name, run.model, run.seed), {})
            if "accuracy" not in scores or run.path(out).exists():
                continue
            more = _robustness(run, unseen) | _channel(run, weights)
            write_json(run.path(out), scores | more)
            written += 1
    return written
