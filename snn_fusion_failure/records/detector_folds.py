"""Kinds of sensor failure that a detector's training does not see."""

from __future__ import annotations

from typing import Literal

Fold = int | Literal["all"] | None
"""All kinds are seen (`None`), all but a third of them, or none (`"all"` left out)."""
FOLDS = (
    ("camera_noise", "camera_fog", "lidar_loss"),
    ("camera_blackout", "lidar_noise", "lidar_sector_dropout"),
    ("camera_blur", "camera_exposure", "lidar_beam_loss"),
)
"""Thirds of `SENSOR_FAILURES`; each has both sensors."""


def unseen_kinds(fold: Fold) -> tuple[str, ...]:
    """Kinds of one failed sensor that a training does not see.

    Example:
        >>> unseen_kinds(0), len(unseen_kinds("all"))
        (('camera_noise', 'camera_fog', 'lidar_loss'), 9)
    """
    if fold is None:
        return ()
    return sum(FOLDS, ()) if fold == "all" else FOLDS[fold]
