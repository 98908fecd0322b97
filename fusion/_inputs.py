"""What a network is given to read: refused where its shape is another, or where nobody reads it."""

from __future__ import annotations

from typing import Any

from fusion._checks import check_array
from fusion.config import ModelConfig


def check_read(config: ModelConfig, failed: Any, excluded: Any = None, weights: Any = None) -> None:
    """Refuse what the model would pass over in silence.

    Raises:
        ValueError: `failed` for another gate than the oracle's or beside `weights`, `excluded` for
            a head without a memory.
    """
    if failed is not None and not config.reads_failed:
        raise ValueError(
            f"failed=mask of {tuple(failed.shape)}: expected None for model={config.model!r}, only "
            "an oracle gate is told which sensors failed; leave it out, or give available=~failed "
            "to take these sensors out"
        )
    if failed is not None and weights is not None:
        raise ValueError(
            f"failed=mask of {tuple(failed.shape)}: expected None beside weights, which stand in "
            "place of the oracle gate that reads it; give one of the two"
        )
    if excluded is not None and config.head != "neighbourhood":
        raise ValueError(
            f"excluded=mask of {tuple(excluded.shape)}: expected None for head={config.head!r}, "
            "which has no memory to exclude rows of; leave it out"
        )


def check_windows(config: ModelConfig, x: Any) -> None:
    """Refuse windows of another shape than the model's, with the likely reason.

    Raises:
        ValueError: no batch axis, times before sensors, or other numbers of sensors or samples.
        TypeError: no array, or one of texts.
    """
    check_array("x", x)
    k, t = config.n_sensors, config.n_times
    if x.ndim == 3 and x.shape[1:] == (k, t):
        return
    fix = "the model was made for other sensors or windows"
    if x.shape == (k, t):
        fix = "add the batch axis: x[None]"
    elif x.ndim == 3 and x.shape[1:] == (t, k):
        fix = "sensors come before samples: x.transpose(0, 2, 1)"
    raise ValueError(f"x.shape={tuple(x.shape)}: expected [batch, {k} sensors, {t} samples]; {fix}")
