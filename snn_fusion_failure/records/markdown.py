"""Results of record as Markdown: tables with intervals, the source's number and what they say."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from snn_fusion_failure.records.intervals import interval

Row = dict[str, Any]
Table = dict[str, Any]

LOWER_IS_BETTER = frozenset({"n_mv", "path", "first_failure_hit"})
"""Metrics where a smaller number is the better one."""

SPREAD_LINE = (
    "Each cell: mean [95 % interval over seeds] (n), then the source's printed number and whether "
    "ours is *better*, *worse*, or the source's number lies *within* the interval; with one seed "
    "there is no interval and the means are compared. The interval is Student's; that of a share "
    "(success rate, accuracy, AUROC) is Wilson's with the number of trials that gives the spread "
    "over the seeds, so that it stays within 0 and 100 %. *Not comparable*: the two numbers do not "
    "measure the same thing; the reason stands below the table's heading."
)


def number(value: Any, unit: str = "") -> str:
    """A number for a table: two decimals for shares and percent, else four digits."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if not isinstance(value, int | float):
        return str(value)
    if unit == "%":
        return f"{value:.2f}"
    if unit == "1":
        return f"{value:.3f}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


CENTRES = {"first_failure_hit": "median"}
"""Scores that are judged by another centre than their mean: the mean of the searches that found a
failure says nothing of those that did not, while the median over all searches counts them."""


def mark(row: Row, centre: str = "mean") -> str | None:
    """`better`, `within` or `worse` than the source's number; None without a comparable one.

    Args:
        row: `metric`, `source`, `mean` and `ci95` or `values`; `not_comparable` from
            :func:`comparability.annotated`.
        centre: what `mean` is: the "mean" over seeds, as in the rows of record, or their "median".
    """
    source, mean = row.get("source"), row.get("mean")
    if not isinstance(source, int | float) or mean is None or row.get("not_comparable"):
        return None
    if CENTRES.get(row["metric"], "mean") != centre:
        return None
    ends = interval(row)
    if ends is not None and ends[0] <= source <= ends[1]:
        return "within"
    if mean == source:
        return "within"
    lower = row["metric"] in LOWER_IS_BETTER
    return "better" if (mean < source) == lower else "worse"


def cell(row: Row | None, with_unit: bool = False) -> str:
    """One cell: mean, interval, n, source and mark."""
    if row is None:
        return ""
    unit = row.get("unit", "")
    text = f"**{number(row.get('mean'), unit)}**"
    if (ends := interval(row)) is not None:
        text += f" [{number(ends[0], unit)}, {number(ends[1], unit)}]"
    if with_unit and unit not in ("", "1"):
        text += f" {unit}"
    if "n" in row:
        text += f" ({row['n']})"
    if "source" in row:
        verdict = "not comparable" if row.get("not_comparable") else mark(row)
        text += f"<br>source {number(row['source'], unit)}" + (f", *{verdict}*" if verdict else "")
    return text


