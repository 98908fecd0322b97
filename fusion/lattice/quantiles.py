"""Keypoints of calibrators from data."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fusion.lattice.checks import refusal, require_count


def quantile_keypoints(
    data: Float[np.ndarray, "n_rows n_inputs"], n_keypoints: int = 10
) -> tuple[tuple[float, ...], ...]:
    """Keypoints with equal shares of the data between them, for `PWLConfig.keypoints`.

    Where a column repeats values (or has fewer distinct ones than keypoints) the positions that
    coincide are moved to the middle of the widest gaps.

    Args:
        data: one column `[n_rows]` for each input; NaN is left out.
        n_keypoints: positions for each input.

    Returns:
        `n_inputs` tuples of `n_keypoints` positions that increase strictly.

    Raises:
        ValueError: no rows, or a column without a finite number.

    Example:
        >>> quantile_keypoints(np.array([[0.0], [1.0], [2.0], [9.0]]), 3)
        ((0.0, 1.5, 9.0),)
        >>> quantile_keypoints(np.array([[0.0], [0.0], [0.0], [1.0]]), 3)
        ((0.0, 0.5, 1.0),)
    """
    require_count("n_keypoints", n_keypoints, 2)
    data = np.asarray(data, np.float64)
    if data.ndim != 2 or not np.isfinite(data).any(axis=0).all():
        raise refusal(
            "data.shape", data.shape, "[n_rows, n_inputs] with a finite number in each column",
            "drop empty columns",
        )  # fmt: skip
    positions = []
    for column in data.T:
        column = column[np.isfinite(column)]
        found = np.unique(
            np.quantile(column, np.linspace(0.0, 1.0, n_keypoints)).astype(np.float32)
        )
        if len(found) == 1:
            found = np.concatenate([found, found + max(1.0, abs(float(found[0])))])
        while len(found) < n_keypoints:
            widest = int(np.argmax(np.diff(found)))
            found = np.insert(found, widest + 1, 0.5 * (found[widest] + found[widest + 1]))
        positions.append(tuple(float(v) for v in found))
    return tuple(positions)
