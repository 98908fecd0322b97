"""Data sets of sensor windows; reading is strict, and nothing is fetched unless asked for."""

from __future__ import annotations

from fusion.data.dataset import (
    Dataset,
    Scale,
    apply_scale,
    check_dataset,
    draw_groups,
    fit_scale,
    validation_split,
)
from fusion.data.driver import (
    DRIVER_CHANNELS,
    DRIVER_CLASSES,
    DRIVER_REPLACEMENTS,
    DRIVER_SOURCE_CHANNELS,
    load_driver,
)
from fusion.data.fixed import (
    DRIVER_FIXED_CLEAN,
    HAR_FIXED_FAILING,
    fixed_sets,
    published_fixed,
)
from fusion.data.har import HAR_CHANNELS, HAR_CLASSES, load_har

__all__ = [
    "DRIVER_CHANNELS",
    "DRIVER_CLASSES",
    "DRIVER_FIXED_CLEAN",
    "DRIVER_REPLACEMENTS",
    "DRIVER_SOURCE_CHANNELS",
    "HAR_CHANNELS",
    "HAR_CLASSES",
    "HAR_FIXED_FAILING",
    "Dataset",
    "Scale",
    "apply_scale",
    "check_dataset",
    "draw_groups",
    "fit_scale",
    "fixed_sets",
    "load_driver",
    "load_har",
    "published_fixed",
    "validation_split",
]