def grid(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    rows = [list(header), ["---"] * len(header), *(list(line) for line in lines)]
    return "\n".join("| " + " | ".join(text.replace("|", "\\|") for text in r) + " |" for r in rows)


def distinct(rows: Iterable[Row], field: str) -> list[str]:
    """Values of a field in the order in which they come."""
    return list(dict.fromkeys(str(row[field]) for row in rows))


def pivot(rows: Sequence[Row], down: str, across: str, with_unit: bool = False) -> str:
    """Rows of record as a table of `down` x `across`."""
    held = {(str(row[down]), str(row[across])): row for row in rows}
    columns = distinct(rows, across)
    return grid(
        [down.replace("row", "case"), *columns],
        (
            [name, *(cell(held.get((name, c)), with_unit) for c in columns)]
            for name in distinct(rows, down)
        ),
    )


def measured(rows: Sequence[Row], source: Table | None = None) -> str:
    """All metrics of a table: cases x models for each metric, or models x metrics of one case.

    Args:
        rows: of a table of record.
        source: the source's table; orders cases and models as the source does.
    """
    rows = in_order(rows, source)
    metrics = distinct(rows, "metric")
    cases = distinct(rows, "row")
    if len(cases) == 1 and len(metrics) > 1:
        return f"{cases[0]}:\n\n" + pivot(rows, "model", "metric", with_unit=True)
    parts = []
    for metric in metrics:
        chosen = [row for row in rows if row["metric"] == metric]
        units = {row.get("unit", "") for row in chosen}
        one = units.pop() if len(units) == 1 else ""
        title = metric.replace("_", " ") + ("" if one in ("", "1") else f" [{one}]")
        # Cases of one metric may come in units of their own; each cell then names its unit.
        parts.append(f"**{title}**\n\n" + pivot(chosen, "row", "model", with_unit=not one))
    return "\n\n".join(parts)


def in_order(rows: Sequence[Row], source: Table | None) -> list[Row]:
    """Rows in the order of the source's cases and models; what it has not comes after."""
    if source is None:
        return list(rows)
    order = {name: i for i, name in enumerate([*source["rows"], *source.get("columns", ())])}
    last = len(order)
    return sorted(
        rows, key=lambda row: (order.get(row["row"], last), order.get(row["model"], last))
    )


def provenance(table: Table) -> str:
    """How a file of record was made."""
    versions = ", ".join(f"{k} {v}" for k, v in table.get("versions", {}).items())
    commands = list(
        dict.fromkeys(
            row.get("command") or table.get("command") or "" for row in table.get("rows") or [{}]
        )
    )
    listed = ", ".join(f"`{command}`" for command in commands if command)
    parts = [
        f"Command{'s' if len(commands) > 1 else ''}: {listed}" if listed else "",
        f"preset {table['preset']}" if table.get("preset") else "",
        f"commit {table['git']}" if table.get("git") else "",
        str(table.get("device", "")),
        versions,
        str(table.get("date", "")),
    ]
    return "; ".join(part for part in parts if part) + "."


def tally(rows: Iterable[Row]) -> dict[str, int]:
    """Number of cells per mark."""
    counts = {"better": 0, "within": 0, "worse": 0}
    for row in rows:
        verdict = mark(row)
        if verdict is not None:
            counts[verdict] += 1
    return counts


def tally_line(rows: Sequence[Row]) -> str:
    """How many cells are better, within, worse, and which are not comparable, and why."""
    counts = tally(rows)
    total = sum(counts.values())
    why: dict[str, int] = {}
    for row in rows:
        if "source" in row and row.get("not_comparable"):
            why[row["not_comparable"]] = why.get(row["not_comparable"], 0) + 1
    if not total and not why:
        return "The source prints no number for these cells."
    listed = ", ".join(f"{n} {name}" for name, n in counts.items())
    parts = [f"Against {total} of the source's printed numbers: {listed}."] if total else []
    parts += [f"Not comparable, {n} cells: {reason}." for reason, n in why.items()]
    return " ".join(parts)


def comparisons(study: Table, table: Table | None) -> str:
    """Paired differences and gap closures beside what the source's numbers say.

    Args:
        study: rows with `difference`, `low`, `high`, `p_value`, or with `value` (gap closure).
        table: the table of record, for the source's differences.
    """
    printed = {
        (row["row"], row["model"]): row["source"]
        for row in (table or {}).get("rows", ())
        if row["metric"] in ("accuracy", "sr_testing") and "source" in row
    }
    lines, gaps = [], []
    for row in study["rows"]:
        if "difference" not in row:
            gaps.append(
                {
                    "row": row["row"],
                    "model": row["comparison"].removeprefix("gap closure "),
                    "metric": "gap_closure",
                    "unit": "1",
                    "n": row["n"],
                    "mean": row["value"],
                }
            )
            continue
        a, _, b = row["comparison"].partition(" - ")
        ours = f"{row['difference']:+.2f} [{row['low']:+.2f}, {row['high']:+.2f}]"
        p = _p_value(row["p_value"])
        if "p_holm" in row:
            p += f", {_p_value(row['p_holm'])}"
        wide = row.get("over_subjects_and_seeds")
        subjects = f"[{wide[0]:+.2f}, {wide[1]:+.2f}]" if wide else ""
        source, verdict = "", ""
        if (row["row"], a) in printed and (row["row"], b) in printed:
            difference = printed[row["row"], a] - printed[row["row"], b]
            source = f"{difference:+.2f}"
            verdict = _claim(difference, row["low"], row["high"])
        n = str(row["n"])
        lines.append([row["row"], row["comparison"], ours, subjects, p, n, source, verdict])
    parts = []
    if lines:
        header = ["case", "difference", "points [95 %]", "over test subjects too"]
        header += ["p, Holm's", "n", "source", "the source's order"]
        if not any(line[3] for line in lines):
            header, *lines = ([*line[:3], *line[4:]] for line in (header, *lines))
        parts.append(
            "**Paired differences** (same seed, corruption and split)\n\n" + grid(header, lines)
        )
    if gaps:
        parts.append(
            "**Gap closure**: share of the way from the baseline to the oracle gate, which is told "
            "the failed channels\n\n" + pivot(gaps, "row", "model")
        )
    return "\n\n".join(parts)


def _p_value(value: float | None) -> str:
    return "< 0.0005" if value is not None and value < 0.0005 else number(value, "1")


def _claim(source: float, low: float, high: float) -> str:
    """Does an interval of a difference bear out the sign of the source's difference?"""
    if source == 0.0:
        return "a tie"
    if low > 0.0:
        return "holds" if source > 0 else "reversed"
    if high < 0.0:
        return "holds" if source < 0 else "reversed"
    return "not decided"


def replace_block(text: str, name: str, block: str) -> str:
    """Put `block` between the markers of `name` in a Markdown text.

    Raises:
        ValueError: the markers are not there, or in the wrong order.
    """
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    start, stop = text.find(begin), text.find(end)
    if start < 0 or stop < start:
        raise ValueError(f"the file needs the lines {begin} and {end}, in this order")
    return f"{text[: start + len(begin)]}\n{block.strip()}\n{text[stop:]}"
