"""Sweeps of any function over settings and seeds, on one core or on a cluster.

    from snn_fusion_failure.sweeps import sweep, grid, loguniform, choice
    data = sweep(trial, space={"gamma": loguniform(1e-5, 1e-2)}, samples=64, out="runs/mine")

`docs/sweeps.md` has the rest.
"""

from snn_fusion_failure.sweeps.axes import (
    categorical,
    choice,
    grid,
    integers,
    loguniform,
    uniform,
)
from snn_fusion_failure.sweeps.front import sweep
from snn_fusion_failure.sweeps.study import Carry, Metric, Study

__all__ = [
    "Carry", "Metric", "Study", "categorical", "choice", "grid", "integers", "loguniform", "sweep",
    "uniform",
]  # fmt: skip
