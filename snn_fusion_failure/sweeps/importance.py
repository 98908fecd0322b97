r"""How much each axis matters: shares of the variance between settings.

On a full grid the functional decomposition of the variance is exact,

.. math:: V_i = \mathrm{Var}\left[\mathrm{E}(y \mid x_i)\right] / \mathrm{Var}(y), \qquad
          T_i = 1 - \mathrm{Var}\left[\mathrm{E}(y \mid x_{-i})\right] / \mathrm{Var}(y),

with an axis' own share and its total share, interactions included. Other designs are not balanced:
their first-order shares are estimated from the points that are there by SALib (RBD-FAST), their
totals are not.

Source: Hutter, Hoos and Leyton-Brown (2014), fANOVA; Tarantola, Gatelli and Mara (2006), RBD-FAST.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from snn_fusion_failure.sweeps.rank import axis_columns, axis_names, per_setting
from snn_fusion_failure.sweeps.results import setting_scores


def importance(dataset: Any) -> dict[str, tuple[float, float | None]]:
    """Own and total share of each axis.

    Args:
        dataset: of `gather`.

    Returns:
        Axis -> (own share, total share); no total for a design that is not a grid.

    Raises:
        ValueError: settings of the grid are missing, or fewer than 16 others can be used, or SALib
            is not installed.
    """
    objective = dataset.attrs["objective"]
    goal = dataset[objective].attrs["goal"]
    scores = setting_scores(
        per_setting(dataset, objective), per_setting(dataset, "status"), goal,
        float(dataset.attrs["min_valid"]),
    )  # fmt: skip
    leaves = axis_names(dataset)
    finite = np.isfinite(scores)
    if "setting" not in dataset.dims:
        if not finite.all():
            raise ValueError(
                f"importance: expected a rank for every setting of the grid; {(~finite).sum()} "
                "have too few valid trials (--min-valid)"
            )
        shape = tuple(dataset.sizes[leaf] for leaf in leaves)
        return dict(zip(leaves, _shares(scores.reshape(shape)), strict=True))
    columns = axis_columns(dataset)
    if finite.sum() < 16:
        raise ValueError(f"importance: expected 16 ranked settings; {finite.sum()} are there")
    try:
        from SALib.analyze import rbd_fast
    except ImportError as error:
        raise ValueError(
            "importance: expected the library SALib for a design that is not a grid; "
            "pip install 'snn-fusion-failure[sweeps]'"
        ) from error
    points = np.stack([_ranks(columns[leaf][finite]) for leaf in leaves], 1)
    problem = {"num_vars": len(leaves), "names": leaves, "bounds": [[0.0, 1.0]] * len(leaves)}
    found = rbd_fast.analyze(problem, points, scores[finite], M=4, num_resamples=2, seed=0)
    return {leaf: (float(max(0.0, s)), None) for leaf, s in zip(leaves, found["S1"], strict=True)}


def _ranks(column: np.ndarray) -> np.ndarray:
    """Values by rank in (0, 1): an importance does not depend on an axis' scale."""
    _, index = np.unique(column, return_inverse=True)
    return (index + 0.5) / (index.max() + 1)


def _shares(y: np.ndarray) -> list[tuple[float, float]]:
    """Own and total share of each dimension of a full grid."""
    variance = y.var()
    if variance == 0.0:
        return [(0.0, 0.0)] * y.ndim
    found = []
    for axis in range(y.ndim):
        others = tuple(i for i in range(y.ndim) if i != axis)
        own = y.mean(axis=others).var() if others else variance
        rest = y.mean(axis=axis).var() if others else 0.0
        found.append((float(own / variance), float(1.0 - rest / variance)))
    return found
