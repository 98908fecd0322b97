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
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from snn_fusion_failure.records import fusion_tables, markdown, pages
from snn_fusion_failure.records.pages import load
from snn_fusion_failure.records.restored import channel_case, unseen_case
from snn_fusion_failure.records.rows import record_table, summarize
from snn_fusion_failure.runs import print_result, repository, run_command, to_jsonable, write_text


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


def _single_runs(folder: Path, field: str) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """Single runs that keep `field`, as (table, row, model, record), in the order of the tables."""
    for table, (_, rows) in fusion_tables.TABLES.items():
        for row in rows:
            for model in row.models:
                where = fusion_tables.Run(table, row, model, 0).path(folder).parent
                for path in sorted(where.glob("*.json"), key=lambda p: int(p.stem)):
                    record = load(path)
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
        case = channel_case(table, row, record["channel"]["name"])
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
            case = unseen_case(table, row, kind)
            values.setdefault((case, model, "accuracy", "%"), []).append(100.0 * value)
        # Over the clean third of the same test; a third of the rows under a kind is clean too.
        retained = mean_retained_accuracy(kinds, record["accuracy_clean"] / 100.0)
        case = unseen_case(table, row)
        values.setdefault((case, model, "mean_retained_accuracy", "1"), []).append(retained)
    return _summaries(values)


def draw_channel_weights(config: Config, path: Path) -> str | None:
    """Draw Figure 3.7 from the first seed of every model that has it; returns the channel."""
    import numpy as np

    from fusion.data.har import HAR_CHANNELS
    from fusion.plots import plot_channel_weights

    models: dict[str, tuple[Any, Any]] = {}
    channel = None
    for _, _, model, record in _single_runs(config.runs, "channel"):
        # A run that comes from a table of record holds the means only.
        if record["channel"].get("means_only"):
            continue
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


def _same(held: list[dict[str, Any]], collected: list[dict[str, Any]]) -> bool:
    """Do rows of record hold these numbers, whenever and by whatever command they were made?"""
    made = ("command", "git", "ci95")
    bare, new = ([{k: v for k, v in r.items() if k not in made} for r in rs] for rs in
                 (held, to_jsonable(collected)))  # fmt: skip
    return bool(bare == new)


def main(config: Config) -> dict[str, Any]:
    """Collect, draw, write; returns what was written."""
    source = load(repository.ROOT / "results" / "source_tables.json")
    if not any(pages.files(config.results)):
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
        if collected and not (path.exists() and _same(load(path)["rows"], collected)):
            record_table(path, name, title, collected, preset="paper")
    picture = config.docs / "images" / "study_channel_weights.png"
    drawn = draw_channel_weights(config, picture)
    target = config.docs / "results.md"
    write_text(target, pages.page(config.results, config.docs, source))
    readme = "absent"
    if config.readme.exists():
        text = config.readme.read_text(encoding="utf-8")
        try:
            new = markdown.replace_block(text, "results", pages.summary(config.results, source))
        except ValueError as error:
            readme = "unchanged"
            print(f"{config.readme.name} is left as it is: {error}", file=sys.stderr)
        else:
            readme = "refreshed"
            write_text(config.readme, new)
    tables, studies = pages.files(config.results)
    print_result(
        tables=len(tables),
        studies=len(studies),
        figure=picture.name if drawn else "none",
        page=target.name,
        readme=readme,
    )
    return {"page": target, "readme": readme, "figure": picture if drawn else None}


if __name__ == "__main__":
    run_command(Config, main, description=__doc__)
