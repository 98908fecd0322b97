"""From a detector's cells to the rows of a table: single cells, and means of groups of kinds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from snn_fusion_failure.commands.detector_cells import METRIC, Cell
from snn_fusion_failure.commands.detector_robustness import summarize_cells
from snn_fusion_failure.records.detector_folds import Fold, unseen_kinds

METRICS = (METRIC, "weight_auroc", "failed_auroc")
Scores = Mapping[Cell, Mapping[str, float]]


def fold_rows(
    fold: Fold, found: Scores, base: Scores | None, misaligned: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Rows of one training: single cells unless it saw a part of the kinds, and means of groups.

    Args:
        fold: what it did not see.
        found: scores of each cell, one of them `Cell()`.
        base: of the detector that the corruption error is taken against.
        misaligned: kinds of both sensors together, which no training sees.
    """
    kinds = {cell.failure for cell in found if cell.failure}
    apart, unseen = kinds & set(misaligned), kinds & set(unseen_kinds(fold))
    seen = kinds - apart - unseen
    rows: dict[str, Mapping[str, float]]
    if fold in (None, "all"):
        behind = "" if fold is None else " (none seen)"
        rows = {f"{cell.name}{behind}": values for cell, values in found.items()}
        of_all = "seen kinds" if fold is None else "unseen kinds (none seen)"
        groups = {of_all: seen | unseen, f"misaligned{behind}": apart}
    else:
        rows = {"clean (folds)": found[Cell()]}
        groups = {"unseen kinds": unseen, "seen kinds (folds)": seen}
    means = {row: mean_scores(found, base, group) for row, group in groups.items() if group}
    return {row: dict(values) for row, values in (rows | means).items()}


def mean_scores(found: Scores, base: Scores | None, kinds: set[str]) -> dict[str, float]:
    """Scores over the cells of some kinds: means, mRA and, against the baseline, mCE."""

    def by_kind(scores: Scores) -> dict[str, dict[str, float]]:
        out: dict[str, dict[str, float]] = {}
        for cell, values in scores.items():
            if cell.failure is not None and cell.failure in kinds:
                out.setdefault(cell.failure, {})[str(cell.level)] = values[METRIC]
        return out

    clean = found[Cell()][METRIC]
    summary = summarize_cells(clean, by_kind(found), None if base is None else by_kind(base))
    means = {METRIC: summary.pop("mean"), **summary}
    for metric in METRICS[1:]:
        values = [v[metric] for c, v in found.items() if c.failure in kinds and metric in v]
        if values:
            means[metric] = sum(values) / len(values)
    return means


def best_of(models: Sequence[Scores]) -> dict[Cell, dict[str, float]]:
    """The best average precision of each cell, chosen afterwards: no switch between them has more.

    Example:
        >>> one, other = Cell(), Cell("camera_fog", 5)
        >>> fused, lidar = ({one: {METRIC: a}, other: {METRIC: b}} for a, b in ((50, 30), (40, 40)))
        >>> [scores[METRIC] for scores in best_of([fused, lidar]).values()]
        [50, 40]
    """
    return {cell: {METRIC: max(m[cell][METRIC] for m in models)} for cell in models[0]}
