"""Which of our numbers may be held against the source's, and why others may not.

A mark (better, within, worse) is given only where the same thing is measured. What is listed here
gets *not comparable* and its reason instead, on every page.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Difference:
    """Cells that measure something else than the source's.

    Attributes:
        tables: their numbers.
        reason: in one sentence.
        row, model, metric: only these; None for all.
    """

    tables: tuple[str, ...]
    reason: str
    row: str | None = None
    model: str | None = None
    metric: str | None = None

    def holds(self, table: str, row: Row) -> bool:
        """Is this a cell of them?"""
        return table in self.tables and all(
            wanted is None or wanted == str(row.get(name))
            for name, wanted in (("row", self.row), ("model", self.model), ("metric", self.metric))
        )


_ROBOTS = ("2.3", "2.4", "2.5")
STUDIES = {"study_rl": dict(zip(("Scenario 1", "Scenario 2", "Scenario 3"), _ROBOTS, strict=True))}
"""Other files of record with numbers of the source: row -> the table that prints them."""
_CIRCUITS = ("4.1", "4.2")

DIFFERENCES = (
    Difference(
        _ROBOTS,
        "the source gives neither the rewards of its Q-learning nor drawings of its maps: ours is "
        "another learner on other maps",
        model="Q-learning",
    ),
    Difference(
        _ROBOTS,
        "the drawings of the source's maps are lost, and ours are easier: on Scenario 1 and 2 a "
        "driver that looks at no sonar arrives in 100 and 93 % of the trials; see the detours",
    ),
    Difference(
        ("3.4", "3.5", "3.6"),
        "7 of the 15 signals are stand-ins for signals that the public data lack: the inputs are "
        "others than the source's",
    ),
    Difference(
        _CIRCUITS,
        "the source's netlist is not public: another circuit with other targets",
        metric="first_failure_hit",
    ),
    Difference(
        _CIRCUITS,
        "the source's netlist is not public: another circuit with other targets",
        metric="worst_case",
    ),
)


def reason(table: str, row: Row) -> str:
    """Why a cell may not be compared with the source's; '' where it may.

    Args:
        table: number of the table, such as "2.3".
        row: `row`, `model` and `metric` of the cell.

    Example:
        >>> reason("3.1", {"row": "clean", "model": "argate_l", "metric": "accuracy"})
        ''
    """
    return next((d.reason for d in DIFFERENCES if d.holds(table, row)), "")


def annotated(table: str, rows: Iterable[Row]) -> list[Row]:
    """Rows of record with the reason under `not_comparable`, where there is one.

    Args:
        table: number of the table, or the name of another file of record (`STUDIES`).
        rows: of it.
    """
    tables = STUDIES.get(table, {})
    reasons = ((row, reason(tables.get(str(row["row"]), table), row)) for row in rows)
    return [row | {"not_comparable": why} if why else dict(row) for row, why in reasons]


def reasons(table: str) -> list[str]:
    """The reasons of a table, each once, with what they are for."""
    found: dict[str, list[str]] = {}
    for one in DIFFERENCES:
        if table in one.tables:
            names = [n.replace("_", " ") for n in (one.row, one.model, one.metric) if n]
            found.setdefault(one.reason, []).append(" ".join(names))
    return [f"{', '.join(names)}: {why}" for why, names in found.items()]
