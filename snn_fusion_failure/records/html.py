"""The report as HTML: one page that needs no other file and no network.

Every function returns markup; text goes through `escape` here and nowhere else. The style is
`report.css` beside this file, put into the page.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.records import markdown
from snn_fusion_failure.records.cells import Cell, Measured, Printed, Row, verdict

SIGNS = {"better": "✓", "within": "≈", "worse": "✗", "not comparable": "–", "not run": "○"}

SCORES = {
    "accuracy": ("accuracy", 1),
    "accuracy_clean": ("accuracy, clean third of the test", 1),
    "accuracy_corrupted": ("accuracy, corrupted two thirds of the test", 1),
    "average_precision": ("average precision", 1),
    "gate_auroc_pooled": ("gate AUROC, pooled", 1),
    "gate_auroc_channel": ("gate AUROC, by channel", 1),
    "sr_learning": ("success rate in learning", 1),
    "sr_testing": ("success rate in testing", 1),
    "n_mv": ("steering movements until arrival", -1),
    "path": ("path until arrival", -1),
    "path_ratio": ("path / shortest path, mean", -1),
    "path_ratio_median": ("path / shortest path, median", -1),
    "first_failure_hit": ("simulations until the first failure, median", -1),
    "success_rate": ("share of searches that found a failure", 1),
    "worst_case": ("worst case found", 1),
}
"""Score -> (what it is, 1 where higher is better and -1 where lower is)."""


MODELS = {
    "baseline": "Baseline",
    "netgated": "NetGated",
    "argate_ws": "ARGate-WS",
    "argate_plus": "ARGate+",
    "argate_l": "ARGate-L",
    "oracle": "Oracle gate",
    "modality_dropout": "Modality dropout",
    "embracenet": "EmbraceNet",
}


def case(row: str) -> str:
    """A row of record in words: `n_clean=5 gaussian` is `5 clean channels, gaussian noise`."""
    if found := re.fullmatch(r"(.*?)n_clean=(\d+)(?: (\w+))?", row):
        noise = f", {found[3]} noise" if found[3] else ""
        return f"{found[1]}{found[2]} clean channel{'' if found[2] == '1' else 's'}{noise}"
    if found := re.fullmatch(r"\((\d+),(\d+)\)\((\d+),(\d+)\)", row):
        return "{} to {} channels failing in training, {} to {} in the test".format(*found.groups())
    return row.replace("_", " ")


def escape(text: object) -> str:
    """Text as markup."""
    return html.escape(str(text), quote=True)


def tag(name: str, *content: str, **attributes: str) -> str:
    """An element with content that is markup; `klass` is the attribute class."""
    named = {key.replace("klass", "class").replace("_", "-"): v for key, v in attributes.items()}
    listed = "".join(f' {key}="{escape(value)}"' for key, value in named.items())
    return f"<{name}{listed}>{''.join(content)}</{name}>"


def mark(name: str) -> str:
    """A sign, a word and a colour, so that none of them is needed alone."""
    sign = tag("span", SIGNS[name], aria_hidden="true")
    return tag("span", f"{sign} {name}", klass=f"mark {name.replace(' ', '-')}")


def score(metric: str, unit: str) -> str:
    """Name, unit and good direction of a score, as text."""
    name, direction = SCORES.get(metric, (metric.replace("_", " "), 0))
    unit = "" if unit in ("", "1") else f" [{unit}]"
    return f"{name}{unit}" + {1: ", higher is better", -1: ", lower is better", 0: ""}[direction]


def number(value: float | None, unit: str) -> str:
    """A number, where infinity is a search that found nothing."""
    if value is not None and math.isinf(value):
        return "none found"
    return markdown.number(value, unit)


def _interval(ours: Measured, unit: str) -> str:
    if ours.interval is None:
        return escape(ours.note or "–")
    low, high = (number(v, unit) for v in ours.interval)
    span = f"{low} to {high}" if math.isfinite(ours.interval[0]) else low
    note = f"; {ours.note}" if ours.note else ""
    return escape(f"{span}{note}")


def scroll_table(label: str, header: Sequence[str], rows: Iterable[str]) -> str:
    """A table in a box of its own that scrolls when the page is narrow."""
    numbers = {"source", "ours", "n"}
    cells = (
        tag("th", escape(h), scope="col", **({"klass": "number"} if h in numbers else {}))
        for h in header
    )
    table = tag("table", tag("thead", tag("tr", *cells)), tag("tbody", *rows))
    return tag("div", table, klass="scroll", role="region", aria_label=label, tabindex="0")


def _line(
    name: str, source: str, ours: Measured | None, judged: str, unit: str, again: bool
) -> str:
    # The origin stands again in the last column, which is out of sight on a phone.
    quick = tag("small", " (quick)") if ours and ours.origin == "quick run" else ""
    parts = [
        tag("th", escape(name), quick, scope="row"),
        tag("td", escape(source), klass="number"),
        tag("td", escape(number(ours.centre, unit)) if ours else "", klass="number"),
        tag("td", mark(judged)),
        tag("td", _interval(ours, unit) if ours else ""),
        tag("td", escape(ours.n) if ours else "", klass="number"),
        tag("td", escape(ours.origin) if ours else ""),
    ]
    return tag("tr", *parts, **({"klass": "again"} if again else {}))


HEADER = ("method", "source", "ours", "ours is", "95 % interval", "n", "from")


def cell_table(label: str, cells: Sequence[Cell]) -> str:
    """The source's cells with ours: a heading line for each case and score, a line per method."""
    rows: list[str] = []
    group: tuple[str, str] | None = None
    for cell in cells:
        printed: Printed = cell.printed
        if (printed.row, printed.metric) != group:
            group = printed.row, printed.metric
            title = f"{case(printed.row)}: {score(printed.metric, printed.unit)}"
            rows.append(_group(title, len(HEADER)))
        name = MODELS.get(printed.model, printed.model)
        if not cell.measured:
            line = _line(name, printed.text, None, "not run", printed.unit, False)
            rows.append(line)
        for index, ours in enumerate(cell.measured):
            judged = verdict(printed, ours) or "not comparable"
            rows.append(_line(name, printed.text, ours, judged, printed.unit, index > 0))
    return scroll_table(label, HEADER, rows)


