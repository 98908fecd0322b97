"""Rows of record: a number with its interval, and the command, commit and seeds that made it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.records.intervals import interval
from snn_fusion_failure.runs import repository
from snn_fusion_failure.runs.files import write_json
from snn_fusion_failure.runs.origin import check_recordable, provenance


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
    """Metric, unit and summary of every metric that all seeds of a column have.

    Args:
        by_seed: seed -> scores; a score that was not taken is missing, None or NaN.
        metrics: metric -> unit.
    """
    cells = []
    for metric, unit in metrics.items():
        values: list[Any] = [scores.get(metric) for scores in by_seed.values()]
        if not any(v is None or v != v for v in values):
            cells.append({"metric": metric, "unit": unit} | summarize(values))
    return cells


def compare_columns(
    held: Mapping[tuple[str, str], Mapping[int, Mapping[str, Any]]],
    pairs: Iterable[tuple[str, str]],
    metric: str = "accuracy",
) -> list[dict[str, Any]]:
    """Differences between columns seed by seed, with Holm's correction over all of them.

    Args:
        held: (row, column) -> seed -> scores.
        pairs: (column, column that is taken from it); pairs of fewer than two common seeds are
            left out.
        metric: the score that is compared.
    """
    from snn_fusion_failure.records.statistics import holm, paired_test

    chosen, found = list(pairs), []
    for row in dict.fromkeys(name for name, _ in held):
        for one, other in chosen:
            a, b = held.get((row, one), {}), held.get((row, other), {})
            if len(common := sorted(set(a) & set(b))) < 2:
                continue
            test = paired_test(*([t[s][metric] for s in common] for t in (a, b)))
            found.append({"row": row, "comparison": f"{one} - {other}", **test._asdict()})
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
    comparisons: list[dict[str, Any]] | None = None,
) -> None:
    """Write or update a table of record; rows are replaced by (row, model, metric), others stay.

    Every row keeps the command and the commit that made it, and `comparisons` are those of
    `compare_columns`; the interval of a share is one that
    stays within 0 and 100 %. Numbers of code that was changed and not committed are refused in
    `results/`, and kept under `runs/refused/` instead, unless `SFF_ALLOW_DIRTY=1` is set; their
    `git` field ends in `-dirty`.

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

    new = {key(row) for row in rows}
    kept = [row for row in recorded(path) if key(row) not in new]
    held = {"table": table, "title": title, "preset": preset, **made, "rows": kept + rows}
    write_json(path, held | ({"comparisons": comparisons} if comparisons else {}))


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
