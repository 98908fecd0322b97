"""Which settings are best: ranks with intervals, the Pareto front, what was not ranked and why."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from snn_fusion_failure.records.rows import summarize
from snn_fusion_failure.sweeps.definition import FAILED, NON_FINITE, STATUS, valid
from snn_fusion_failure.sweeps.results import setting_scores


def axis_names(dataset: Any) -> list[str]:
    """The swept leaves, in the order of the command line."""
    return [str(name) for name in dataset.coords if name not in ("seed", "setting")]


def axis_columns(dataset: Any) -> dict[str, np.ndarray]:
    """Value of each axis for each setting, in the order of `per_setting`."""
    leaves = axis_names(dataset)
    if "setting" in dataset.dims:
        return {leaf: np.asarray(dataset[leaf]) for leaf in leaves}
    mesh = np.meshgrid(*(np.asarray(dataset[leaf]) for leaf in leaves), indexing="ij")
    return {leaf: m.ravel() for leaf, m in zip(leaves, mesh, strict=True)}


def per_setting(dataset: Any, name: str) -> np.ndarray:
    """A variable as `[settings, seeds]`."""
    return np.asarray(dataset[name]).reshape(-1, dataset.sizes["seed"])


def value_text(value: Any) -> str:
    """A value of an axis as it is typed."""
    return str(value) if isinstance(value, str | np.str_) else f"{float(value):.6g}"


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, str | np.str_) else float(value)


def rank(
    dataset: Any, *, objective: str | None = None, min_valid: float | None = None
) -> list[dict[str, Any]]:
    """Settings from best to worst by the mean of the objective over the trials that are valid.

    Only settings of which at least the share `min_valid` of all seeds is valid are ranked: of a
    setting of which most trials broke, the lucky rest says little.

    Args:
        dataset: of `gather`.
        objective: metric to rank by; the sweep's when left out.
        min_valid: that share; the sweep's when left out.

    Returns:
        Per setting: `setting` (its place among all), `axes`, `n` trials that count, `mean` and
        `ci95` (Student's t) of the objective, and `broken`, the number of trials that are not
        finite or failed.

    Raises:
        ValueError: the metric is unknown, or it is not known which way it is better.
    """
    objective = objective or dataset.attrs["objective"]
    known = [name for name in dataset.data_vars if dataset[name].attrs.get("goal")]
    if objective not in known:
        raise ValueError(f"objective={objective!r}: expected one of {', '.join(known)}")
    if min_valid is None:
        min_valid = float(dataset.attrs["min_valid"])
    values, status = per_setting(dataset, objective), per_setting(dataset, "status")
    scores = setting_scores(values, status, dataset[objective].attrs["goal"], min_valid)
    columns = axis_columns(dataset)
    rows = []
    for index in np.argsort(-scores, kind="stable"):
        if not np.isfinite(scores[index]):
            continue
        counted = values[index][valid(status[index], values[index])]
        summary = summarize(counted.tolist())
        rows.append(
            {
                "setting": int(index),
                "axes": {leaf: _plain(column[index]) for leaf, column in columns.items()},
                "n": summary["n"],
                "mean": summary["mean"],
                "ci95": summary["ci95"],
                "broken": int(np.isin(status[index], (NON_FINITE, FAILED)).sum()),
            }
        )
    return rows


def unranked(dataset: Any, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Settings with trials that are not ranked, because too few of them are valid."""
    objective = dataset.attrs["objective"]
    values, status = per_setting(dataset, objective), per_setting(dataset, "status")
    ranked = {row["setting"] for row in rows}
    columns = axis_columns(dataset)
    found = []
    for index in range(len(values)):
        counts = np.bincount(status[index], minlength=len(STATUS))
        if index not in ranked and counts[:3].sum():
            found.append(
                {
                    "setting": index,
                    "axes": {leaf: _plain(column[index]) for leaf, column in columns.items()},
                    "valid": int(valid(status[index], values[index]).sum()),
                    "of": values.shape[1],
                    "broken": int(counts[NON_FINITE] + counts[FAILED]),
                }
            )
    return found


def pareto(dataset: Any, objectives: Sequence[str], *, min_valid: float | None = None) -> list[int]:
    """Settings that no other one beats in all objectives, best in the first one first.

    Raises:
        ValueError: a metric is unknown or has no direction.

    Example:
        >>> import numpy as np, xarray as xr
        >>> data = xr.Dataset(
        ...     {"hits": (("a", "seed"), [[1.0], [3.0], [2.0]], {"goal": "max"}),
        ...      "cost": (("a", "seed"), [[1.0], [3.0], [4.0]], {"goal": "min"}),
        ...      "status": (("a", "seed"), np.zeros((3, 1), int))},
        ...     {"a": [1, 2, 3]}, {"objective": "hits", "min_valid": 1.0})
        >>> pareto(data, ["hits", "cost"])
        [1, 0]
    """
    columns = []
    for name in objectives:
        rows = rank(dataset, objective=name, min_valid=min_valid)
        sign = 1.0 if dataset[name].attrs["goal"] == "max" else -1.0
        column = np.full(len(per_setting(dataset, name)), -np.inf)
        for row in rows:
            column[row["setting"]] = sign * row["mean"]
        columns.append(column)
    points = np.stack(columns, 1)
    candidates = np.flatnonzero(np.isfinite(points).all(axis=1))
    front = [
        int(i) for i in candidates
        if not any(
            (points[j] >= points[i]).all() and (points[j] > points[i]).any() for j in candidates
        )
    ]  # fmt: skip
    return sorted(front, key=lambda i: -points[i, 0])


def compare(dataset: Any, a: int, b: int, *, objective: str | None = None) -> dict[str, Any]:
    """Difference of two settings with its 95 % interval.

    With common seeds the difference is taken seed by seed (paired Student's t), which cancels what
    the seeds share; otherwise Welch's interval of two independent means.

    Args:
        dataset: of `gather`.
        a, b: places of the settings, as `rank` gives them.
        objective: metric; the sweep's when left out.

    Returns:
        `difference` (a - b), `ci95`, `paired`, `n` pairs (or the smaller number of trials), `p`.

    Raises:
        ValueError: fewer than two trials count.
    """
    from scipy import stats

    name = objective or dataset.attrs["objective"]
    values, status = per_setting(dataset, name), per_setting(dataset, "status")
    counts = valid(status, values)
    paired = bool(dataset.attrs["common_seeds"])
    if paired:
        both = counts[a] & counts[b]
        x = values[a][both] - values[b][both]
        if len(x) < 2:
            raise ValueError(f"settings {a} and {b}: expected two common seeds that are valid")
        if np.ptp(x) == 0.0:
            return {"difference": float(x[0]), "ci95": [float(x[0])] * 2, "paired": True,
                    "n": len(x), "p": 1.0 if x[0] == 0.0 else 0.0}  # fmt: skip
        test = stats.ttest_1samp(x, 0.0)
        mean, n = float(x.mean()), len(x)
    else:
        left, right = values[a][counts[a]], values[b][counts[b]]
        if min(len(left), len(right)) < 2:
            raise ValueError(f"settings {a} and {b}: expected two trials of each that are valid")
        test = stats.ttest_ind(left, right, equal_var=False)
        mean, n = float(left.mean() - right.mean()), min(len(left), len(right))
    interval = test.confidence_interval(0.95)
    return {"difference": mean, "ci95": [float(interval.low), float(interval.high)],
            "paired": paired, "n": n, "p": float(test.pvalue)}  # fmt: skip


def _aligned(lines: list[list[str]]) -> str:
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in lines
    )