def _group(title: str, columns: int) -> str:
    heading = tag("th", tag("span", escape(title)), colspan=str(columns), scope="rowgroup")
    return tag("tr", heading, klass="group")


def more_table(label: str, rows: Sequence[tuple[str, Row]]) -> str:
    """What we measured and the source did not, folded away."""
    if not rows:
        return ""
    lines: list[str] = []
    keys = dict.fromkeys((r["row"], r["metric"], r.get("unit", "")) for _, r in rows)
    for row_name, metric, unit in keys:
        lines.append(_group(f"{case(row_name)}: {score(metric, unit)}", 5))
        for origin, row in rows:
            if (row["row"], row["metric"], row.get("unit", "")) != (row_name, metric, unit):
                continue
            ours = _measure(row, origin)
            lines.append(
                tag(
                    "tr",
                    tag("th", escape(MODELS.get(row["model"], row["model"])), scope="row"),
                    tag("td", escape(number(ours.centre, unit)), klass="number"),
                    tag("td", _interval(ours, unit)),
                    tag("td", escape(ours.n), klass="number"),
                    tag("td", escape(origin)),
                )
            )
    summary = tag("summary", f"{len(rows)} further measurements that the source has no number for")
    table = scroll_table(label, ("method", "ours", "95 % interval", "n", "from"), lines)
    return tag("details", summary, table)


def _measure(row: Row, origin: str) -> Measured:
    from snn_fusion_failure.records.cells import measure

    return measure(row, origin)


def tally_marks(counts: dict[str, int]) -> str:
    """Marks with their numbers; those that do not occur are left out."""
    found = [f"{mark(name)} {n}" for name, n in counts.items() if n]
    return ", ".join(found) or "nothing"


def plain_table(label: str, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table of text, the first column as row headings."""
    lines = []
    for first, *rest in rows:
        cells = [tag("th", escape(first), scope="row")]
        cells += [
            tag("td", escape(text), klass="wide" if len(str(text)) > 40 else "") for text in rest
        ]
        lines.append(tag("tr", *cells))
    return scroll_table(label, header, lines)


def page(title: str, body: Iterable[str]) -> str:
    """The whole file."""
    style = (Path(__file__).parent / "report.css").read_text(encoding="utf-8")
    head = (
        '<meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        + tag("title", escape(title))
        + tag("style", style)
    )
    main = tag("main", *(f"\n{part}" for part in body if part))
    return (
        f'<!doctype html>\n<html lang="en">\n<head>{head}</head>\n<body>{main}\n</body>\n</html>\n'
    )
