"""Turn results/ into pages: docs/results.md, the results block of README.md, and Figure 3.7.

    python scripts/studies/render_results.py

Takes seconds and trains nothing. Every number on the pages comes from a JSON file of record; run it
again after `scripts/studies/reproduce.py` or any other script that writes to results/. Where the
single runs of a reproduction are at hand (`--runs`), the fusion weights of Figure 3.7 and the
accuracies under failure kinds that were never trained on are collected from them into results/
first.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tyro

from snn_fusion_failure.records import fusion_tables, markdown
from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import fail, print_result, repository, to_jsonable, write_text

INTRODUCTION = """# Results

Everything on this page was measured by this project and written from the files in `results/` by
`python scripts/studies/render_results.py`; nothing is typed in by hand. The source's numbers are
those that the dissertation prints.
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


@dataclasses.dataclass(frozen=True)
class Config:
    """Render the results of record."""

    results: Path = repository.RESULTS
    """Folder of the JSON files."""
    docs: Path = repository.ROOT / "docs"
    """Folder for results.md; pictures go to its images/."""
    readme: Path = repository.ROOT / "README.md"
    """File with a block between the markers results:begin and results:end."""
    runs: Path = Path("runs/record")
    """Folder of the single runs of reproduce.py; used where it is there."""


def _load(path: Path) -> dict[str, Any]:
    held: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return held


def _single_runs(folder: Path, field: str) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """Single runs that keep `field`, as (table, row, model, record), in the order of the tables."""
    for table, (_, rows) in fusion_tables.TABLES.items():
        for row in rows:
            for model in (*fusion_tables.FIVE, *row.references):
                where = fusion_tables.Run(table, row, model, 0).path(folder).parent
                for path in sorted(where.glob("*.json"), key=lambda p: int(p.stem)):
                    record = _load(path)
                    if field in record:
                        yield table, row.name, model, record


def _summaries(values: dict[tuple[str, str, str, str], list[float]]) -> list[dict[str, Any]]:
    return [
        {"row": row, "model": model, "metric": metric, "unit": unit} | summarize(listed)
        for (row, model, metric, unit), listed in values.items()
    ]


def collect_channel_weights(config: Config) -> list[dict[str, Any]]:
    """Figure 3.7 in numbers: mean fusion weight of a channel when failed and when clean."""
    values: dict[tuple[str, str, str, str], list[float]] = {}
    for table, row, model, record in _single_runs(config.runs, "channel"):
        case = f"Table {table}, {row}: {record['channel']['name']}"
        for metric in ("when_failed", "when_clean"):
            weights = record["channel"][metric]
            if weights:
                mean = sum(weights) / len(weights)
                values.setdefault((case, model, f"weight_{metric}", "1"), []).append(mean)
    return _summaries(values)


def collect_unseen_kinds(config: Config) -> list[dict[str, Any]]:
    """Accuracy under failure kinds never trained on, and the share of clean accuracy retained."""
    from fusion.evaluate import mean_retained_accuracy

    values: dict[tuple[str, str, str, str], list[float]] = {}
    for table, row, model, record in _single_runs(config.runs, "robustness"):
        kinds = {kind: value / 100.0 for kind, value in record["robustness"].items()}
        for kind, value in kinds.items():
            case = f"Table {table}, trained on {row}, tested on {kind}"
            values.setdefault((case, model, "accuracy", "%"), []).append(100.0 * value)
        # Over the clean third of the same test; a third of the rows under a kind is clean too.
        retained = mean_retained_accuracy(kinds, record["accuracy_clean"] / 100.0)
        case = f"Table {table}, trained on {row}"
        values.setdefault((case, model, "mean_retained_accuracy", "1"), []).append(retained)
    return _summaries(values)


def draw_channel_weights(config: Config, path: Path) -> str | None:
    """Draw Figure 3.7 from the first seed of every model that has it; returns the channel."""
    import numpy as np

    from fusion.data import HAR_CHANNELS
    from fusion.plots import plot_channel_weights

    models: dict[str, tuple[Any, Any]] = {}
    channel = None
    for _, _, model, record in _single_runs(config.runs, "channel"):
        if model in models or model not in fusion_tables.FIVE[1:]:
            continue
        channel = record["channel"]["name"]
        failed, clean = (record["channel"][part] for part in ("when_failed", "when_clean"))
        # The runs keep the weights of one channel only; the mask says that it was another that
        # failed where this one did not, which is all that the picture asks of the others.
        index = HAR_CHANNELS.index(channel)
        weights = np.zeros((len(failed) + len(clean), len(HAR_CHANNELS)))
        weights[:, index] = [*failed, *clean]
        mask = np.zeros(weights.shape, bool)
        mask[: len(failed), index] = True
        mask[len(failed) :, index - 1] = True
        models[model] = weights, mask
    if channel is None:
        return None
    path.parent.mkdir(parents=True, exist_ok=True)
    plot_channel_weights(models, channel, HAR_CHANNELS).savefig(path, dpi=110)
    return channel


def table_section(config: Config, path: Path, source: dict[str, Any]) -> str:
    """A table of record as a section, with its paired comparisons."""
    table = _load(path)
    name = str(table["table"])
    rows = table["rows"]
    parts = [
        f"## Table {name}: {table['title']}",
        markdown.tally_line(rows),
        markdown.measured(rows, source.get(name)),
    ]
    parts += [note for metric, note in NOTES.items() if any(r["metric"] == metric for r in rows)]
    paired = config.results / f"study_paired_{name.replace('.', '_')}.json"
    if paired.exists():
        parts.append(markdown.comparisons(_load(paired), table))
    parts.append(markdown.provenance(table))
    return "\n\n".join(part for part in parts if part)


