"""The report: every table and figure of the source beside ours, on one page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from snn_fusion_failure.records import cells, chapters, comparability, html
from snn_fusion_failure.records.figures import gallery
from snn_fusion_failure.records.html import escape, tag
from snn_fusion_failure.runs import provenance, repository, write_text

CHAPTERS = {
    "2": "Chapter 2: spiking networks that learn to steer",
    "3": "Chapter 3: sensor fusion that survives failing sensors",
    "4": "Chapter 4: rare failures of circuits",
}

RULE = (
    "“Within” means that the source's number lies in our 95 % interval; “better” and “worse” that "
    "it lies outside, on the bad or on the good side of ours as the heading of the score says. "
    "The interval is Student's t interval of the mean over n independent seeds; that of a share "
    "(success rate, accuracy, AUROC) is Wilson's with the number of trials that gives the spread "
    "over the seeds, so that it stays within 0 and 100 %. With one seed there is none, and the two "
    "numbers are compared as they are.",
    "The first failure is different, since some searches find none: ours is the median over the "
    "searches, where a search without a failure counts as later than all others, with the "
    "interval of the median from order statistics (six searches or more).",
    "“Not comparable”: the two numbers do not measure the same thing; the words above the table "
    "say why. “Not run”: there is no number of ours. Nothing on this page was typed in: ours come "
    "from the JSON files named below, the source's from results/source_tables.json.",
)

NOTES = {
    "2.3": "S1 to S4 learn in 20 trials; Q-learning has 2,000.",
    "4.1": "The source's netlist is not public: this is another LDO regulator with 60 parameters, "
    "and a failure is 90 % of the way from nominal to the worst value that can be reached. “Box” "
    "lets every parameter go to its bound of 3 sigma; “ball” limits their joint distance. The "
    "source prints a target of 0.27 % for the load regulation beside worst cases near 27 %.",
    "4.2": "As in Table 4.1, the circuit and the targets are ours.",
}


def _load(folder: Path, word: str) -> dict[str, tuple[str, cells.Table]]:
    """Number -> (origin, table) of a folder."""
    tables = cells.load_tables(folder)
    return {number: (word, table) for number, table in tables.items()}


def _section(number: str, source: cells.Table, held: Sequence[tuple[str, cells.Table]]) -> str:
    """One table of the source."""
    found, more = cells.join(number, source, held)
    parts = [tag("h3", escape(f"Table {number}. {source['title']}"), id=f"table-{number}")]
    for origin, table in held:
        counts = cells.tally(found, origin)
        day = table.get("date", "")
        parts.append(tag("p", f"{escape(origin)} ({escape(day)}): {html.tally_marks(counts)}"))
    if not held:
        reason = chapters.NOT_RUNNABLE.get(
            number, f"python scripts/studies/reproduce.py --table {number}"
        )
        parts.append(tag("p", html.mark("not run"), f" {escape(reason)}"))
    if number in NOTES:
        parts.append(tag("p", escape(NOTES[number]), klass="soft"))
    for why in comparability.reasons(number):
        parts.append(tag("p", html.mark("not comparable"), f" {escape(why)}.", klass="soft"))
    label = f"Table {number}"
    parts.append(html.cell_table(label, found))
    parts.append(html.more_table(f"{label}, further measurements", more))
    return "\n".join(parts)


def _overview(sources: dict[str, Any], held: dict[str, list[tuple[str, cells.Table]]]) -> str:
    """One line for each table: how many cells are better, within, worse, not run."""
    names = ("better", "within", "worse", "not comparable", "not run")
    lines = []
    total = {origin: dict.fromkeys(names, 0) for origin in ("quick run", "record")}
    for number, source in sources.items():
        tables = held[number]
        for origin, table in tables or [("", {"rows": []})]:
            found, _ = cells.join(number, source, [(origin, table)])
            counts = cells.tally(found, origin)
            link = tag("a", escape(number), href=f"#table-{number}")
            lines.append(_count_line(link, origin, [counts[n] for n in names]))
            if origin:
                total[origin] = {n: total[origin][n] + counts[n] for n in names}
    for origin, counts in total.items():
        if any(counts.values()):
            shown = [counts[n] for n in names[:-1]]
            lines.append(_count_line("all", origin, [*shown, None]))
    heads = [tag("th", "table", scope="col"), tag("th", "from", scope="col")]
    heads += [tag("th", html.mark(n), scope="col", klass="number") for n in names]
    grid = tag("table", tag("thead", tag("tr", *heads)), tag("tbody", *lines))
    return tag("div", grid, klass="scroll", role="region", aria_label="Overview", tabindex="0")


def _count_line(name: str, origin: str, counts: Sequence[int | None]) -> str:
    numbers = [tag("td", str(n) if n else "·", klass="number") for n in counts]
    return tag("tr", tag("th", name, scope="row"), tag("td", escape(origin or "–")), *numbers)


def _details(held: dict[str, list[tuple[str, cells.Table]]], seconds: dict[str, float]) -> str:
    """How every file of numbers was made, and this page."""
    rows = []
    for number, tables in held.items():
        for origin, table in tables:
            seeds = sorted({int(r["n"]) for r in table["rows"] if "n" in r})
            span = f"{seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else "".join(map(str, seeds))
            rows.append((
                f"Table {number}", origin, table.get("command", ""), table.get("preset", ""), span,
                table.get("device", ""), _versions(table), table.get("date", ""),
                table.get("git", ""),
            ))  # fmt: skip
    header = ("numbers", "from", "command", "preset", "seeds", "device", "versions", "date",
              "commit")  # fmt: skip
    parts = [html.plain_table("Run details", header, rows)]
    if seconds:
        listed = "; ".join(f"Table {table}: {value:.0f} s" for table, value in seconds.items())
        parts.append(
            tag(
                "p",
                escape(
                    "The last quick run took, in wall time and less what was "
                    f"there before: {listed}."
                ),
            )
        )
    made = provenance()
    parts.append(
        tag("p", "This page: ", tag("code", escape(made["command"])),
            escape(f"; commit {made['git']}; {made['device']}; {_versions(made)}; {made['date']}."))
    )  # fmt: skip
    return "\n".join(parts)


def _versions(table: dict[str, Any]) -> str:
    return ", ".join(f"{name} {version}" for name, version in table.get("versions", {}).items())


def _body(
    sources: dict[str, Any], held: dict[str, list[tuple[str, cells.Table]]], work: Path,
    root: Path, seconds: dict[str, float], title: str,
) -> Iterator[str]:  # fmt: skip
    yield tag("h1", "Reproduction report")
    yield tag("p", escape(f"Every table and result figure of the source, beside ours. {title}."))
    links = {f"#chapter-{c}": name for c, name in CHAPTERS.items()}
    links |= {"#figures": "Figures", "#details": "Run details"}
    items = (tag("li", tag("a", escape(name), href=href)) for href, name in links.items())
    yield tag("nav", tag("ul", *items), aria_label="Contents")
    yield tag("h2", "Overview")
    yield _overview(sources, held)
    yield tag("h2", "What the marks mean")
    yield "".join(tag("p", escape(text)) for text in RULE)
    for chapter, name in CHAPTERS.items():
        yield tag("h2", escape(name), id=f"chapter-{chapter}")
        for number, source in sources.items():
            if number.startswith(chapter):
                yield _section(number, source, held[number])
    yield tag("h2", "Figures", id="figures")
    yield gallery(work, root)
    yield tag("h2", "Run details", id="details")
    yield _details(held, seconds)


def write(folder: Path, *, fresh: Path, record: Path, root: Path = repository.ROOT) -> Path:
    """Write the page; tables and figures that are not there are said to be not run.

    Args:
        folder: for index.html.
        fresh: tables of a quick run; its folder holds the run's figures.
        record: tables of record.
        root: repository with the figures of record.

    Returns:
        The page.
    """
    listed = chapters.source_tables()
    title = f"The source: {listed.pop('source')}"
    new, old = _load(fresh, "quick run"), _load(record, "record")
    held = {n: [tables[n] for tables in (new, old) if n in tables] for n in listed}
    log = fresh.parent / "report.json"
    seconds = json.loads(log.read_text(encoding="utf-8"))["seconds"] if log.exists() else {}
    body = _body(listed, held, fresh.parent, root, seconds, title)
    path = folder / "index.html"
    write_text(path, html.page("Reproduction report", body))
    return path
