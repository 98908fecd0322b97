"""docs/results.md and the summary in the README, from the files of record."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from snn_fusion_failure.records import cells, comparability, markdown, robot_rows

INTRODUCTION = """# Results

Everything on this page was measured by this project and written from the files in `results/` by
`python scripts/studies/render_results.py`; nothing is typed in by hand. The source's numbers are
those that the dissertation prints. A command below is the one that was typed when the numbers were
made: older ones name scripts where they stood then, `scripts/reproduce.py` for what is now
`scripts/studies/reproduce.py`.
"""

NOTES = {
    "gate_auroc_pooled": (
        "`accuracy clean` and `accuracy corrupted` are the clean third and the corrupted two "
        "thirds of the test examples. `gate auroc` is the chance that a clean channel's fusion "
        "weight exceeds a failed channel's, over all pairs of corrupted examples (`pooled`) or for "
        "each channel by itself (`channel`); see [Sensor failures and scores](failures.md)."
    ),
}
"""Remarks on a table that has a metric."""

PARTS = (
    ("Spiking robots, three scenarios", ("2.3", "2.4", "2.5")),
    ("Fusion, HAR", ("3.1", "3.2", "3.3")),
    ("Fusion, driver identification", ("3.4", "3.5", "3.6")),
    ("Fusion, KITTI", ("3.7", "3.8")),
    ("Rare failures, two circuits", ("4.1", "4.2")),
)
"""What the summary has a line for, and the source's tables of it."""

CHAPTER_5 = "Chapter 5: proposed there, built here"
PROPOSED = (
    *("study_spiking_fusion", "study_rev_conv", "study_bayesian_gate"),
    "study_bayesian_gate_choice",
)
"""Files of record of the systems that the source's last chapter proposes."""


def load(path: Path) -> dict[str, Any]:
    """A file of record."""
    held: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return held


def table_section(results: Path, path: Path, source: dict[str, Any]) -> str:
    """A table of record as a section, with its paired comparisons."""
    table = load(path)
    name = str(table["table"])
    rows = comparability.annotated(name, table["rows"])
    others, whence = robot_rows.beside(results, name, rows[0]["row"])
    parts = [
        f"## Table {name}: {table['title']}",
        markdown.tally_line(rows),
        markdown.measured([*rows, *others], source.get(name)),
        whence,
    ]
    parts += [note for metric, note in NOTES.items() if any(r["metric"] == metric for r in rows)]
    paired = results / f"study_paired_{name.replace('.', '_')}.json"
    if paired.exists():
        parts.append(markdown.comparisons(load(paired), table))
    parts.append(markdown.provenance(table))
    return "\n\n".join(part for part in parts if part)


def study_section(docs: Path, path: Path, level: str = "##") -> str:
    """Any other file of record: its rows if they have the schema, else where to find it."""
    study = load(path)
    rows = [row for row in study.get("rows", []) if {"row", "model", "metric"} <= set(row)]
    rows = comparability.annotated(path.stem, rows)
    parts = [f"{level} {study.get('title', path.stem)}"]
    if any("source" in row for row in rows):
        parts.append(markdown.tally_line(rows))
    picture = docs / "images" / f"{path.stem}.png"
    if picture.exists():
        parts.append(f"![{study.get('title', path.stem)}](images/{picture.name})")
    listed = f"The numbers are in `results/{path.name}`."
    parts.append(markdown.measured(rows) if rows else listed)
    if compared := study.get("comparisons"):
        parts.append(markdown.comparisons({"rows": compared}, None))
    parts.append(markdown.provenance(study))
    return "\n\n".join(parts)


def page(results: Path, docs: Path, source: dict[str, Any]) -> str:
    """All of docs/results.md."""
    tables, studies = files(results)
    parts = [INTRODUCTION.strip(), markdown.SPREAD_LINE]
    parts += [table_section(results, path, source) for path in tables]
    proposed = [path for path in studies if path.stem in PROPOSED]
    if proposed:
        parts.append(f"## {CHAPTER_5}")
        parts += [study_section(docs, path, "###") for path in proposed]
    parts += [study_section(docs, path) for path in studies if path not in proposed]
    return "\n\n".join(parts) + "\n"


def files(results: Path) -> tuple[list[Path], list[Path]]:
    """Tables of record in the order of their numbers, and all other files but paired studies."""

    def order(path: Path) -> list[int]:
        return [int(part) if part.isdigit() else 0 for part in path.stem.split("_")[1:]]

    tables = sorted(results.glob("table_*.json"), key=order)
    others = sorted([*results.glob("study_*.json"), *results.glob("bench_*.json")])
    return tables, [path for path in others if not path.stem.startswith("study_paired_")]


def summary(results: Path, source: dict[str, Any]) -> str:
    """For the README: what of the source was measured again, and how it came out."""
    held = cells.load_tables(results)
    names = ("better", "within", "worse", "not comparable", "not run")
    total = dict.fromkeys(names, 0)
    lines = []
    for title, numbers in PARTS:
        counts = dict.fromkeys(names, 0)
        for number in filter(source.__contains__, numbers):
            tables = [("record", held[number])] if number in held else []
            found, _ = cells.join(number, source[number], tables)
            for name, n in cells.tally(found, "record").items():
                counts[name] += n
                total[name] += n
        listed = f"{title} ({numbers[0]} to {numbers[-1]})"
        lines.append([listed, *(str(counts[name] or "·") for name in names)])
    judged = sum(total[name] for name in names[:3])
    return (
        f"The source prints {sum(total.values())} numbers. {judged} of them are measured here as "
        f"there: {total['better']} of ours are better, {total['worse']} worse, and for "
        f"{total['within']} the source's number lies within our 95 % interval. For "
        f"{total['not comparable']} the two do not measure the same thing (other maps, signals or "
        f"circuits), and {total['not run']} were not run. All of them, with intervals, reasons and "
        "the commands that made them, are in [docs/results.md](docs/results.md).\n\n"
        + markdown.grid(["tables of the source", *names], lines)
    )
