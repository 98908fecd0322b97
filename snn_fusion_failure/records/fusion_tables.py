"""Tables 3.1 to 3.6: which trainings fill their cells, and how runs become a table of record.

A run is one (table, row, model, seed) with a file of its own; an interruption loses one run.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snn_fusion_failure.records.ceilings import CEILINGS, score
from snn_fusion_failure.records.rows import commits, summarize
from snn_fusion_failure.runs.origin import commit

if TYPE_CHECKING:
    from fusion.failure_kinds import FailureKind

FIVE = ("baseline", "netgated", "argate_ws", "argate_plus", "argate_l")
PRINTED = ("argate_plus_printed", "argate_l_printed")
ABSORBING = ("modality_dropout", "embracenet")
"""Networks without a gate that are trained for missing sensors."""
TRIVIAL = ("nearest_rows", "linear_fit")
UNSEEN_KINDS: tuple[FailureKind, ...] = ("zero", "stuck", "drift", "dropout", "gain", "clip")


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of a table: data set and failure protocol, as the command `train_argate` has them.

    Attributes:
        name: as the source's table spells it.
        settings: fields of `train_argate.Config` that differ from its defaults.
        references: columns beside the source's.
        robustness: also score under the failure kinds that are never trained on.
        channel: keep this channel's fusion weights (Figure 3.7).
    """

    name: str
    settings: dict[str, Any]
    references: tuple[str, ...] = ()
    robustness: bool = False
    channel: str | None = None

    @property
    def models(self) -> tuple[str, ...]:
        """All columns of the row; the driver's head calls its baseline `equal_weights`."""
        base = "equal_weights" if self.settings["dataset"] == "driver" else "baseline"
        return (base, *FIVE[1:], *self.references)


def _bounds(dataset: str) -> tuple[str, ...]:
    """The trivial opponents and, of scalar sensors, the forest that is told which ones work."""
    return (*(("forest_ceiling",) if dataset == "driver" else ()), *TRIVIAL)


def _clean(dataset: str) -> Row:
    return Row("clean", {"dataset": dataset, "protocol": "clean"}, _bounds(dataset))


def _random(dataset: str, n_clean: int, kind: str, *more: str, **options: Any) -> Row:
    settings = {"dataset": dataset, "protocol": "random", "n_clean": n_clean, "kind": kind}
    # What the forest reaches does not depend on how the other sensors fail.
    bounds = _bounds(dataset) if kind == "uniform" else ()
    return Row(
        f"n_clean={n_clean} {kind}", settings, (*PRINTED, "oracle", *more, *bounds), **options
    )


def _ranges(dataset: str, train: tuple[int, int], test: tuple[int, int]) -> Row:
    ranges = {"protocol": "generalisation", "train_range": train, "test_range": test}
    name = f"({train[0]},{train[1]})({test[0]},{test[1]})"
    return Row(name, {"dataset": dataset} | ranges, ("oracle", *TRIVIAL))


def _fixed(dataset: str, n_clean: int) -> Row:
    settings = {"dataset": dataset, "protocol": "fixed", "n_clean": n_clean}
    return Row(f"n_clean={n_clean}", settings, ("oracle", *_bounds(dataset)))


