"""One HTML file that shows a sweep: parallel coordinates, heat maps, slices, a table.

It holds its data, its style and its code, so that it opens from a disk without a network. While the
sweep runs, `show --watch` writes it anew and the open page reloads itself.
"""

from __future__ import annotations

import html
import json
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from snn_fusion_failure.runs import to_jsonable
from snn_fusion_failure.runs.files import write_text
from snn_fusion_failure.sweeps.definition import STATUS, valid
from snn_fusion_failure.sweeps.rank import axis_columns, mean_of, per_setting


def page_data(dataset: Any) -> dict[str, Any]:
    """What the page draws, JSON values: axes, metrics, and settings with means over valid seeds."""
    columns = axis_columns(dataset)
    status = per_setting(dataset, "status")
    metrics = [name for name in dataset.data_vars if "goal" in dataset[name].attrs]
    objective = dataset.attrs["objective"]
    values = per_setting(dataset, objective)
    settings = []
    for index in range(len(status)):
        counts = np.bincount(status[index], minlength=len(STATUS))
        if not counts[:3].sum():
            continue
        settings.append(
            {
                "setting": index,
                "axes": {k: v[index].item() for k, v in columns.items()},
                "metrics": {m: mean_of(dataset, m, index) for m in metrics},
                "values": values[index][valid(status[index], values[index])].tolist(),
                "valid": int(valid(status[index], values[index]).sum()),
                "counts": counts.tolist(),
            }
        )
    seeds = dataset.sizes["seed"]
    axes = [
        {"name": leaf, "unit": dataset[leaf].attrs["units"], "kind": dataset[leaf].attrs["kind"],
         "log": bool(dataset[leaf].attrs["log"]), "levels": sorted({x.item() for x in column})}
        for leaf, column in columns.items()
    ]  # fmt: skip
    described = [
        {"name": m, **{k: dataset[m].attrs[k] for k in ("units", "long_name", "goal")}}
        for m in metrics
    ]
    found: dict[str, Any] = to_jsonable(
        {
            "title": dataset.attrs["title"],
            "objective": objective,
            "min_valid": float(dataset.attrs["min_valid"]),
            "seeds": seeds,
            "status": list(STATUS),
            "totals": np.bincount(status.ravel(), minlength=len(STATUS)),
            "axes": axes,
            "metrics": described,
            "settings": settings,
            "mixed": bool(dataset.attrs["mixed"]),
        }
    )
    return found


def write_page(dataset: Any, path: Path, *, live: bool = False) -> Path:
    """Write the page; `live` lets it reload itself. Returns the file."""
    template = resources.files("snn_fusion_failure.sweeps").joinpath("page.html")
    data = page_data(dataset)
    # "<" could end the script element, whatever stands around it.
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    refresh = '<meta http-equiv="refresh" content="5">' if live else ""
    write_text(
        path,
        template.read_text(encoding="utf-8")
        .replace("@TITLE@", html.escape(data["title"]))
        .replace("@REFRESH@", refresh)
        .replace("@DATA@", text),
    )
    return path
