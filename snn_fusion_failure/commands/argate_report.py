"""What `train_argate` tells at its end: cases side by side, one sentence, pictures."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snn_fusion_failure.commands.argate_runs import Config
from snn_fusion_failure.records import fusion_tables
from snn_fusion_failure.runs import repository

if TYPE_CHECKING:
    from fusion.data import Dataset
    from fusion.loop import Corruption


def printed(config: Config, noise: Corruption) -> float | None:
    """The source's accuracy for the same data set, model and failing sensors, in percent."""
    path = repository.RESULTS / "source_tables.json"
    if config.split is not None or config.features is not None or not path.exists():
        return None
    tables = json.loads(path.read_text(encoding="utf-8"))
    for number, (_, rows) in fusion_tables.TABLES.items():
        for row in rows:
            columns = tables[number]["columns"]
            if row.settings["dataset"] != config.dataset or config.model not in columns:
                continue
            other = dataclasses.replace(Config(model=config.model), **row.settings)
            if _same_noise(other, noise):
                return float(tables[number]["rows"][row.name][columns.index(config.model)])
    return None


def _same_noise(config: Config, noise: Corruption) -> bool:
    """Whether a row of a table has the failing sensors of `noise`, by their numbers and sets."""
    k = noise.train.n_channels
    n_clean = config.n_clean or 0
    counts = {
        "clean": ((0, 0), (0, 0)),
        "random": ((k - n_clean,) * 2, (k - n_clean,) * 2),
        "fixed": ((k - n_clean,) * 2, (k - n_clean,) * 2),
        "generalisation": (config.train_range, config.test_range),
    }[config.protocol or "clean"]
    given = (noise.train.low, noise.train.high), (noise.test.low, noise.test.high)
    kind = config.protocol == "clean" or config.kind == noise.kind
    return counts == given and kind and bool(noise.test.failing) == (config.protocol == "fixed")


def ceiling_of(dataset: Dataset, noise: Corruption) -> float | None:
    """Accuracy of the best classifier that is told which sensors failed; simulated sets only."""
    if dataset.name != "simulated" or noise.kind not in ("uniform", "gaussian"):
        return None
    from fusion.data.simulated import SimulatedConfig, oracle_accuracy

    return 100.0 * oracle_accuracy(SimulatedConfig(), noise.test)


def table(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Clean and failing cases side by side; columns that no case fills are left out."""
    columns = [("accuracy", "accuracy %")]
    columns += [
        (name, title)
        for name, title in (("source", "source %"), ("ceiling", "ceiling %"))
        if any(row[name] is not None for row in found.values())
    ]
    lines: list[tuple[str, Mapping[str, Any]]] = []
    for name, row in found.items():
        lines.append((row["title"], row))
        if name != "clean":
            lines.append(
                ("  examples without a failed sensor", {"accuracy": row["accuracy_clean"]})
            )
            lines.append(
                ("  examples with failed sensors", {"accuracy": row["accuracy_corrupted"]})
            )
    width = max(len(title) for title, _ in lines)
    text = [" " * width + "".join(f"{title:>12}" for _, title in columns)]
    for title, row in lines:
        cells = (row.get(name) for name, _ in columns)
        text.append(
            f"{title:<{width}}" + "".join(" " * 12 if c is None else f"{c:12.1f}" for c in cells)
        )
    return "\n".join(line.rstrip() for line in text)


def sentence(config: Config, settings: Any, dataset: Any, found: Mapping[str, Any]) -> str:
    """What was done, in one sentence."""
    share = "; in two thirds of the examples the failed sensors read noise"
    count = "One network" if len(found) == 1 else f"{len(found)} networks"
    return (
        f"{count} ({config.model}, preset {config.preset}, {settings.train.epochs} epochs, seed "
        f"{config.seed}) learned from {len(dataset.train_y)} {config.dataset} examples and met "
        f"{len(dataset.test_y)} {'validation' if config.validation else 'test'} examples that they "
        f"had not seen{share if set(found) != {'clean'} else ''}."
    )


def draw(
    out: Path, config: Config, dataset: Any, found: Mapping[str, Any], trained: Mapping[str, Any]
) -> None:
    """Accuracy of all cases, and of each case confusions, training curves and fusion weights."""
    import numpy as np

    from fusion import plots

    rows = {
        row["title"]: (row["accuracy"], row["source"], row["ceiling"]) for row in found.values()
    }
    pictures = {"cases.png": plots.plot_cases(rows, title=f"{config.model} on {config.dataset}")}
    for name, (_, output) in trained.items():
        after = f"_{name}" if len(trained) > 1 else ""
        pictures[f"confusion{after}.png"] = plots.plot_confusion(
            found[name]["confusion"], dataset.classes, title=found[name]["title"].capitalize()
        )
        if output.failed.any():
            pictures[f"gate{after}.png"] = plots.plot_gate(
                output.weights, output.failed, dataset.channels
            )
    pictures["training.png"] = plots.plot_training(
        {
            name: {m: np.asarray([row[m] for row in history]) for m in ("total", "accuracy")}
            for name, (history, _) in trained.items()
        }
    )
    for file, figure in pictures.items():
        figure.savefig(out / file, dpi=120)
