"""The page of a netlist analysis: one HTML file that needs no other file and no network."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.records import html
from snn_fusion_failure.records.html import escape, tag
from snn_fusion_failure.runs import write_text

MOST = 12
"""Parameters per specification in the ranking."""


def number(value: float | None, digits: int = 3) -> str:
    """A number for a reader; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:.{digits}g}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of markup cells; the first column names the row."""
    titles = tag("tr", *(tag("th", escape(h), scope="col") for h in head))
    body = []
    for row in rows:
        first = tag("th", row[0], scope="row")
        body.append(tag("tr", first, *(tag("td", cell, klass="number") for cell in row[1:])))
    made = tag("table", tag("thead", titles), tag("tbody", *body))
    return tag("div", made, klass="scroll", tabindex="0")


def _bar(share: float) -> str:
    width = max(0.0, min(share, 1.0)) * 8.0
    style = f"display:inline-block;height:.7em;width:{width:.2f}em;background:var(--link)"
    return f"{100.0 * share:.1f} % " + tag("span", style=style)


def _spec_rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for s in result["specs"]:
        known = s["probability"] is not None and math.isfinite(s["probability"])
        dppm = number(s["dppm"]) if known else f"below {number(1e6 * s['upper'])}"
        link = tag("a", escape(s["deck"]), href=s["deck"]) if s.get("deck") else "–"
        rows.append(
            [
                tag("code", escape(s["spec"])), number(s["nominal"], 4), number(s["distance"]),
                number(s["probability"]) if known else "–",
                f"{number(s['lower'])} … {number(s['upper'])}", dppm,
                escape(s["verdict"]), escape(s.get("corner", "–")), link,
            ]
        )  # fmt: skip
    return rows


def page(name: str, simulator: Any, result: dict[str, Any]) -> str:
    """The report.

    Args:
        name: of the netlist.
        simulator: NetlistSimulator.
        result: what `netlist_files.write` returned.
    """
    y = result["yield"]
    found = y["probability"] is not None and math.isfinite(y["probability"])
    line = (
        f"yield {100.0 * y['yield']:.6g} %, {number(y['dppm'])} DPPM "
        f"({number(1e6 * y['lower'])} to {number(1e6 * y['upper'])} with 95 % confidence)"
        if found
        else "no failure was seen"
    )
    parts = [
        tag("h1", f"{escape(name)}: worst cases and yield"),
        tag("p", tag("strong", escape(line)), f": {escape(y['verdict'])}."),
        tag("p", f"{result['simulations']} samples of {len(simulator.variation.names)} varied "
            f"parameters in {len(simulator.corners)} corners."),
        tag("h2", "Specifications"),
        table(
            ["specification", "nominal", "distance [sigma]", "P", "95 % interval", "DPPM",
             "verdict", "corner", "worst-case deck"], _spec_rows(result)),
        tag("p", "The distance is that of the nearest failing point; the deck is the circuit "
            "there, ready to be simulated again. A verdict other than good says what stands "
            "against the number.", klass="soft"),
        tag("h2", "What matters: parameters by their share in the worst case"),
    ]  # fmt: skip
    for s in result["specs"]:
        if not s.get("shares"):
            continue
        parts.append(tag("h3", tag("code", escape(s["spec"]))))
        ranked = sorted(s["shares"].items(), key=lambda item: -item[1])
        rows = [
            [tag("code", escape(n)), _bar(v), number(s["worst"][n], 5)] for n, v in ranked[:MOST]
        ]
        parts.append(table(["parameter", "share", "value in the worst case"], rows))
    corners = [
        [escape(c["corner"]), *(number(c[n], 4) for n in simulator.names)]
        for c in result["corners"]
    ]
    parts.append(tag("h2", "Corners, nominal parameters"))
    parts.append(table(["corner", *simulator.names], corners))
    return html.page(f"{name}: worst cases and yield", parts)


def write(path: Path, name: str, simulator: Any, result: dict[str, Any]) -> None:
    """Write the page."""
    write_text(path, page(name, simulator, result))