def table(dataset: Any, rows: list[dict[str, Any]], *, top: int = 10) -> str:
    """The best settings as text, and what became of the trials."""
    objective = dataset.attrs["objective"]
    leaves = axis_names(dataset)
    unit = dataset[objective].attrs["units"].replace("1", "", 1)

    def head(leaf: str) -> str:
        axis_unit = dataset[leaf].attrs["units"]
        return leaf if axis_unit == "1" else f"{leaf} [{axis_unit}]"

    title = f"{objective} [{unit}]" if unit else objective
    title += f" ({dataset[objective].attrs['goal']})"
    lines = [["", *map(head, leaves), title, "95 % interval", "n", "broken"]]
    for place, row in enumerate(rows[:top], 1):
        interval = "{:.4g} .. {:.4g}".format(*row["ci95"]) if row["ci95"] else "-"
        lines.append(
            [str(place), *(value_text(row["axes"][leaf]) for leaf in leaves),
             f"{row['mean']:.4g}", interval, str(row["n"]), str(row["broken"])]
        )  # fmt: skip
    status = np.asarray(dataset["status"]).ravel()
    counts = [f"{int((status == k).sum())} {name}" for k, name in enumerate(STATUS)]
    text = f"{_aligned(lines)}\n{len(rows)} settings ranked; trials: {', '.join(counts)}"
    left = unranked(dataset, rows)
    if left:
        share = float(dataset.attrs["min_valid"])
        text += (
            f"\n{len(left)} settings not ranked: fewer than {share:.0%} of their seeds are valid "
            "(--min-valid changes that)"
        )
        for row in left[:5]:
            at = " ".join(f"{leaf}={value_text(v)}" for leaf, v in row["axes"].items())
            text += f"\n  {at}: {row['valid']} of {row['of']} valid, {row['broken']} broken"
    if dataset.attrs["mixed"]:
        text += "\nwarning: numbers of several sources are mixed here (variable `source`)"
    return text


def mean_of(dataset: Any, name: str, setting: int) -> float:
    """Mean of a metric over the valid trials of a setting; NaN without one."""
    values, status = per_setting(dataset, name)[setting], per_setting(dataset, "status")[setting]
    counted = values[valid(status, values)]
    return float(counted.mean()) if len(counted) else float("nan")
