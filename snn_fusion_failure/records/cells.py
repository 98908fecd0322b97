"""The cells of the report: each number that the source prints, beside what we measured.

The source's tables come in three shapes and with units in their cells; here they become one flat
list. Rows of record (the schema of results/) are joined to it by (row, model, metric).
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.records import comparability, markdown
from snn_fusion_failure.records.intervals import interval, median_interval

Row = dict[str, Any]
Table = dict[str, Any]

SCORE_UNITS = {"sr_learning": "%", "sr_testing": "%", "n_mv": "steps"}
# Printed units with a prefix, as a factor on the SI value of a row of record.
PREFIXED = {"mA": 1e3, "mV": 1e3}


@dataclasses.dataclass(frozen=True)
class Printed:
    """One number of the source.

    Attributes:
        row, model, metric: as in the rows of record.
        unit: in which it is printed.
        value: None where the source prints a dash.
        text: as printed.
        scale: factor from a row of record to this unit.
        reason: why ours may not be held against it; '' where it may.
    """

    row: str
    model: str
    metric: str
    unit: str
    value: float | None
    text: str
    scale: float = 1.0
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class Measured:
    """Our number for a cell: centre, interval, number of seeds, and where it comes from.

    Attributes:
        centre: mean over seeds; median for the first failure.
        interval: 95 %; None with too few seeds.
        note: what a reader has to know beside it.
        origin: such as "this run" or "record".
        kind: what the centre is, "mean" or "median".
    """

    centre: float | None
    interval: tuple[float, float] | None
    n: int
    note: str
    origin: str
    kind: str = "mean"


@dataclasses.dataclass(frozen=True)
class Cell:
    """A printed number and ours, at most one from each origin, the fresh one first."""

    printed: Printed
    measured: tuple[Measured, ...]


RENAMED = {(number, "baseline"): "equal_weights" for number in ("3.4", "3.5", "3.6")}
"""(table, model of the source) -> its name here: the driver's head has weights to be equal."""


def _circuit_row(name: str) -> str:
    """`load regulation, target 0.27 %` as the rows of record call it."""
    return name.split(",")[0].strip().replace(" ", "_") + " (box)"


def _quantity(row: str, model: str, value: Any) -> Printed:
    """A worst case such as `9.4 mA`."""
    found = re.fullmatch(r"([-\d.]+) ?(\S+)", str(value))
    if found is None:
        raise ValueError(f"{row}, {model}: {value!r} is not a number with a unit, such as '9.4 mA'")
    number, unit = float(found[1]), found[2]
    scale = PREFIXED.get(unit, 1.0)
    return Printed(row, model, "worst_case", unit, number, str(value), scale)


def printed_cells(number: str, table: Table) -> list[Printed]:
    """All numbers of one of the source's tables, in its order."""
    cells: list[Printed] = []
    for name, content in table["rows"].items():
        if number.startswith("2."):
            for metric, value in content.items():
                unit = SCORE_UNITS.get(metric, "")
                text = markdown.number(value)
                cells.append(Printed(table["title"], name, metric, unit, float(value), text))
        elif number in ("3.7", "3.8"):
            model, measure = name.rsplit(" ", 1)
            for level, value in zip(table["columns"], content, strict=True):
                row = f"{measure}, {level}"
                text = markdown.number(value, "%")
                cells.append(Printed(row, model, "average_precision", "%", float(value), text))
        elif number.startswith("3."):
            for model, value in zip(table["columns"], content, strict=True):
                text = markdown.number(value, "%")
                ours = RENAMED.get((number, model), model)
                cells.append(Printed(name, ours, "accuracy", "%", float(value), text))
        else:
            row = _circuit_row(name)
            for model, (worst, hit) in content.items():
                value = None if hit is None else float(hit)
                text = "none in 300" if hit is None else str(hit)
                cells.append(Printed(row, model, "first_failure_hit", "", value, text))
                cells.append(_quantity(row, model, worst))
    # All models of one case and one score stand together.
    keys = dict.fromkeys((c.row, c.metric) for c in cells)
    ordered = [c for key in keys for c in cells if (c.row, c.metric) == key]
    names = ("row", "model", "metric")
    why = [comparability.reason(number, {n: getattr(c, n) for n in names}) for c in ordered]
    return [dataclasses.replace(c, reason=w) for c, w in zip(ordered, why, strict=True)]