TABLES: dict[str, tuple[str, tuple[Row, ...]]] = {
    "3.1": (
        "HAR, clean and random failing sensor assignment, accuracy %",
        (
            _clean("har"),
            _random("har", 8, "uniform"),
            _random("har", 8, "gaussian"),
            _random("har", 5, "uniform", *ABSORBING, robustness=True),
            _random("har", 5, "gaussian"),
            _random("har", 1, "uniform", *ABSORBING, channel="total_acc_y"),
            _random("har", 1, "gaussian"),
        ),
    ),
    "3.2": (
        "HAR, fixed failing sensor assignment (uniform), accuracy %",
        (_fixed("har", 6), _fixed("har", 5)),
    ),
    "3.3": (
        "HAR, failing sensor generation test, accuracy %",
        tuple(_ranges("har", (1, b), (b + 1, 8)) for b in (2, 3, 4)),
    ),
    "3.4": (
        "Driver identification, fixed failing sensor assignment (uniform), accuracy %",
        (_fixed("driver", 5), _fixed("driver", 7)),
    ),
    "3.5": (
        "Driver identification, clean and random failing sensor assignment, accuracy %",
        (
            _clean("driver"),
            _random("driver", 12, "uniform"),
            _random("driver", 12, "gaussian"),
            _random("driver", 8, "uniform", robustness=True),
            _random("driver", 8, "gaussian"),
            _random("driver", 5, "uniform"),
            _random("driver", 5, "gaussian"),
        ),
    ),
    "3.6": (
        "Driver identification, failing sensor generation test, accuracy %",
        (_ranges("driver", (1, 2), (3, 15)),),
    ),
}


@dataclasses.dataclass(frozen=True)
class Run:
    """One training: a row of a table, a model, a seed."""

    table: str
    row: Row
    model: str
    seed: int

    def path(self, out: Path) -> Path:
        """Where its scores are kept."""
        name = self.row.name.replace(" ", "_").replace("(", "").replace(")", "_").replace(",", "-")
        return out / self.table / name.strip("_") / self.model / f"{self.seed}.json"


def runs(table: str, seeds: int) -> Iterator[Run]:
    """All runs of a table, seed by seed, so that an early stop leaves whole seeds."""
    _, rows = TABLES[table]
    for seed in range(seeds):
        for row in rows:
            for model in row.models:
                yield Run(table, row, model, seed)


def execute(run: Run, dataset: Any, preset: str) -> dict[str, Any]:
    """Train and score one run."""
    import jax
    import numpy as np

    from fusion import evaluate
    from fusion.loop import test_output
    from fusion.sizes import count_parameters
    from snn_fusion_failure.commands.argate_runs import (
        Config,
        build_cases,
        build_settings,
        scores,
        train_and_test,
    )

    if run.model in CEILINGS:
        (case,) = build_cases(Config(**run.row.settings), dataset).values()
        return score(run.model, dataset, case.noise, run.seed) | {"git": commit()}
    config = Config(model=run.model, preset=preset, seed=run.seed, **run.row.settings)
    settings = build_settings(config, dataset)
    (case,) = build_cases(config, dataset).values()
    fitted, output = train_and_test(settings, dataset, case.noise, run.seed)
    record = scores(output, dataset.n_classes) | {
        "parameters": count_parameters(settings.model),
        "epochs": settings.train.epochs,
        "train_loss": fitted.history[-1]["total"],
        "git": commit(),
    }
    if dataset.name == "har":
        right = 100.0 * (output.labels == output.logits.argmax(-1))
        groups = np.unique(dataset.test_group)
        record["subjects"] = [float(right[dataset.test_group == g].mean()) for g in groups]
    if run.row.robustness and run.model != "oracle":
        record["robustness"], key = {}, jax.random.key(run.seed)
        for kind in UNSEEN_KINDS:
            other = test_output(
                settings.model, fitted.state, dataset, case.noise, key=key, kind=kind
            )
            record["robustness"][kind] = 100.0 * evaluate.accuracy(
                other.labels, other.logits.argmax(-1)
            )
    if run.row.channel is not None:
        index = dataset.channels.index(run.row.channel)
        corrupted = output.failed.any(axis=1)
        weights, failed = output.weights[corrupted, index], output.failed[corrupted, index]
        record["channel"] = {
            "name": run.row.channel,
            "when_failed": np.round(weights[failed], 4),
            "when_clean": np.round(weights[~failed], 4),
        }
    return record


