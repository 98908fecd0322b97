"""All trials as one table: CSV, which every program reads, or Parquet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from snn_fusion_failure.runs.files import write_bytes, write_text
from snn_fusion_failure.sweeps.definition import STATUS


def frame(dataset: Any) -> Any:
    """A `pandas.DataFrame` with a row per trial: axes, seed, metrics, status in words."""
    table = dataset.to_dataframe().reset_index()
    table["status"] = [STATUS[i] for i in table["status"]]
    return table


def export(dataset: Any, out: Path, kind: str) -> Path:
    """Write `trials.csv` or `trials.parquet`; returns the file.

    Raises:
        ValueError: Parquet without pyarrow.
    """
    table = frame(dataset)
    path = out / f"trials.{kind}"
    if kind == "csv":
        write_text(path, table.to_csv(index=False))
        return path
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise ValueError(
            "export=parquet: expected the library pyarrow; pip install pyarrow, or export csv"
        ) from error
    write_bytes(path, table.to_parquet(None, index=False))
    return path
