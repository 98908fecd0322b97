"""Rows of record: a number with its interval, and the command, commit and seeds that made it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from snn_fusion_failure.records.intervals import interval
from snn_fusion_failure.runs import repository
from snn_fusion_failure.runs.files import write_json
from snn_fusion_failure.runs.origin import check_recordable, provenance


class Compared(NamedTuple):
    """Columns of a table that are compared seed by seed, in one metric."""

    metric: str
    pairs: tuple[tuple[str, str], ...]
    """(column, column that is taken from it)."""
    factor: float = 1.0
    """What makes points of the metric."""
    rows: tuple[str, ...] = ()
    """Only these rows; all when left out."""


def summarize(values: Sequence[float]) -> dict[str, Any]:
    """`n`, `mean`, `ci95` (Student's t interval of the mean) and the `values` themselves."""
    from snn_fusion_failure.records.statistics import mean_interval

    values = list(values)
    if len(values) == 1:
        return {"n": 1, "mean": values[0], "ci95": None, "values": values}
    found = mean_interval(values)
    return {"n": len(values), "mean": found.mean, "ci95": [found.low, found.high], "values": values}


def column_cells(
    by_seed: Mapping[int, Mapping[str, Any]], metrics: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Metric, unit, seeds and summary of every metric that all seeds of a column have.

    Args:
        by_seed: seed -> scores; a score that was not taken is missing, None or NaN.
        metrics: metric -> unit.
    """
    cells = []
    for metric, unit in metrics.items():
        values: list[Any] = [scores.get(metric) for scores in by_seed.values()]
        if not any(v is None or v != v for v in values):
            cell = {"metric": metric, "unit": unit, "seeds": list(by_seed)}
            cells.append(cell | summarize(values))
    return cells


def values_by_seed(cell: Mapping[str, Any]) -> dict[int, float]:
    """Seed -> value of a row of record; a row without `seeds` has those from 0 on."""
    values = cell.get("values", ())
    return dict(zip(cell.get("seeds", range(len(values))), values, strict=True))


def commits(records: Iterable[Mapping[str, Any]]) -> str:
    """The commits that made single runs, each once; '' where none is known."""
    named = {name for record in records for name in str(record.get("git", "")).split(", ")}
    return ", ".join(sorted(named - {""}))


def compare_columns(
    rows: Iterable[Mapping[str, Any]], compared: Iterable[Compared]
) -> list[dict[str, Any]]:
    """Differences between columns seed by seed, with Holm's correction over all of them.

    Args:
        rows: of a table of record.
        compared: what is compared; the first one's cases have the rows' names, those of others
            name the metric too. Pairs of fewer than two common seeds are left out.
    """
    from snn_fusion_failure.records.statistics import holm, paired_test

    held: dict[str, dict[tuple[str, str], dict[int, float]]] = {}
    for cell in rows:
        held.setdefault(cell["metric"], {})[cell["row"], cell["model"]] = values_by_seed(cell)
    found = []
    for place, (metric, pairs, factor, only) in enumerate(compared):
        columns = held.get(metric, {})
        for row in dict.fromkeys(name for name, _ in columns if not only or name in only):
            case = f"{row}, {metric.replace('_', ' ')}" if place else row
            for one, other in pairs:
                a, b = columns.get((row, one), {}), columns.get((row, other), {})
                if len(common := sorted(set(a) & set(b))) < 2:
                    continue
                test = paired_test(*([factor * t[s] for s in common] for t in (a, b)))
                found.append({"row": case, "comparison": f"{one} - {other}", **test._asdict()})
    for pair, p in zip(found, holm([pair["p_value"] for pair in found]), strict=True):
        pair["p_holm"] = p
    return found


def recorded(path: Path) -> list[dict[str, Any]]:
    """Rows of a table of record; none where it has not been written."""
    if not path.exists():
        return []
    rows: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["rows"]
    return rows


def record_table(
    path: Path,
    table: str,
    title: str,
    rows: Iterable[dict[str, Any]],
    *,
    preset: str,
    compared: Iterable[Compared] = (),
    whole_cells: bool = False,
) -> None:
    """Write or update a table of record; rows are replaced by (row, model, metric), others stay.

    With `whole_cells` rows are replaced by (row, model): a metric that a cell has no longer, such
    as the cost of successful runs where none succeeds now, goes with its old value.

    Every row keeps the command and the commit that made it. What is `compared` is worked out from
    all rows of the table, those of earlier commands too. The interval of a share is one that stays
    within 0 and 100 %; earlier rows that lack one get it, from their own mean and `n`.

    Numbers of code that was changed and not committed are refused in `results/`, and kept under
    `runs/refused/` instead, unless `SFF_ALLOW_DIRTY=1` is set; their `git` field ends in `-dirty`.

    Raises:
        ValueError: the rows belong into `results/`, and nobody could say which code made them.
    """
    made = provenance()
    rows = [{"command": made["command"], "git": made["git"], **row, **_ends(row)} for row in rows]
    if path.resolve().is_relative_to(repository.RECORD):
        try:
            check_recordable(f"record of {path.name}")
        except ValueError as error:
            # The work of hours is not thrown away over it.
            kept_in = Path("runs") / "refused" / path.name
            write_json(kept_in, {"table": table, "title": title, "preset": preset, "rows": rows})
            raise ValueError(f"{error}; the rows are kept in {kept_in}") from error

    def key(row: dict[str, Any]) -> tuple[Any, ...]:
        return row["row"], row["model"], row["metric"]

    parts = 2 if whole_cells else 3
    new = {key(row)[:parts] for row in rows}
    kept = [
        row if row.get("ci95") else {**row, **_ends(row)}
        for row in rows_with_origin(path)
        if key(row)[:parts] not in new
    ]
    held = {"table": table, "title": title, "preset": preset, **made, "rows": kept + rows}
    comparisons = compare_columns(held["rows"], compared)
    write_json(path, held | ({"comparisons": comparisons} if comparisons else {}))


def rows_with_origin(path: Path) -> list[dict[str, Any]]:
    """Rows of a table of record; those of old files, without a command, get their file's."""
    if not path.exists():
        return []
    held = json.loads(path.read_text(encoding="utf-8"))
    origin = {name: held[name] for name in ("command", "git") if name in held}
    return [origin | row for row in held["rows"]]


def _ends(row: dict[str, Any]) -> dict[str, Any]:
    return {"ci95": list(found)} if (found := interval(row)) is not None else {}


def record_comparisons(
    results: Path, table: str, title: str, rows: list[dict[str, Any]], *, preset: str
) -> None:
    """Write the paired comparisons of a table of record beside it, as `study_paired_N.json`."""
    write_json(
        results / f"study_paired_{table.replace('.', '_')}.json",
        {"table": table, "title": f"{title}: paired comparisons", "rows": rows, "preset": preset}
        | provenance(),
    )
