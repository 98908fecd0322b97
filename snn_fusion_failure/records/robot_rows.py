"""Drivers, PPO and the shortest path beside Tables 2.3 to 2.5: rows of other files of record."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from snn_fusion_failure.records.rows import record_table, recorded
from snn_fusion_failure.runs import repository

Row = dict[str, Any]

CASES = {"2.3": "Scenario 1", "2.4": "Scenario 2", "2.5": "Scenario 3"}
"""Number of a table -> its row in the files of record."""


class Beside(NamedTuple):
    """Rows of a file that stand beside a table."""

    file: str
    models: dict[str, str]
    """Model there -> name in the table."""
    metrics: dict[str, str]
    """Metric there -> column of the table."""


_SAME = ("sr_learning", "sr_testing", "n_mv", "path_ratio")
BESIDE = (
    Beside(
        "study_detour",
        {"blind": "blind", "reflex_60": "reflex 60", "reflex_100": "reflex 100"},
        {name: name for name in _SAME},
    ),
    Beside("study_rl", {"PPO": "PPO"}, {name: name for name in _SAME}),
    Beside("study_families", {"planner": "shortest path"}, {"path_shortest": "path"}),
)


def beside(results: Path, table: str, case: str) -> tuple[list[Row], str]:
    """Rows of drivers and learners that belong to a table, and a sentence where they come from.

    Args:
        results: folder of the files of record.
        table: number of the table, such as "2.3".
        case: what the rows of the table are called there.

    Returns:
        The rows, named as in the table, without the source's numbers; and the sentence. Both are
        empty for other tables, and where no file has such rows.
    """
    found: list[Row] = []
    listed = []
    for file, models, metrics in BESIDE if table in CASES else ():
        rows = [
            {key: value for key, value in row.items() if key != "source"}
            | {"row": case, "model": models[row["model"]], "metric": metrics[row["metric"]]}
            for row in recorded(results / f"{file}.json")
            if row["row"] == CASES[table] and row["model"] in models and row["metric"] in metrics
        ]
        if rows:
            names = ", ".join(dict.fromkeys(row["model"] for row in rows))
            listed.append(f"{names} from `results/{file}.json`")
            found += rows
    return found, f"On the same map: {'; '.join(listed)}." if listed else ""


_UNITS = {"sr": "%", "share": "%", "n_mv": "steering movements", "path": "1"}
"""Unit of the metrics that begin so; all others are counted in trials."""


def record_learner(model: str, row: str, summary: Row, preset: str) -> None:
    """Rows of one map of a learner into results/; in the source's table, too, where it has one.

    Args:
        model: as the source calls it.
        row: name of the map in the files of record.
        summary: metric -> mean, interval and number.
        preset: size of the run.
    """
    table = {case: number for number, case in CASES.items()}.get(row)
    source_file = repository.RESULTS / "source_tables.json"
    source = json.loads(source_file.read_text())[table]["rows"].get(model, {}) if table else {}
    cells = []
    for metric, numbers in summary.items():
        unit = next((u for start, u in _UNITS.items() if metric.startswith(start)), "trials")
        cell = {"row": row, "model": model, "metric": metric, "unit": unit, **numbers}
        cells.append(cell | ({"source": source[metric]} if metric in source else {}))
    title = "Q-learning and PPO on Scenarios 1-3 and the detours D1-D3"
    path = repository.RESULTS / "study_rl.json"
    record_table(path, "study_rl", title, cells, preset=preset, whole_cells=True)
    if table and model == "Q-learning":
        path = repository.RESULTS / f"table_{table.replace('.', '_')}.json"
        theirs = [c for c in cells if c["metric"] in ("sr_learning", "sr_testing", "n_mv")]
        record_table(path, table, row, theirs, preset=preset)