PAIRS = (
    ("argate_plus", "baseline"),
    ("argate_l", "argate_plus"),
    ("argate_l", "baseline"),
    *((m, "equal_weights") for m in ("netgated", "argate_plus", "argate_l")),
    *((m, f"{m}_printed") for m in ("argate_plus", "argate_l")),
)
"""Columns that are compared seed by seed."""
METRICS = (
    "accuracy",
    "accuracy_clean",
    "accuracy_corrupted",
    "gate_auroc_pooled",
    "gate_auroc_channel",
)


def load_runs(table: str, out: Path, seeds: int) -> dict[tuple[str, str], dict[int, Any]]:
    """(row, model) -> seed -> record."""
    held: dict[tuple[str, str], dict[int, Any]] = {}
    for run in runs(table, seeds):
        path = run.path(out)
        if path.exists():
            record = json.loads(path.read_text(encoding="utf-8"))
            held.setdefault((run.row.name, run.model), {})[run.seed] = record
    return held


def collect(
    table: str, out: Path, seeds: int, source: dict[str, Any]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of the table of record and paired comparisons, from the runs on disk.

    Args:
        table: its number.
        out: folder of the runs.
        seeds: how many seeds to look for.
        source: the source's tables.

    Returns:
        (rows in the schema of record, paired comparisons between neighbouring models and gap
        closures to the oracle gate).
    """
    import numpy as np

    from fusion import evaluate
    from snn_fusion_failure.records.statistics import holm, paired_test, two_way_interval

    held = load_runs(table, out, seeds)
    printed = source[table]
    rows: list[dict[str, Any]] = []
    studies: list[dict[str, Any]] = []
    for (row, model), by_seed in held.items():
        order = sorted(by_seed)
        for metric in METRICS:
            values = [by_seed[s].get(metric) for s in order]
            if any(v is None for v in values):
                continue
            unit = "%" if metric.startswith("accuracy") else "1"
            cell: dict[str, Any] = {"row": row, "model": model, "metric": metric, "unit": unit}
            cell |= {"seeds": order} | summarize(values)
            if made := commits(by_seed.values()):
                cell["git"] = made
            column = "baseline" if model == "equal_weights" else model
            if metric == "accuracy" and column in printed["columns"]:
                cell["source"] = printed["rows"][row][printed["columns"].index(column)]
            rows.append(cell)
    for row in dict.fromkeys(name for name, _ in held):
        for better, worse in PAIRS:
            a, b = held.get((row, better), {}), held.get((row, worse), {})
            common = sorted(set(a) & set(b))
            if len(common) < 2:
                continue
            test = paired_test(
                [a[s]["accuracy"] for s in common], [b[s]["accuracy"] for s in common]
            )
            found = {"row": row, "comparison": f"{better} - {worse}", **test._asdict()}
            # Runs that come from a table of record have no scores of single subjects.
            known = [s for s in common if "subjects" in a[s] and "subjects" in b[s]]
            if len(known) > 1:
                apart = [np.subtract(a[s]["subjects"], b[s]["subjects"]).tolist() for s in known]
                found["over_subjects_and_seeds"] = list(two_way_interval(apart))
                found["seeds_of_subjects"] = known
            studies.append(found)
        oracle = held.get((row, "oracle"), {})
        base = held.get((row, "equal_weights")) or held.get((row, "baseline"), {})
        for model in FIVE[1:]:
            three = [held.get((row, model), {}), base, oracle]
            common = sorted(set(three[0]) & set(three[1]) & set(three[2]))
            if common:
                values = [[t[s]["accuracy"] for s in common] for t in three]
                gap = evaluate.gap_closure(*(np.asarray(v) for v in values))
                studies.append(
                    {
                        "row": row,
                        "comparison": f"gap closure {model}",
                        "n": len(common),
                        "value": gap,
                    }
                )
    tests = [study for study in studies if "p_value" in study]
    for study, p in zip(tests, holm([t["p_value"] for t in tests]), strict=True):
        study["p_holm"] = p
    return rows, studies