def measure(row: Row, origin: str, scale: float = 1.0) -> Measured:
    """A row of record as a cell's number.

    Args:
        row: of a table of record.
        origin: where it comes from.
        scale: factor to the unit of the cell.
    """
    n = int(row.get("n", 1))
    values = row.get("values")
    if row["metric"] == "first_failure_hit" and values:
        hits = [math.inf if v is None or not math.isfinite(v) else float(v) for v in values]
        found = sum(math.isfinite(v) for v in hits)
        return Measured(
            statistics.median(hits),
            median_interval(hits),
            n,
            f"found in {found} of {len(hits)}",
            origin,
            "median",
        )
    mean, ends = row.get("mean"), interval(row)
    return Measured(
        None if mean is None else scale * mean,
        None if ends is None else (scale * ends[0], scale * ends[1]),
        n,
        "" if ends is not None else "no interval",
        origin,
    )


def verdict(printed: Printed, ours: Measured) -> str | None:
    """`better`, `within` or `worse` than the source; None where it may not be said."""
    source = printed.value
    if printed.reason:
        return None
    if source is None:
        # The source found no failure in its budget: later than any number.
        if printed.metric != "first_failure_hit":
            return None
        source = math.inf
    return markdown.mark(
        {
            "metric": printed.metric,
            "source": source,
            "mean": ours.centre,
            "ci95": ours.interval,
        },
        ours.kind,
    )


def load_tables(folder: Path) -> dict[str, Table]:
    """Tables of record in a folder, by number; none when the folder is not there.

    Raises:
        ValueError: a file is no JSON, or has no rows.
    """
    tables = {}
    for path in sorted(folder.glob("table_*.json")):
        try:
            table = json.loads(path.read_text(encoding="utf-8"))
            tables[str(table["table"])] = table
            list(table["rows"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path} is no table of record ({error}); remove it or make it again with "
                "scripts/studies/reproduce.py"
            ) from None
    return tables


def _key(row: Row) -> tuple[str, str, str]:
    return str(row["row"]), str(row["model"]), str(row["metric"])


def join(
    number: str, source: Table, tables: Sequence[tuple[str, Table | None]]
) -> tuple[list[Cell], list[tuple[str, Row]]]:
    """The source's cells with ours, and our rows that the source has no number for.

    Args:
        number: of the table.
        source: the source's table.
        tables: (origin, table of record or None), the fresh one first.
    """
    printed = printed_cells(number, source)
    held = [
        (origin, {_key(r): r for r in table["rows"]})
        for origin, table in tables
        if table is not None
    ]
    cells = []
    for one in printed:
        key = (one.row, one.model, one.metric)
        ours = [measure(rows[key], origin, one.scale) for origin, rows in held if key in rows]
        cells.append(Cell(one, tuple(ours)))
    known = {(one.row, one.model, one.metric) for one in printed}
    more = [(o, row) for o, rows in held for key, row in rows.items() if key not in known]
    return cells, more


def tally(cells: Sequence[Cell], origin: str) -> dict[str, int]:
    """How many cells of one origin are better, within, worse, not comparable, and not run."""
    counts = dict.fromkeys(("better", "within", "worse", "not comparable", "not run"), 0)
    for cell in cells:
        ours = [m for m in cell.measured if m.origin == origin]
        name = (verdict(cell.printed, ours[0]) or "not comparable") if ours else "not run"
        counts[name] += 1
    return counts