def study_section(config: Config, path: Path) -> str:
    """Any other file of record: its rows if they have the schema, else where to find it."""
    study = _load(path)
    rows = [row for row in study.get("rows", []) if {"row", "model", "metric"} <= set(row)]
    parts = [f"## {study.get('title', path.stem)}"]
    picture = config.docs / "images" / f"{path.stem}.png"
    if picture.exists():
        parts.append(f"![{study.get('title', path.stem)}](images/{picture.name})")
    listed = f"The numbers are in `results/{path.name}`."
    parts.append(markdown.measured(rows) if rows else listed)
    parts.append(markdown.provenance(study))
    return "\n\n".join(parts)


def page(config: Config, source: dict[str, Any]) -> str:
    """All of docs/results.md."""
    tables, studies = files(config.results)
    parts = [INTRODUCTION.strip(), markdown.SPREAD_LINE]
    parts += [table_section(config, path, source) for path in tables]
    parts += [study_section(config, path) for path in studies]
    return "\n\n".join(parts) + "\n"


def files(results: Path) -> tuple[list[Path], list[Path]]:
    """Tables of record in the order of their numbers, and all other files but paired studies."""

    def order(path: Path) -> list[int]:
        return [int(part) if part.isdigit() else 0 for part in path.stem.split("_")[1:]]

    tables = sorted(results.glob("table_*.json"), key=order)
    others = sorted([*results.glob("study_*.json"), *results.glob("bench_*.json")])
    return tables, [path for path in others if not path.stem.startswith("study_paired_")]


def headlines(config: Config, source: dict[str, Any]) -> str:
    """For the README: the source's own method against its printed numbers, one line per cell."""
    lines, counts = [], {"better": 0, "within": 0, "worse": 0}
    for path in files(config.results)[0]:
        table = _load(path)
        rows = markdown.in_order(table["rows"], source.get(str(table["table"])))
        rows = [row for row in rows if markdown.mark(row) is not None]
        for name, n in markdown.tally(rows).items():
            counts[name] += n
        # The source lists its own method last.
        own = markdown.distinct(rows, "model")[-1:]
        for row in rows:
            if row["model"] in own:
                unit = row.get("unit", "")
                ours = markdown.cell({k: v for k, v in row.items() if k != "source"})
                lines.append(
                    [
                        str(table["table"]),
                        row["row"],
                        row["model"],
                        row["metric"].replace("_", " ") + ("" if unit == "1" else f" [{unit}]"),
                        ours,
                        markdown.number(row["source"], unit),
                        markdown.mark(row) or "",
                    ]
                )
    if not lines:
        return "No table of record has been measured yet."
    header = ["table", "case", "model", "score", "ours [95 %] (n)", "source", "ours is"]
    listed = ", ".join(f"{n} {name}" for name, n in counts.items())
    return (
        f"All cells of all tables against the source's printed numbers: {listed} (*within*: the "
        "source's number lies in our 95 % interval). The source's own method in each table, and "
        "the rest in [docs/results.md](docs/results.md):\n\n" + markdown.grid(header, lines)
    )


def _same(held: list[dict[str, Any]], collected: list[dict[str, Any]]) -> bool:
    """Do rows of record hold these numbers, whenever and by whatever command they were made?"""
    bare = [{k: v for k, v in row.items() if k not in ("command", "git")} for row in held]
    return bool(bare == to_jsonable(collected))


def main(config: Config) -> dict[str, Any]:
    """Collect, draw, write; returns what was written."""
    source = _load(repository.ROOT / "results" / "source_tables.json")
    if not any(files(config.results)):
        raise ValueError(
            f"{config.results} holds no result of record; make one with "
            "scripts/studies/reproduce.py or name another folder with --results"
        )
    for name, title, collected in (
        (
            "study_channel_weights",
            "Figure 3.7: mean fusion weight of a channel when it has failed and when it is clean",
            collect_channel_weights(config),
        ),
        (
            "study_unseen_kinds",
            "Failure kinds never trained on: accuracy, and mean share of clean accuracy retained",
            collect_unseen_kinds(config),
        ),
    ):
        path = config.results / f"{name}.json"
        # A file that would say the same keeps its commit and date.
        if collected and not (path.exists() and _same(_load(path)["rows"], collected)):
            record_table(path, name, title, collected, preset="paper")
    picture = config.docs / "images" / "study_channel_weights.png"
    drawn = draw_channel_weights(config, picture)
    target = config.docs / "results.md"
    write_text(target, page(config, source))
    readme = "absent"
    if config.readme.exists():
        text = config.readme.read_text(encoding="utf-8")
        try:
            new = markdown.replace_block(text, "results", headlines(config, source))
        except ValueError as error:
            readme = "unchanged"
            print(f"{config.readme.name} is left as it is: {error}", file=sys.stderr)
        else:
            readme = "refreshed"
            write_text(config.readme, new)
    tables, studies = files(config.results)
    print_result(
        tables=len(tables),
        studies=len(studies),
        figure=picture.name if drawn else "none",
        page=target.name,
        readme=readme,
    )
    return {"page": target, "readme": readme, "figure": picture if drawn else None}


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, description=__doc__))
    except (ValueError, FileNotFoundError) as error:
        fail(str(error))
